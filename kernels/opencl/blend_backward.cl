// Backward pass of compositing, per fragment. A loss L depends on a pixel's colour
//   C = sum_k T_k alpha_k c_k + T_end C_behind,   T_k = prod_{j<k} (1 - alpha_j).
// With g = dL / dC and B_k = the gradient with respect to the transmittance behind fragment k, back to front:
//   B_end = g C_behind,   B_k-1 = B_k + alpha_k (g c_k - B_k),   dL / d alpha_k = T_k (g c_k - B_k).
// Nothing is divided by 1 - alpha, so opaque fragments need no special case.
// The schedules (schedule/*_backward.cl) process a tile's list forward for T, with the arithmetic and decisions of blending, and
// then backward, SEGMENT splats at a time.

//@@ blend_types
typedef struct {            // uniforms of the blend stage
    blend_real log_alpha_cutoff, opacity_ceiling, transmittance_stop, sample_area;
    float log_ceiling;
} BlendConstants;

typedef struct {
    vfloat t;               // transmittance in front of the next fragment
//@@ state
} Pixel;

static inline void pixel_start(Pixel *pixel, vfloat transmittance) {
    pixel->t = transmittance;
//@@ start
}

// Argument of `pixel_start` that continues from this pixel.
static inline vfloat pixel_transmittance(const Pixel *pixel) {
    vfloat transmittance = pixel->t;
//@@ transmittance
    return transmittance;
}

//@@ fragment_mask
//@@ fragment_half_rho
//@@ fragment_branch

// Composited alpha of a fragment; attenuates the pixel's transmittance by it.
static inline vfloat attenuate(Pixel *pixel, vfloat alpha, vint mask, const BlendConstants *constants) {
    vint live = mask & VMASK(pixel->t > constants->transmittance_stop);
//@@ stop
    vfloat composited = VSELECT((vfloat)0.0f, alpha, live);
    pixel->t = pixel->t - pixel->t * composited;
    return composited;
}

typedef struct {            // gradient of the loss with respect to one pixel
    vfloat r, g, b;         // of the colour
    vfloat behind;          // B_k of the recursion at the top of this file
//@@ pixel_gradient
} PixelGradient;

// Pixels of a block at (x, y) of an image (h, w, channels); 0 outside of it.
static inline vfloat pixels_of(global const float *image, int channels, int channel, int x, int y, int width, int height) {
    float block[LANES];
#if LANES > 1
    if (x + BLOCK_W <= width && y + LANES / BLOCK_W <= height) {    // no test per pixel
        image += channels * (y * (size_t)width + x) + channel;
        for (int lane = 0; lane < LANES; lane++) block[lane] = image[channels * (lane / BLOCK_W * width + lane % BLOCK_W)];
        return VLOAD(block);
    }
#endif
    for (int lane = 0; lane < LANES; lane++) {
        int px = x + lane % BLOCK_W, py = y + lane / BLOCK_W;
        block[lane] = px < width && py < height ? image[channels * (py * (size_t)width + px) + channel] : 0.0f;
    }
    return VLOAD(block);
}

typedef struct {            // sums over the fragments of a lane
    vfloat nu, nu_x, nu_y, nv, nv_x, nv_y, d, d_x, d_y;
    vfloat log_opacity, r, g, b;
//@@ sums
} Sums;

typedef struct {
    vfloat nu, nv, inverse_d;
    vfloat half_rho;        // valid where `on_plane`
    vint on_plane;          // the weight comes from the plane intersection, not from the low-pass disc
//@@ geometry
} Geometry;

//@@ fragment_functions
// Position of the fragment on the splat's plane, from the row's forms and the low-pass distance.
static inline Geometry geometry_of(const Splat *s, Intersection c, vfloat nu_x, vfloat nv_x, vfloat y, vfloat lowpass_half_rho) {
    Geometry g;
    g.nu = FMA((vfloat)s->nuy, y, nu_x);
    g.nv = FMA((vfloat)s->nvy, y, nv_x);
    g.inverse_d = VSELECT((vfloat)0.0f, 1.0f / c.d, VMASK(c.d > 0.0f));
    g.half_rho = (c.q * g.inverse_d) * g.inverse_d;
    g.on_plane = fragment_on_plane(s, c, g.half_rho, lowpass_half_rho);
//@@ geometry_make
    return g;
}

