// Backward pass of exact 3D Gaussians. With `bulge` b and h = q / (D^2 + b q), D and q of the disk: the sums of blend_backward.cl
// are the gradients with respect to n_u, n_v and D of h, which is the rho / 2 of the fragment.
//@ geometry
    vfloat slant;           // h d: finite for the thinnest needles, whose h overflows
//@ geometry_make
    g.slant = c.q * g.inverse_d;
//@ sums
    vfloat bulge;
//@ fragment_backward
    sums->bulge = FMA(VSELECT((vfloat)0.0f, by_log, g->on_plane), VSELECT((vfloat)0.0f, g->half_rho * g->half_rho, g->on_plane), sums->bulge);
//@ moments
    MOMENT(bulge, sums->bulge);
//@ footprint_add_depth
    {
        // by_d: gradient with respect to d = D (1 + t); by_q: twice that with respect to q (1 + t); with t = b q / D^2 = b h / (1 - b h)
        vint ahead = VMASK(g->inverse_d > 0.0f);
        vfloat inverse_d = VSELECT((vfloat)0.0f, g->inverse_d, ahead), hd = VSELECT((vfloat)0.0f, g->slant, ahead);
        vfloat bh = s->bulge * inverse_d * hd, rest = max(1.0f - bh, (vfloat)1e-6f), t = bh / rest;
        vfloat by_both = 2.0f * FMA(by_q, t, by_d * s->bulge * inverse_d / rest);
        *by_nu = FMA(by_both, g->nu, *by_nu);
        *by_nv = FMA(by_both, g->nv, *by_nv);
        sums->bulge = FMA(hd, FMA(0.5f * hd, by_q, by_d), sums->bulge);
        by_d = FMA(-t, FMA(hd, by_q, by_d), by_d);
    }
//@ ellipsoid_set_up
    const real lengths[3] = {su, sv, sw};
    if (THICK_HERE) {
        real3_ plane;
        real area;
        conjugate_disk(p, c, lengths, &a, &b, &plane, &area);
        offset = dot3(plane, p);
    }
//@ ellipsoid_backward
    if (THICK_HERE) {
        // a, b and p / m are the images of unit vectors e1, e2, e3 under V, whose columns are the scaled axes; y = V^-1 p = m e3. Only
        // a a^T + b b^T counts, so that e1 and e2 rotate with e3.
        const real3_ axes[3] = {unit_a, unit_b, facet};
        const real min_length = fmin(fmin(su, sv), sw);
        const int i0 = su >= sv && su >= sw ? 0 : sv >= sw ? 1 : 2, i1 = (i0 + 1) % 3, i2 = (i0 + 2) % 3;
        real g[3], e1[3], e2[3];                    // as in conjugate_disk; g = min_length y
        for (int k = 0; k < 3; k++) g[k] = dot3(axes[k], p) * (min_length / lengths[k]);
        real h = sqrt(g[i1] * g[i1] + g[i2] * g[i2]), m = sqrt(g[i0] * g[i0] + h * h), along = h / m, back = g[i0] / m;
        real k1 = h > 0 ? g[i1] / h : 1, k2 = h > 0 ? g[i2] / h : 0;
        e1[i0] = along; e1[i1] = -back * k1; e1[i2] = -back * k2;
        e2[i0] = 0; e2[i1] = k2; e2[i2] = -k1;
        real inverse_m = min_length / m, by_e1 = -dot3(p, by_a) * inverse_m, by_e2 = -dot3(p, by_b) * inverse_m;
        real by_m2 = -4 * total.bulge * inverse_m * inverse_m;      // the bulge is 2 / m^2
        real3_ by_axes[3];
        for (int k = 0; k < 3; k++) {
            real by_y = (by_e1 * e1[k] + by_e2 * e2[k] + by_m2 * (g[k] / m)) * inverse_m / lengths[k];  // by y_k, over lengths[k]
            by_p = add3(by_p, scaled(by_y, axes[k]));
            real3_ turned = add3(p, scaled(-2 * dot3(axes[k], p), axes[k]));
            by_axes[k] = add3(add3(scaled(e1[k], by_a), scaled(e2[k], by_b)), scaled(by_y / lengths[k], turned));
        }
        by_a = by_axes[0];
        by_b = by_axes[1];
        by_c = by_axes[2];
    }
//@ footprint_backward
    if (THICK_HERE) {
        across_x = by_p.x / view->focal_x * view->width;
        across_y = by_p.y / view->focal_y * view->height;
        own.screen = (float)(REAL(0.5) * pz * sqrt(across_x * across_x + across_y * across_y));
    }
