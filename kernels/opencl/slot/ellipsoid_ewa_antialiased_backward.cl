// Backward pass of the opacity compensation.
//@ ewa_opacity_backward
        by_determinant2 = REAL(0.5) * by_log / wide_image.determinant2;
        by_grown -= REAL(0.5) * by_log / wide_image.grown;
