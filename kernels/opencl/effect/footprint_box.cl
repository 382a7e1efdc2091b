// All splats are boxes (part/box_edges.cl).
//@ footprint
#define IS_BOX(s) true
//@ footprint_here
#define BOX_HERE true
