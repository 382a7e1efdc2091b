// Gradient of alpha = 1 - T.
//@ pixel_gradient_start
        gradient->behind -= pixels_of(grad_alpha, 1, 0, x, y, width, height);
