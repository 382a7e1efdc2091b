// Boxes: opaque or evenly translucent rectangles |u| <= 1, |v| <= 1 of a splat's plane, their edges filtered by the
// sample's own width, so that n samples per pixel sharpen them and none makes them alias.
//
// h is a sample's signed distance from the image of an edge, in samples: (D -+ n_u) / |grad(D -+ n_u)| with the gradient by
// the sample's position, there. A ramp clamp(1/2 + h) over one sample says how much of it lies on the box's side. Between two
// edges it is the sum of their ramps less 1, and a box covers the product of that along u and v. Ramps belong to edges, not to
// boxes: the forms of two boxes at an edge differ by a factor, so that their ramps add up to 1, and the coverages of any
// partition of a rectangle into boxes with parallel sides add up to that of the rectangle, at corners, T-junctions, under
// perspective, through lenses and below the size of a sample. Where the edges lie along the samples' rows the coverage is the
// exact area.
//@ footprint_crossing
    vfloat cover;           // share of the sample that a box covers
//@ footprint_functions
#define SQRT_2 WIDE(1.41421356237309504880)   // the numerators hold sqrt(1/2)
//@ footprint_reach
    if (BOX_HERE) {
        radius = REAL(1.41421356237309504880);
        reach = fabs(a.z) + fabs(b.z);
//@@ camera_box_reach
    }
//@ footprint_dot_bounds
        if (BOX_HERE) bounds.pr = -1.0f;
//@ footprint_dot
        if (BOX_HERE) record.dot_x = record.dot_y = 1e18f;
//@ footprint_opacity
    if (IS_BOX(s)) opacity = fmin(exp(s->log_opacity), constants->ceiling) * c.cover;
//@ footprint_tau
    // what lies side by side adds up: the optical depth of boxes is the area that they cover, and their colour its mean
    if (IS_BOX(s)) tau = opacity;
//@ footprint_layer
    if (IS_BOX(s)) layer->opacity = fmin(layer->optical_depth, (vfloat)1.0f);
