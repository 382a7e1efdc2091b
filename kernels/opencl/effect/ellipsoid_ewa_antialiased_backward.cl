// Backward pass of the opacity compensation.
//@ ewa_opacity_backward
        grad_determinant2 = REAL(0.5) * grad_log / wide_image.determinant2;
        grad_grown -= REAL(0.5) * grad_log / wide_image.grown;
