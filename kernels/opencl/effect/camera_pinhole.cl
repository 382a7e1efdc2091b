// Pinhole camera with OpenCV axes.
//@ camera_forms
    tu = image_row(view->focal_x, view->center_x - anchor_x, row_x, tw);
    tv = image_row(view->focal_y, view->center_y - anchor_y, row_y, tw);
    real3_ k0 = cross3(tu, tv), kx = cross3(tv, tw), ky = cross3(tw, tu);   // (n_u, n_v, D): constant, per x, per y
    real determinant = view->focal_x * view->focal_y * su * sv * offset;   // of M: exact where tw . k0 cancels
//@ camera_blocks_nearest
        // depth is z_numerator / D, clamped to the splat's range, with D <= `d`; valid for disks where D > 0
        vint hit = VMASK(d > 2.0f * around_d) & VMASK((vfloat)s->z_numerator > 0.0f) & VMASK((vfloat)conic_h == (vfloat)(float)half_r2);
        vfloat depth = fmin((1.0f - BLOCKS_SLACK) * s->z_numerator / d, (vfloat)(s->z_center + s->z_reach));
        min_depth = VSELECT(min_depth, fmax(depth, min_depth), hit);
//@ camera_lowpass
        // The low-pass disc never has the larger weight if the splat is wider than it in all of the disc: there D is at least `min_d`, in
        // front of the near plane, and (n_u^2 + n_v^2) / D^2 at most the squared distance.
        real spread = sqrt((kx.z * kx.z + ky.z * ky.z) * (half_r2 / view->sample_area));
        real ahead = (k0.z + kx.z * (center_x - anchor_x) + ky.z * (center_y - anchor_y)) * (determinant < 0 ? -1 : 1);
        real min_d = ahead - spread, steep = kx.x * kx.x + kx.y * kx.y + ky.x * ky.x + ky.y * ky.y;
        // margin for the rounding of the float32 record
        if (facing != 0 && min_d > 0 && (ahead + spread) * near < REAL(0.999) * fabs(determinant) &&
            steep < REAL(1.99) * view->sample_area * min_d * min_d)
            record.lowpass_x = 1e18f;
//@ camera_derivative
        real ahead = 1 / pz;
        real3_ in_x = {a.x, b.x, p.x}, in_y = {a.y, b.y, p.y}, in_z = {a.z, b.z, p.z};
        gx = image_row(view->focal_x * ahead, -view->focal_x * p.x * ahead * ahead, in_x, in_z);
        gy = image_row(view->focal_y * ahead, -view->focal_y * p.y * ahead * ahead, in_y, in_z);
        gz.x = a.z * ahead; gz.y = b.z * ahead;
//@ camera_image
        // Jacobian clamped to 0.3 half images outside of the image, as in gsplat
        real ahead = 1 / pz, slope_x = fmin(fmax(p.x * ahead, -view->ewa_clamp[0]), view->ewa_clamp[1]);
        real slope_y = fmin(fmax(p.y * ahead, -view->ewa_clamp[2]), view->ewa_clamp[3]);
        per_x = view->focal_x * ahead;
        per_y = view->focal_y * ahead;
        across.x = per_x * (a.x - slope_x * a.z); across.y = per_x * (b.x - slope_x * b.z); across.z = per_x * (c.x - slope_x * c.z);
        down.x = per_y * (a.y - slope_y * a.z); down.y = per_y * (b.y - slope_y * b.z); down.z = per_y * (c.y - slope_y * c.z);
//@ camera_ellipsoid_box
        // The visible contour of an ellipsoid is on an ellipsoid of half its size through the camera centre and its own centre: the part
        // beyond the near plane projects into the contour's section at `near`.
        real3_ along_x = {a.x, b.x, third.x}, along_y = {a.y, b.y, third.y}, along_z = {a.z, b.z, third.z};
        real zz = dot3(along_z, along_z), ahead = near - pz * REAL(0.5);
        real extent2 = REAL(0.25) / inverse_m2 * (1 + (PROJECTION_FP64 ? REAL(1e-12) : REAL(1e-4))) - ahead * ahead / zz;
        if (!(extent2 > 0)) return;
        real3_ across_x = cross3(along_x, along_z), across_y = cross3(along_y, along_z);
        real half_x = sqrt(extent2 * dot3(across_x, across_x) / zz), half_y = sqrt(extent2 * dot3(across_y, across_y) / zz);
        real middle_x = p.x * REAL(0.5) + dot3(along_x, along_z) / zz * ahead;
        real middle_y = p.y * REAL(0.5) + dot3(along_y, along_z) / zz * ahead;
        bounds = box_bounds(fmax((real)(bounds.ex - bounds.hx), view->focal_x * (middle_x - half_x) / near + view->center_x),
                            fmin((real)(bounds.ex + bounds.hx), view->focal_x * (middle_x + half_x) / near + view->center_x),
                            fmax((real)(bounds.ey - bounds.hy), view->focal_y * (middle_y - half_y) / near + view->center_y),
                            fmin((real)(bounds.ey + bounds.hy), view->focal_y * (middle_y + half_y) / near + view->center_y));
