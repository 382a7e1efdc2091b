// 3D Gaussians: splats with a nonzero standard deviation along the normal.
//@ footprint_here
#define THICK_HERE (thickness[i] > 0.0f)
#define THICKNESS_HERE ((real)fmax(thickness[i], MIN_SCALE))
