// alpha = 1 - T: light that goes on is worth as much less.
//@ pixel_gradient_start
        gradient->behind -= pixels_of(by_alpha, 1, 0, x, y, width, height);
