// Boxes: opaque or uniformly translucent rectangles |u| <= 1, |v| <= 1 in a splat's plane, with edges antialiased by a filter as
// wide as a sample.
//
// h is a sample's signed distance from the projected edge, in samples: (D -+ n_u) / |grad(D -+ n_u)|, with the gradient with respect to the
// sample's position. The ramp clamp(1/2 + h) is the covered share of the sample. Coverage between two edges is the sum of their
// ramps minus 1; a box's coverage is the product along u and v. Ramps belong to edges, not to boxes: the forms of two boxes at a
// shared edge differ by a factor only, so their ramps add up to 1, and the coverages of a partition of a rectangle into boxes
// with parallel sides add up to that of the rectangle: at corners and T-junctions, under perspective, through lenses and below
// the size of a sample. Coverage is the exact area where edges are parallel to the rows of samples.
//@ footprint_intersection
    vfloat cover;           // covered share of the sample
//@ footprint_functions
#define SQRT_2 BLEND_REAL(1.41421356237309504880)   // the numerators have the factor sqrt(1/2)
//@ footprint_reach
    if (BOX_HERE) {
        radius = REAL(1.41421356237309504880);
        reach = fabs(a.z) + fabs(b.z);
//@@ camera_box_reach
    }
//@ footprint_lowpass_bounds
        if (BOX_HERE) bounds.pr = -1.0f;
//@ footprint_lowpass
        if (BOX_HERE) record.lowpass_x = record.lowpass_y = 1e18f;
//@ footprint_alpha
    if (IS_BOX(s)) alpha = VMIN(EXP((vfloat)s->log_opacity), (vfloat)constants->opacity_ceiling) * c.cover;
//@ footprint_tau
    // in a layer, boxes add up alphas, where Gaussians add up optical depths
    if (IS_BOX(s)) tau = alpha;
//@ footprint_layer
    if (IS_BOX(s)) layer->alpha = fmin(layer->optical_depth, (vfloat)1.0f);
