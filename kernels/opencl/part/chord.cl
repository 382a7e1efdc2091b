// Chords of an ellipse: the columns in which some rows of samples overlap it (`conic_of`).
//@ cells_functions
#define CONIC_SLACK 2e-5f

typedef struct {                        // an ellipse, relative to the splat's anchor
    bool valid;                            // false: no ellipse, or the horizon is near, or the splat is edge-on to rows or columns
    float middle, slope;                // midpoints of chords: middle + slope y
    float y, half_height;               // row of the centre; the ellipse covers y - half_height to y + half_height
    float square, bend;                 // squared half chord of a row: square - bend (row - y)^2
    float tip;                          // row of the rightmost point minus y
    float pad;
} Conic;

static inline float conic_half_chord(const Conic *c, float y) {
    float above = y - c->y;
    return FAST_SQRT(fmax(c->square - c->bend * above * above, 0.0f)) + c->pad;
}

// Chord of the rows from y0 to y1.
static inline void conic_chord(const Conic *c, float y0, float y1, float *x0, float *x1) {
    if (!c->valid) return;
    if (y0 - c->y > c->half_height || c->y - y1 > c->half_height) {
        *x0 = INFINITY;
        *x1 = -INFINITY;
        return;
    }
    float left = clamp(c->y - c->tip, y0, y1), right = clamp(c->y + c->tip, y0, y1);
    *x0 = c->middle + c->slope * left - conic_half_chord(c, left);
    *x1 = c->middle + c->slope * right + conic_half_chord(c, right);
}
//@ cells_row
            conic_chord(&conic, y0, y1, &low, &high);
