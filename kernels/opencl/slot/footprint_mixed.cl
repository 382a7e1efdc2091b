// Some splats are boxes (slot/box_edges.cl), the others Gaussians: the choice is made for each splat.
//@ record
    int box;
//@ footprint
#define IS_BOX(s) ((s)->box)
//@ project_args
    , global const int *restrict boxes       // (n) 1: box, 0: Gaussian
//@ footprint_here
#define BOX_HERE (boxes[i] != 0)
//@ project
    record.box = boxes[i];
