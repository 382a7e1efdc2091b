// Backward pass of 3D Gaussians: their third axis, and the normal of the surface of largest values along rays.
//@ footprint_gradient
    float thickness;
//@ footprint_parameters
    , global const float *thickness
//@ footprint_arguments
            , thickness
//@ footprint_set_up
    const real3_ facet = cross3(unit_a, unit_b);
    const real sw = THICK_HERE ? THICKNESS_HERE : 0;
    const real3_ c = scaled(sw, facet);
    real3_ by_c = {0, 0, 0};        // by the third scaled axis
//@ ellipsoid_normal_backward
        if (THICK_HERE) {
            // the normal is sum_k along_k axis_k, with along_k = axis_k p (min_length / length_k)^2, then of length 1
            const real3_ axes[3] = {unit_a, unit_b, facet};
            const real lengths[3] = {su, sv, sw}, min_length = fmin(fmin(su, sv), sw);
            real along[3], by_lengths[3];
            real3_ outward = {0, 0, 0}, by_axes[3];
            for (int k = 0; k < 3; k++) {
                along[k] = dot3(axes[k], p) * (min_length / lengths[k]) * (min_length / lengths[k]);
                outward = add3(outward, scaled(along[k], axes[k]));
            }
            real inverse = 1 / sqrt(dot3(outward, outward));
            outward = scaled(inverse, outward);
            real3_ by_outward = scaled(inverse, add3(by_facet, scaled(-dot3(by_facet, outward), outward)));
            for (int k = 0; k < 3; k++) {
                real by_along = dot3(axes[k], by_outward), share = min_length / lengths[k];
                by_axes[k] = add3(scaled(along[k], by_outward), scaled(by_along * share * share, p));
                by_p = add3(by_p, scaled(by_along * share * share, axes[k]));
                by_lengths[k] = -2 * by_along * along[k] / lengths[k];      // a common factor of the lengths has no gradient
            }
            by_unit_a = add3(by_unit_a, by_axes[0]);
            by_unit_b = add3(by_unit_b, by_axes[1]);
            by_su += by_lengths[0];
            by_sv += by_lengths[1];
            by_c = add3(by_c, add3(scaled(1 / sw, by_axes[2]), scaled(by_lengths[2] - dot3(by_axes[2], facet) / sw, facet)));
            by_facet = scaled(0, by_facet);
        }
//@ footprint_backward
    if (THICK_HERE) {
        real3_ by_third = scaled(sw, by_c);
        by_unit_a = add3(by_unit_a, cross3(unit_b, by_third));
        by_unit_b = add3(by_unit_b, cross3(by_third, unit_a));
        own.thickness = thickness[i] >= MIN_SCALE ? (float)dot3(by_c, facet) : 0.0f;
    }
//@ footprint_results
        by_thickness[i] = own.thickness;
