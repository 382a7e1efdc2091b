// 3D Gaussians as in 3DGS (EWA splatting, Zwicker et al. 2001; Kerbl et al. 2023): the projected covariance by the Jacobian at the
// centre, widened by 0.3 square pixels, and the centre's depth, with the constants of gsplat. The projection equals that of a
// disk that faces the camera, so that only the projection has code for it.
//@ functions
typedef struct {            // widened covariance of the projection: its Cholesky factor, and the determinants before and after
    real3_ crossed;
    real determinant2, grown, l11, l21, l22;
} Projected;

static inline Projected widened(real3_ across, real3_ down, real spread) {
    Projected w;
    real xx = dot3(across, across), xy = dot3(across, down), yy = dot3(down, down);
    w.crossed = cross3(across, down);                             // so that the determinant does not cancel
    w.determinant2 = dot3(w.crossed, w.crossed);
    w.grown = w.determinant2 + spread * (xx + yy + spread);
    w.l11 = sqrt(xx + spread);
    w.l21 = xy / w.l11;
    w.l22 = sqrt(w.grown) / w.l11;
    return w;
}
//@ lowpass_make
    if (THICK_HERE) {
        if (!(pz >= near)) return;           // early test of the near plane
        real sw = THICKNESS_HERE;
        real3_ c = {unit_normal.x * sw, unit_normal.y * sw, unit_normal.z * sw}, across, down;    // projected axes [samples]
        real per_x, per_y;                                           // samples per metre at the centre
//@@ camera_image
        const Projected wide_image = widened(across, down, REAL(0.3) / view->sample_area);
//@@ ewa_opacity
        a.x = wide_image.l11 / per_x; a.y = wide_image.l21 / per_y; a.z = 0;
        b.x = 0; b.y = wide_image.l22 / per_y; b.z = 0;
        unit_normal.x = unit_normal.y = 0; unit_normal.z = 1;
        offset = pz;
//@@ camera_offset
        su = a.x;
        sv = b.y;
    }
//@ ellipsoid_normal
    if (THICK_HERE) {
        // Inverse covariance times the ray direction at the centre (ellipsoid_exact.cl): the normal of the surface on which
        // the Gaussian is largest along each ray. Lengths are relative to the shortest axis, so that nothing overflows.
        real3_ first = rotate_to_camera(view, tangent_u), second = rotate_to_camera(view, tangent_v), towards = p;
        bool parallel = false;
//@@ camera_ellipsoid
        real3_ axes[3] = {first, second, cross3(first, second)};
        const real lengths[3] = {fmax(scale_uv.x, MIN_SCALE), fmax(scale_uv.y, MIN_SCALE), THICKNESS_HERE};
        real min_length = fmin(fmin(lengths[0], lengths[1]), lengths[2]);
        real3_ outward = {0, 0, 0};
        for (int k = 0; k < 3; k++) {
            real share = min_length / lengths[k], along = dot3(axes[k], towards) * share * share;
            outward.x += along * axes[k].x; outward.y += along * axes[k].y; outward.z += along * axes[k].z;
        }
        real length = sqrt(dot3(outward, outward));
        unit_normal.x = outward.x / length; unit_normal.y = outward.y / length; unit_normal.z = outward.z / length;
    }
//@ camera_derivative
        if (THICK_HERE) filtered = false;   // EWA has its own low-pass
//@ camera_steepest
    if (THICK_HERE) steepest = fabs(k0.z);  // makes D equal to 1 at all samples
//@ footprint_lowpass_bounds
        if (THICK_HERE) bounds.pr = -1.0f;
//@ footprint_lowpass
        if (THICK_HERE) record.lowpass_x = record.lowpass_y = 1e18f;
