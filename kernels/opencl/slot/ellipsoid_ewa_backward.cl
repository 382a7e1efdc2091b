// Backward pass of the EWA projection: from the facing disk to the axes of the Gaussian, whose scaled images are the rows `across`
// and `down`, and to the centre, which the Jacobian depends on.
//@ ellipsoid_set_up
    const real3_ depths = {a.z, b.z, c.z};
    const real spread = REAL(0.3) / view->filter;
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
        real by_l11 = by_a.x / per_x, by_l21 = by_a.y / per_y, by_l22 = by_b.y / per_y;
        real by_per_x = -by_l11 * a.x, by_per_y = -(by_l21 * a.y + by_l22 * b.y);
        real by_grown = REAL(0.5) * by_l22 * wide_image.l22 / wide_image.grown, by_determinant2 = 0;
//@@ ewa_opacity_backward
        by_determinant2 += by_grown;
        real by_xx = REAL(0.5) * (by_l11 - (by_l21 * wide_image.l21 + by_l22 * wide_image.l22) / l11) / l11 + spread * by_grown;
        real by_xy = by_l21 / l11, by_yy = spread * by_grown;
        real3_ by_crossed = scaled(2 * by_determinant2, wide_image.crossed);
        real3_ by_across = add3(cross3(down, by_crossed), add3(scaled(2 * by_xx, across), scaled(by_xy, down)));
        real3_ by_down = add3(cross3(by_crossed, across), add3(scaled(2 * by_yy, down), scaled(by_xy, across)));
        by_per_x += dot3(by_across, across) / per_x;
        by_per_y += dot3(by_down, down) / per_y;
        by_across = scaled(per_x, by_across);
        by_down = scaled(per_y, by_down);
        by_a.x = by_across.x; by_a.y = by_down.x; by_a.z = -slope_x * by_across.x - slope_y * by_down.x;
        by_b.x = by_across.y; by_b.y = by_down.y; by_b.z = -slope_x * by_across.y - slope_y * by_down.y;
        by_c.x = by_across.z; by_c.y = by_down.z; by_c.z = -slope_x * by_across.z - slope_y * by_down.z;
        // slopes at their limits are constant
        real by_slope_x = slope_x == p.x * ahead ? -dot3(by_across, depths) : 0;
        real by_slope_y = slope_y == p.y * ahead ? -dot3(by_down, depths) : 0;
        by_p.x += by_slope_x * ahead;
        by_p.y += by_slope_y * ahead;
        by_p.z -= (by_slope_x * slope_x + by_slope_y * slope_y + by_per_x * per_x + by_per_y * per_y) * ahead;
        // The image depends on fx x + cx z and fy y + cy z of the axes and the centre; limits of slopes are constant in pixels.
        const real3_ xs = {su * unit_a.x, sv * unit_b.x, c.x}, ys = {su * unit_a.y, sv * unit_b.y, c.y};
        const real3_ by_xs = {by_a.x, by_b.x, by_c.x}, by_ys = {by_a.y, by_b.y, by_c.y};
        own.by_camera[6] = (dot3(by_xs, xs) + by_p.x * p.x) / view->focal_x;
        own.by_camera[7] = (dot3(by_ys, ys) + by_p.y * p.y) / view->focal_y;
        own.by_camera[8] = (dot3(by_xs, depths) + by_p.x * pz) / view->focal_x;
        own.by_camera[9] = (dot3(by_ys, depths) + by_p.y * pz) / view->focal_y;
    }
