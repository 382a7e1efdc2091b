// Backward pass of 3D Gaussians: their third axis, and the normal of the surface of largest values along rays.
//@ footprint_gradient
    float thickness;
//@ footprint_parameters
    , global const float *thickness
//@ footprint_arguments
            , thickness
//@ footprint_projection
    const real3_ unit_normal = cross3(unit_a, unit_b);
    const real sw = THICK_HERE ? THICKNESS_HERE : 0;
    const real3_ c = scaled(sw, unit_normal);
    real3_ grad_c = {0, 0, 0};        // by the third scaled axis
//@ ellipsoid_normal_backward
        if (THICK_HERE) {
            // the normal is sum_k along_k axis_k, with along_k = axis_k p (min_length / length_k)^2, then of length 1
            const real3_ axes[3] = {unit_a, unit_b, unit_normal};
            const real lengths[3] = {su, sv, sw}, min_length = fmin(fmin(su, sv), sw);
            real along[3], grad_lengths[3];
            real3_ outward = {0, 0, 0}, grad_axes[3];
            for (int k = 0; k < 3; k++) {
                along[k] = dot3(axes[k], p) * (min_length / lengths[k]) * (min_length / lengths[k]);
                outward = add3(outward, scaled(along[k], axes[k]));
            }
            real inverse = 1 / sqrt(dot3(outward, outward));
            outward = scaled(inverse, outward);
            real3_ grad_outward = scaled(inverse, add3(grad_unit_normal, scaled(-dot3(grad_unit_normal, outward), outward)));
            for (int k = 0; k < 3; k++) {
                real grad_along = dot3(axes[k], grad_outward), share = min_length / lengths[k];
                grad_axes[k] = add3(scaled(along[k], grad_outward), scaled(grad_along * share * share, p));
                grad_p = add3(grad_p, scaled(grad_along * share * share, axes[k]));
                grad_lengths[k] = -2 * grad_along * along[k] / lengths[k];      // a common factor of the lengths has no gradient
            }
            grad_unit_a = add3(grad_unit_a, grad_axes[0]);
            grad_unit_b = add3(grad_unit_b, grad_axes[1]);
            grad_su += grad_lengths[0];
            grad_sv += grad_lengths[1];
            grad_c = add3(grad_c, add3(scaled(1 / sw, grad_axes[2]), scaled(grad_lengths[2] - dot3(grad_axes[2], unit_normal) / sw, unit_normal)));
            grad_unit_normal = scaled(0, grad_unit_normal);
        }
//@ footprint_backward
    if (THICK_HERE) {
        real3_ grad_third = scaled(sw, grad_c);
        grad_unit_a = add3(grad_unit_a, cross3(unit_b, grad_third));
        grad_unit_b = add3(grad_unit_b, cross3(grad_third, unit_a));
        splat_grad.thickness = thickness[i] >= MIN_SCALE ? (float)dot3(grad_c, unit_normal) : 0.0f;
    }
//@ footprint_results
        grad_thickness[i] = splat_grad.thickness;