// Gradient with respect to the fragment's weight: g c_k.
static inline vfloat fragment_grad_weight(const Splat *s, const PixelGradient *gradient, const Geometry *g) {
    vfloat grad_weight = FMA(gradient->r, (vfloat)s->r, FMA(gradient->g, (vfloat)s->g, gradient->b * s->b));
//@@ grad_weight
    return grad_weight;
}

// dL / d ln(alpha) of a fragment with this weight; also dL / d ln(opacity), unless the opacity ceiling applies.
static inline vfloat backward_alpha(PixelGradient *gradient, vfloat grad_weight, vfloat weight, vfloat alpha) {
    vfloat gain = grad_weight - gradient->behind;
    gradient->behind = FMA(alpha, gain, gradient->behind);
    return weight * gain;
}

// Adds the gradients of a fragment. grad_log: with respect to ln(alpha); (x, y): sample relative to the splat's anchor pixel (splat.cl).
static inline void add_fragment(Sums *sums, const Splat *s, const PixelGradient *gradient, const Geometry *g, vfloat weight, vfloat grad_log,
                                vfloat lowpass_half_rho, vfloat x, vfloat y, const BlendConstants *constants) {
    sums->r = FMA(weight, gradient->r, sums->r);
    sums->g = FMA(weight, gradient->g, sums->g);
    sums->b = FMA(weight, gradient->b, sums->b);
    vfloat half_rho = VSELECT(lowpass_half_rho, g->half_rho, g->on_plane);
    grad_log = VSELECT((vfloat)0.0f, grad_log, VMASK(s->log_opacity - half_rho <= constants->log_ceiling));
    sums->log_opacity += grad_log;
    vfloat plane = 2.0f * VSELECT((vfloat)0.0f, grad_log * g->inverse_d, g->on_plane);
    vfloat grad_nu = -plane * g->nu * g->inverse_d, grad_nv = -plane * g->nv * g->inverse_d;
    vfloat grad_d = VSELECT((vfloat)0.0f, plane * g->half_rho, g->on_plane);
//@@ fragment_backward
    sums->nu += grad_nu;
    sums->nu_x = FMA(grad_nu, x, sums->nu_x);
    sums->nu_y = FMA(grad_nu, y, sums->nu_y);
    sums->nv += grad_nv;
    sums->nv_x = FMA(grad_nv, x, sums->nv_x);
    sums->nv_y = FMA(grad_nv, y, sums->nv_y);
    sums->d += grad_d;
    sums->d_x = FMA(grad_d, x, sums->d_x);
    sums->d_y = FMA(grad_d, y, sums->d_y);
}

#if LANES == 16
static inline float lane_sum(vfloat v) {
    float8 w = v.lo + v.hi;
    float4 x = w.lo + w.hi;
    return (x.x + x.z) + (x.y + x.w);
}
// Sums over the lanes of several vectors, in one vector.
#define FOLD_HALVES(a, b) ((vfloat)((a).lo + (a).hi, (b).lo + (b).hi))
#define FOLD_FOURS(a, b) ((vfloat)((a).lo.lo, (a).hi.lo, (b).lo.lo, (b).hi.lo) + (vfloat)((a).lo.hi, (a).hi.hi, (b).lo.hi, (b).hi.hi))
#define FOLD_TWOS(a, b) ((vfloat)((a).s014589cd, (b).s014589cd) + (vfloat)((a).s2367abef, (b).s2367abef))
#define FOLD_ONES(a, b) ((vfloat)((a).even, (b).even) + (vfloat)((a).odd, (b).odd))
static inline vfloat lane_sums_of_8(const vfloat *v) {
    vfloat a = FOLD_FOURS(FOLD_HALVES(v[0], v[1]), FOLD_HALVES(v[2], v[3])),
           b = FOLD_FOURS(FOLD_HALVES(v[4], v[5]), FOLD_HALVES(v[6], v[7]));
    return FOLD_TWOS(a, b);
}
static inline vfloat lane_sums(const vfloat *v) { return FOLD_ONES(lane_sums_of_8(v), lane_sums_of_8(v + 8)); }
#elif LANES == 8
static inline float lane_sum(vfloat v) {
    float4 x = v.lo + v.hi;
    return (x.x + x.z) + (x.y + x.w);
}
#elif LANES == 4
static inline float lane_sum(vfloat x) { return (x.x + x.z) + (x.y + x.w); }
#else
#define lane_sum(x) (x)
#endif

