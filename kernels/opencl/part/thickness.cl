// Which splats are 3D Gaussians: those with a standard deviation along the normal too.
//@ footprint_here
#define THICK_HERE (thickness[i] > 0.0f)
#define THICKNESS_HERE ((real)fmax(thickness[i], MIN_SCALE))
