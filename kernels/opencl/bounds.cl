// Conservative screen-space bounds of a splat: the ellipse of the R-sigma disk (a box where the disk crosses the near plane)
// and, by hook, the support of the low-pass filter. The per-pixel test is exact.

//@@ struct Bounds
// Margin for the rounding of the float fields and of the per-pixel test, in samples.
#define BOUNDS_PAD 0.02f
#define BOUNDS_PAD_RELATIVE 2e-4f

// Row of M of an image axis (OpenCV axes), relative to an anchor on it; offset: principal point minus anchor.
static inline real3_ image_row(real focal, real offset, real3_ axis_row, real3_ z_row) {
    real3_ row = {focal * axis_row.x + offset * z_row.x, focal * axis_row.y + offset * z_row.y,
                  focal * axis_row.z + offset * z_row.z};
    return row;
}

static inline Bounds box_bounds(real x0, real x1, real y0, real y1) {
    Bounds b;
    b.ex = (float)((x0 + x1) * REAL(0.5));
    b.ey = (float)((y0 + y1) * REAL(0.5));
    b.hx = (float)((x1 - x0) * REAL(0.5)) * (1.0f + BOUNDS_PAD_RELATIVE) + BOUNDS_PAD;
    b.hy = (float)((y1 - y0) * REAL(0.5)) * (1.0f + BOUNDS_PAD_RELATIVE) + BOUNDS_PAD;
    b.slope = 0;
    b.half_width = b.hx;
    b.inverse_hy2 = 0;
    b.tip = 0;
    return b;
}

// Projected ellipse of an R-sigma disk in front of the near plane, from its dual conic about the projected centre. tu, tv are
// relative to the projected centre (their z is 0).
INLINE Bounds ellipse_bounds(real3_ tu, real3_ tv, real3_ tw, real center_x, real center_y, real r2) {
    real d = r2 * (tw.x * tw.x + tw.y * tw.y) - tw.z * tw.z;   // < 0
    real r2_d = r2 / d;
    real mx = r2_d * (tu.x * tw.x + tu.y * tw.y);
    real my = r2_d * (tv.x * tw.x + tv.y * tw.y);
    real qxx = fmax(mx * mx - r2_d * (tu.x * tu.x + tu.y * tu.y), REAL(0.0));
    real qyy = fmax(my * my - r2_d * (tv.x * tv.x + tv.y * tv.y), REAL(0.0));
    real qxy = mx * my - r2_d * (tu.x * tv.x + tu.y * tv.y);
    real hx = sqrt(qxx), hy = sqrt(qyy);
    Bounds b;
    b.ex = (float)(center_x + mx);
    b.ey = (float)(center_y + my);
    b.hx = (float)hx * (1.0f + BOUNDS_PAD_RELATIVE) + BOUNDS_PAD;
    b.hy = (float)hy * (1.0f + BOUNDS_PAD_RELATIVE) + BOUNDS_PAD;
    real shear = qyy > 0 ? qxy / qyy : 0;
    b.slope = (float)shear;
    // the padded width also covers the shift of a sheared chord when the height is padded
    float across = (float)sqrt(fmax(qxx - qxy * shear, REAL(0.0)));
    b.half_width = across * (1.0f + BOUNDS_PAD_RELATIVE) + BOUNDS_PAD + BOUNDS_PAD_RELATIVE * (float)hx
                   + BOUNDS_PAD * fabs(b.slope);
    b.inverse_hy2 = 1.0f / (b.hy * b.hy);
    b.tip = hx > 0 ? (float)(qxy / hx) : 0.0f;
    return b;
}

