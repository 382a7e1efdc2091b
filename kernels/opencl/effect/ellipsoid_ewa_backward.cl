// Backward pass of the EWA projection: from the facing disk to the axes of the Gaussian, whose scaled images are the rows `across`
// and `down`, and to the centre, which the Jacobian depends on.
//@ ellipsoid_projection
    const real3_ depths = {a.z, b.z, c.z};
    const real spread = REAL(0.3) / view->sample_area;
    real3_ across, down;
    real per_x, per_y;
//@@ camera_image
    const Projected wide_image = widened(across, down, spread);
    if (THICK_HERE) {
        a.x = wide_image.l11 / per_x; a.y = wide_image.l21 / per_y; a.z = 0;
        b.x = 0; b.y = wide_image.l22 / per_y; b.z = 0;
        offset = pz;
    }
//@ ellipsoid_backward
    if (THICK_HERE) {
        const real l11 = wide_image.l11;
        real grad_l11 = grad_a.x / per_x, grad_l21 = grad_a.y / per_y, grad_l22 = grad_b.y / per_y;
        real grad_per_x = -grad_l11 * a.x, grad_per_y = -(grad_l21 * a.y + grad_l22 * b.y);
        real grad_grown = REAL(0.5) * grad_l22 * wide_image.l22 / wide_image.grown, grad_determinant2 = 0;
//@@ ewa_opacity_backward
        grad_determinant2 += grad_grown;
        real grad_xx = REAL(0.5) * (grad_l11 - (grad_l21 * wide_image.l21 + grad_l22 * wide_image.l22) / l11) / l11 + spread * grad_grown;
        real grad_xy = grad_l21 / l11, grad_yy = spread * grad_grown;
        real3_ grad_crossed = scaled(2 * grad_determinant2, wide_image.crossed);
        real3_ grad_across = add3(cross3(down, grad_crossed), add3(scaled(2 * grad_xx, across), scaled(grad_xy, down)));
        real3_ grad_down = add3(cross3(grad_crossed, across), add3(scaled(2 * grad_yy, down), scaled(grad_xy, across)));
        grad_per_x += dot3(grad_across, across) / per_x;
        grad_per_y += dot3(grad_down, down) / per_y;
        grad_across = scaled(per_x, grad_across);
        grad_down = scaled(per_y, grad_down);
        grad_a.x = grad_across.x; grad_a.y = grad_down.x; grad_a.z = -slope_x * grad_across.x - slope_y * grad_down.x;
        grad_b.x = grad_across.y; grad_b.y = grad_down.y; grad_b.z = -slope_x * grad_across.y - slope_y * grad_down.y;
        grad_c.x = grad_across.z; grad_c.y = grad_down.z; grad_c.z = -slope_x * grad_across.z - slope_y * grad_down.z;
        // slopes at their limits are constant
        real grad_slope_x = slope_x == p.x * ahead ? -dot3(grad_across, depths) : 0;
        real grad_slope_y = slope_y == p.y * ahead ? -dot3(grad_down, depths) : 0;
        grad_p.x += grad_slope_x * ahead;
        grad_p.y += grad_slope_y * ahead;
        grad_p.z -= (grad_slope_x * slope_x + grad_slope_y * slope_y + grad_per_x * per_x + grad_per_y * per_y) * ahead;
        // The image depends on fx x + cx z and fy y + cy z of the axes and the centre; limits of slopes are constant in pixels.
        const real3_ xs = {su * unit_a.x, sv * unit_b.x, c.x}, ys = {su * unit_a.y, sv * unit_b.y, c.y};
        const real3_ grad_xs = {grad_a.x, grad_b.x, grad_c.x}, grad_ys = {grad_a.y, grad_b.y, grad_c.y};
        splat_grad.grad_camera[6] = (dot3(grad_xs, xs) + grad_p.x * p.x) / view->focal_x;
        splat_grad.grad_camera[7] = (dot3(grad_ys, ys) + grad_p.y * p.y) / view->focal_y;
        splat_grad.grad_camera[8] = (dot3(grad_xs, depths) + grad_p.x * pz) / view->focal_x;
        splat_grad.grad_camera[9] = (dot3(grad_ys, depths) + grad_p.y * pz) / view->focal_y;
    }
