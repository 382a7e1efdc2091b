// Every splat is a Gaussian, as 2DGS has them.
