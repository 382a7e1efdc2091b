// 3D Gaussians by their maximum along each ray (devlog/primitives.md). Let W whiten the covariance, p be the centre, m = |W p|, and
// t the angle between W p and W r for a ray r from the camera. The minimum squared distance on the ray is rho = (m sin t)^2. The
// ray intersects the disk through p that is perpendicular to W p after whitening at rho_disk = (m tan t)^2. The Gaussian is thus
// rendered as that disk, whose tangents a, b and p / m are conjugate semi-axes of the ellipsoid, with
//     rho = rho_disk / (1 + rho_disk / m^2),   depth = depth of the disk / (1 + rho_disk / m^2).
// m is the only additional field of the record. Nothing cancels for needles, for flat Gaussians (m large: disks) or at a
// distance. The cone around the R-ellipsoid touches the disk of radius R / sqrt(1 - R^2 / m^2).
//@ functions
// From scaled axes a, b, c of lengths `lengths`: tangents, unit normal and area |a x b| of the disk for the ray `towards`. Returns
// 1 / m, or infinity if there is no such disk.
static inline real conjugate_disk(real3_ towards, real3_ c, const real *lengths, real3_ *a, real3_ *b, real3_ *unit_normal, real *area) {
    real3_ axes[3] = {*a, *b, c};
    // starting with the longest axis, which avoids cancellation
    int i0 = lengths[0] >= lengths[1] && lengths[0] >= lengths[2] ? 0 : lengths[1] >= lengths[2] ? 1 : 2;
    int i1 = (i0 + 1) % 3, i2 = (i0 + 2) % 3;
    real3_ e0 = axes[i0], e1 = axes[i1], e2 = axes[i2];
    real s0 = lengths[i0], s1 = lengths[i1], s2 = lengths[i2], min_length = fmin(s1, s2);
    real w0 = min_length / s0, w1 = min_length / s1, w2 = min_length / s2;
    // W `towards`, scaled by `min_length` against overflow and underflow
    real g0 = dot3(e0, towards) / s0 * w0, g1 = dot3(e1, towards) / s1 * w1, g2 = dot3(e2, towards) / s2 * w2;
    real h = sqrt(g1 * g1 + g2 * g2), m = sqrt(g0 * g0 + h * h);       // `hypot` differs between devices
    if (!(m > 0)) return INFINITY;
    // if `towards` is along the longest axis, any two perpendicular axes are valid
    real along = h / m, back = g0 / m, k1 = h > 0 ? g1 / h : 1, k2 = h > 0 ? g2 / h : 0;
    real3_ u = {e0.x * along - back * (k1 * e1.x + k2 * e2.x), e0.y * along - back * (k1 * e1.y + k2 * e2.y),
                e0.z * along - back * (k1 * e1.z + k2 * e2.z)};
    real3_ v = {k2 * e1.x - k1 * e2.x, k2 * e1.y - k1 * e2.y, k2 * e1.z - k1 * e2.z};
    *a = u;
    *b = v;
    real u0 = g0 * w0 / s0, u1 = g1 * w1 / s1, u2 = g2 * w2 / s2;
    real3_ n = {e0.x * u0 + e1.x * u1 + e2.x * u2, e0.y * u0 + e1.y * u1 + e2.y * u2, e0.z * u0 + e1.z * u1 + e2.z * u2};
    real length = sqrt(dot3(n, n));
    unit_normal->x = n.x / length; unit_normal->y = n.y / length; unit_normal->z = n.z / length;
    *area = s0 * fmax(s1, s2) * m / dot3(*unit_normal, towards);
    return min_length / m;
}
//@ lowpass_make
    real inverse_m2 = 0;                                // 1 / m^2
    real3_ third = {0, 0, 0};                           // semi-axis conjugate to a and b
    if (THICK_HERE) {
        real3_ towards = p;
        bool parallel = false;
//@@ camera_ellipsoid
        const real lengths[3] = {su, sv, THICKNESS_HERE};
        real3_ c = {unit_normal.x * lengths[2], unit_normal.y * lengths[2], unit_normal.z * lengths[2]};
        real area, inverse_m = conjugate_disk(towards, c, lengths, &a, &b, &unit_normal, &area);
        if (!(inverse_m < INFINITY)) return;            // the camera is at the centre
        third.x = towards.x * inverse_m; third.y = towards.y * inverse_m; third.z = towards.z * inverse_m;
        if (!parallel) inverse_m2 = inverse_m * inverse_m;
        offset = dot3(unit_normal, towards);
        su = area;                                      // only the product su * sv is used, and scaled by the low-pass
        sv = 1;
    }
//@ footprint_reach
    const real cutoff_radius = radius;                     // without the cone's widening, which is for bounds
    if (THICK_HERE) {
        reach = radius * sqrt(a.z * a.z + b.z * b.z + third.z * third.z);
//@@ camera_ellipsoid_reach
        // clamped for a camera inside of the ellipsoid; the margin exceeds rounding
        radius /= sqrt(fmax(1 - radius * radius * inverse_m2 - (PROJECTION_FP64 ? REAL(1e-15) : REAL(1e-6)), REAL(1e-12)));
    }
//@ camera_box
    if (THICK_HERE && pz - reach < near) {
//@@ camera_ellipsoid_box
    }
//@ footprint_bounds
    radius = cutoff_radius;
//@ footprint_lowpass
        // the disk's test does not account for fragments of the ellipsoid that `near` removes
        if (THICK_HERE && pz >= near && pz - reach < near) record.lowpass_x = (blend_real)(center_x - anchor_x);
//@ footprint_intersect
    if (s->ellipsoid_term > 0.0f) {
        vfloat squared = FMA((vfloat)s->ellipsoid_term, c.q, c.d * c.d);      // D^2 (1 + rho_disk / m^2)
        c.inside = VMASK(c.q <= half_r2 * squared) & VMASK(c.d > 0.0f) & VMASK(squared <= s->d_near * c.d);
        // expressed as a fragment of a disk: rho / 2 = q / d^2, depth = z_numerator / d
        vfloat inverse = RECIPROCAL(c.d);
        c.d = squared * inverse;
        c.q = c.q * c.d * inverse;
    }
//@ footprint_conic
    // q <= h (D^2 + ellipsoid_term q); near 1 the rounding of the difference exceeds CONIC_SLACK
    if (s->ellipsoid_term > 0.0f) conic_h = (float)s->ellipsoid_term * conic_h < 0.95f ? conic_h / (1.0f - (float)s->ellipsoid_term * conic_h) : INFINITY;
//@ project
    record.ellipsoid_term = (blend_real)(2 * inverse_m2);