// Columns [*x0, *x1] that the bounds cover in rows from y0 to y1; empty if *x0 > *x1.
INLINE void bounds_span(const Bounds *b, float y0, float y1, float *x0, float *x1) {
    *x0 = INFINITY;
    *x1 = -INFINITY;
    float low = fmax(y0 - b->ey, -b->hy), high = fmin(y1 - b->ey, b->hy);
    if (low <= high) {
        // 4e-7: margin for rounding, since 1 - y^2 / hy^2 (y: right or left) cancels where |y| is close to hy
        float right = clamp(b->tip, low, high), left = clamp(-b->tip, low, high);
        float wr = FAST_SQRT(fmax(1.0f - right * right * b->inverse_hy2, 0.0f) + 4e-7f);
        float wl = FAST_SQRT(fmax(1.0f - left * left * b->inverse_hy2, 0.0f) + 4e-7f);
        *x1 = b->ex + fmin(FMA(b->slope, right, b->half_width * wr), b->hx);
        *x0 = b->ex + fmax(FMA(b->slope, left, -b->half_width * wl), -b->hx);
    }
//@@ bounds_span
}

// Rows of samples [*y0, *y1) whose centres are inside the bounds.
INLINE void bounds_rows(const Bounds *b, int height, int *y0, int *y1) {
    float low = b->ey - b->hy, high = b->ey + b->hy;
//@@ bounds_rows
    *y0 = max(pixel_above(low - 0.5f, height), 0);
    *y1 = min(pixel_below(high - 0.5f, height) + 1, height);
}

typedef struct { int first, last; } TileSpan;   // inclusive; empty if first > last

// Tiles in one row of tiles that the bounds overlap. Counting and listing both call this, so they agree.
INLINE TileSpan tile_span(const Bounds *b, int tile_row, int width, int height) {
    float y0 = (float)(tile_row * TILE_H) + 0.5f, y1 = (float)min(tile_row * TILE_H + TILE_H, height) - 0.5f;
    float x0, x1;
    bounds_span(b, y0, y1, &x0, &x1);
    int first = max(pixel_above(x0 - 0.5f, width), 0), last = min(pixel_below(x1 - 0.5f, width), width - 1);
    TileSpan span = {first / TILE_W, first <= last ? last / TILE_W : -1};
    return span;
}

#define WINDOW_W 8
#define WINDOW_H 4
#if SPLATS_PER_ITEM > 1       // a constant number of rows, for vectors across splats
#define WINDOW_ROWS(rows) WINDOW_H
#else
#define WINDOW_ROWS(rows) rows
#endif

// Tiles that the bounds overlap, as bits of a window of WINDOW_W x WINDOW_H tiles with its corner at tile
// (*corner & 0xFFFF, *corner >> 16); 0 if they do not fit into a window. Columns [x0, x1) and rows [y0, y1) enclose the bounds.
INLINE uint tile_window(const Bounds *b, int x0, int x1, int y0, int y1, int width, int height, uint *corner) {
    int left = x0 / TILE_W, columns = (x1 - 1) / TILE_W - left + 1;
    int top = y0 / TILE_H, rows = (y1 - 1) / TILE_H - top + 1;
    *corner = (uint)left | (uint)top << 16;
    if (rows > WINDOW_H || columns > WINDOW_W) return 0;
    if (rows == 1) return (1u << columns) - 1u;
    if (columns == 1) return 0x01010101u >> (WINDOW_W * (WINDOW_H - rows));
    uint mask = 0;
    UNROLLED for (int row = 0; row < WINDOW_ROWS(rows); row++) {
        TileSpan span = tile_span(b, top + row, width, height);
        // a chord between two rows of pixels may be wider than the chords at the rows
        int first = max(span.first - left, 0), last = min(span.last - left, columns - 1);
        if (first <= last) mask |= ((2u << (last - first)) - 1u) << first << (row * WINDOW_W);
    }
#if SPLATS_PER_ITEM > 1
    mask &= 0xFFFFFFFFu >> (WINDOW_W * (WINDOW_H - rows));
#endif
    return mask;
}

// Tile of the lowest bit of a window (corner, bits).
static inline int window_tile(uint2 window, int tiles_x) {
    int bit = 31 - clz(window.y & -window.y);
    return (int)(window.x >> 16) * tiles_x + (int)(window.x & 0xFFFFu) + bit / WINDOW_W * tiles_x + bit % WINDOW_W;
}
