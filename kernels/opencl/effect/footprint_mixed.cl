// Boxes (part/box_edges.cl) and Gaussians: selected per splat.
//@ footprint
#define IS_BOX(s) ((s)->box)
//@ footprint_here
#define BOX_HERE (boxes[i] != 0)
//@ project
    record.box = boxes[i];