// Values of RecordGradient before the sum over lanes, or their sums.
#if LANES == 16
typedef struct {
    vfloat fields[(FIELDS + LANES - 1) / LANES * LANES];
} Parts;
#define STORE_SUM(field, parts) (m.fields[__builtin_offsetof(RecordGradient, field) / sizeof(float)] = (parts))
#else
typedef RecordGradient Parts;
#define STORE_SUM(field, parts) (m.field = lane_sum(parts))
#endif

static inline Parts record_gradient_of(const Sums *sums, const BlendConstants *constants) {
    Parts m = {0};          // zeroes the padding too
    STORE_SUM(nu0, sums->nu);
    STORE_SUM(nux, sums->nu_x);
    STORE_SUM(nuy, sums->nu_y);
    STORE_SUM(nv0, sums->nv);
    STORE_SUM(nvx, sums->nv_x);
    STORE_SUM(nvy, sums->nv_y);
    STORE_SUM(d0, sums->d);
    STORE_SUM(dx, sums->d_x);
    STORE_SUM(dy, sums->d_y);
    STORE_SUM(log_opacity, sums->log_opacity);
    STORE_SUM(r, sums->r);
    STORE_SUM(g, sums->g);
    STORE_SUM(b, sums->b);
//@@ record_gradients
    return m;
}

// Rank of a tile among those of a window, row by row.
static inline uint window_rank(uint2 window, int column, int row) {
    int bit = (row - (int)(window.x >> 16)) * WINDOW_W + column - (int)(window.x & 0xFFFFu);
    return popcount(window.y & ((1u << bit) - 1u));
}

// Rank of a tile among those of a splat, row by row.
#if LANES > 1
// big_rows: from reserve_gradients, row by row, for locality within a tile.
static inline uint tile_rank(uint2 window, uint big_capacity, global const uint *big_rows, int column, int row) {
    return window.y != 0 ? window_rank(window, column, row) : big_rows[row * (size_t)big_capacity + window.x] + column;
}
#else
static inline uint tile_rank(uint2 window, global const Bounds *big_bounds, int column, int row, int width, int height) {
    if (window.y != 0) return window_rank(window, column, row);
    const Bounds b = big_bounds[window.x];
    int y0, y1;
    bounds_rows(&b, height, &y0, &y1);
    uint rank = column - tile_span(&b, row, width, height).first;
    for (int above = y0 / TILE_H; above < row; above++) {
        TileSpan span = tile_span(&b, above, width, height);
        rank += max(span.last - span.first + 1, 0);
    }
    return rank;
}
#endif

#if LANES > 1
// For each row of tiles of a big splat: number of tiles in the rows above, minus its first column.
static inline void put_rows(global uint *rows, uint stride, const Bounds *b, int width, int height) {
    int y0, y1;
    bounds_rows(b, height, &y0, &y1);
    uint above = 0;
    for (int row = y0 / TILE_H; row * TILE_H < y1; row++) {
        TileSpan span = tile_span(b, row, width, height);
        rows[row * (size_t)stride] = above - (uint)span.first;
        above += max(span.last - span.first + 1, 0);
    }
}
#endif

// Reserves a gradient buffer offset for each tile of each visible splat. Offsets depend on the order in which work-groups run; the sums
// of gradients do not.
// Index space: one work-item per splat, in groups of RESERVE_ITEMS.
// Reads: keys, windows, big_bounds. Writes: gradient_offsets, big_rows; adds to reserved.
#define RESERVE_ITEMS 64
kernel __attribute__((reqd_work_group_size(RESERVE_ITEMS, 1, 1))) void reserve_gradients(
//@@ arguments reserve_gradients
) {
    local uint needed, first;
    uint i = get_global_id(0), offset = 0;
    if (get_local_id(0) == 0) needed = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (i < count && keys[i] < OUT_OF_BAND)
        offset = atomic_add(&needed, tile_count(windows[i], big_capacity, big_bounds, width, height));
#if LANES > 1
    if (i < count && keys[i] < OUT_OF_BAND && windows[i].y == 0 && windows[i].x < big_capacity) {
        const Bounds b = big_bounds[windows[i].x];
        put_rows(big_rows + windows[i].x, big_capacity, &b, width, height);
    }
#endif
    barrier(CLK_LOCAL_MEM_FENCE);
    if (get_local_id(0) == 0) first = atomic_add(reserved, needed);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (i < count) gradient_offsets[i] = first + offset;
}
