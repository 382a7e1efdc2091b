// alpha = 1 - T: light that goes on is worth as much less.
//@ loss_start
        loss->behind -= pixels_of(by_alpha, 1, 0, x, y, width, height);
