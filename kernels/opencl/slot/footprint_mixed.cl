// Some splats are boxes (part/box_edges.cl), the others Gaussians: the choice is made for each splat.
//@ footprint
#define IS_BOX(s) ((s)->box)
//@ footprint_here
#define BOX_HERE (boxes[i] != 0)
//@ project
    record.box = boxes[i];
