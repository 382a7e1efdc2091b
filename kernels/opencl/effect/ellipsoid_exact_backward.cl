// Backward pass of exact 3D Gaussians. With `ellipsoid_term` b and h = q / (D^2 + b q), D and q of the disk: the sums of blend_backward.cl
// are the gradients with respect to n_u, n_v and D of h, which is the rho / 2 of the fragment.
//@ geometry
    vfloat slant;           // h d: finite for the thinnest needles, whose h overflows
//@ geometry_make
    g.slant = c.q * g.inverse_d;
//@ sums
    vfloat ellipsoid_term;
//@ fragment_backward
    sums->ellipsoid_term = FMA(VSELECT((vfloat)0.0f, grad_log, g->on_plane), VSELECT((vfloat)0.0f, g->half_rho * g->half_rho, g->on_plane), sums->ellipsoid_term);
//@ record_gradients
    STORE_SUM(ellipsoid_term, sums->ellipsoid_term);
//@ footprint_add_depth
    {
        // grad_d: gradient with respect to d = D (1 + t); grad_q: twice that with respect to q (1 + t); with t = b q / D^2 = b h / (1 - b h)
        vint ahead = VMASK(g->inverse_d > 0.0f);
        vfloat inverse_d = VSELECT((vfloat)0.0f, g->inverse_d, ahead), hd = VSELECT((vfloat)0.0f, g->slant, ahead);
        vfloat bh = s->ellipsoid_term * inverse_d * hd, rest = max(1.0f - bh, (vfloat)1e-6f), t = bh / rest;
        vfloat grad_both = 2.0f * FMA(grad_q, t, grad_d * s->ellipsoid_term * inverse_d / rest);
        *grad_nu = FMA(grad_both, g->nu, *grad_nu);
        *grad_nv = FMA(grad_both, g->nv, *grad_nv);
        sums->ellipsoid_term = FMA(hd, FMA(0.5f * hd, grad_q, grad_d), sums->ellipsoid_term);
        grad_d = FMA(-t, FMA(hd, grad_q, grad_d), grad_d);
    }
//@ ellipsoid_projection
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
        const real3_ axes[3] = {unit_a, unit_b, unit_normal};
        const real min_length = fmin(fmin(su, sv), sw);
        const int i0 = su >= sv && su >= sw ? 0 : sv >= sw ? 1 : 2, i1 = (i0 + 1) % 3, i2 = (i0 + 2) % 3;
        real g[3], e1[3], e2[3];                    // as in conjugate_disk; g = min_length y
        for (int k = 0; k < 3; k++) g[k] = dot3(axes[k], p) * (min_length / lengths[k]);
        real h = sqrt(g[i1] * g[i1] + g[i2] * g[i2]), m = sqrt(g[i0] * g[i0] + h * h), along = h / m, back = g[i0] / m;
        real k1 = h > 0 ? g[i1] / h : 1, k2 = h > 0 ? g[i2] / h : 0;
        e1[i0] = along; e1[i1] = -back * k1; e1[i2] = -back * k2;
        e2[i0] = 0; e2[i1] = k2; e2[i2] = -k1;
        real inverse_m = min_length / m, grad_e1 = -dot3(p, grad_a) * inverse_m, grad_e2 = -dot3(p, grad_b) * inverse_m;
        real grad_m2 = -4 * total.ellipsoid_term * inverse_m * inverse_m;      // the ellipsoid_term is 2 / m^2
        real3_ grad_axes[3];
        for (int k = 0; k < 3; k++) {
            real grad_y = (grad_e1 * e1[k] + grad_e2 * e2[k] + grad_m2 * (g[k] / m)) * inverse_m / lengths[k];  // by y_k, over lengths[k]
            grad_p = add3(grad_p, scaled(grad_y, axes[k]));
            real3_ turned = add3(p, scaled(-2 * dot3(axes[k], p), axes[k]));
            grad_axes[k] = add3(add3(scaled(e1[k], grad_a), scaled(e2[k], grad_b)), scaled(grad_y / lengths[k], turned));
        }
        grad_a = grad_axes[0];
        grad_b = grad_axes[1];
        grad_c = grad_axes[2];
    }
//@ footprint_backward
    if (THICK_HERE) {
        across_x = grad_p.x / view->focal_x * view->width;
        across_y = grad_p.y / view->focal_y * view->height;
        splat_grad.grad2d = (float)(REAL(0.5) * pz * sqrt(across_x * across_x + across_y * across_y));
    }
