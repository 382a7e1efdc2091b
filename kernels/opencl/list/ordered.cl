// For CPUs: project keeps every splat's bounds and depth key; sort.cl puts the splats in depth order, and bin.cl lists
// them per tile in that order. The sections below stand in project.cl.
//@ list_args
    , global Bounds *restrict all_bounds      // (n)
//@ list
    all_bounds[i] = bounds;
