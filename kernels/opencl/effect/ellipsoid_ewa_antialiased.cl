// Opacity compensation of Mip-Splatting (Yu et al. 2024, eq. 9; gsplat's rasterize_mode "antialiased") for the area added by widening.
//@ ewa_opacity
        log_opacity += (blend_real)(REAL(0.5) * ln(wide_image.determinant2 / wide_image.grown));
        half_r2 = log_opacity - (blend_real)view->log_alpha_cutoff;
        if (!(half_r2 > 0.0f)) return;
