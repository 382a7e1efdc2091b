// Projection: frustum culling, and for each splat the affine forms of the ray-splat intersection (splat.cl), its tile bounds and its
// sort key.
// Index space: one work-item per splat and view. `view` has one record per view; `splats`, `keys` and `windows` have `count` per view.
// Reads:  view, means, quats, scales, opacities, and the inputs of the colour effect and of the outputs.
// Writes: splats[at], windows[at] (tile bits) of visible splats; keys[at]: depth key, CULLED or OUT_OF_BAND; big, big_bounds
//         and their number in counters: splats that overlap more tiles than a window has.
//
// The projection is computed in `real` (double where the device has it) from float inputs.

// Minimum scale [m]: too small to be visible, and large enough that quotients are not float32 denormals.
#define MIN_SCALE 1e-20f

// Bounds of a disk that crosses the near plane: the bounding rectangle of a regular polygon around the R-sigma circle, clipped at the near
// plane and projected. Returns false if nothing is left.
#define POLYGON 16
//@@ polygon
static inline bool clipped_box(real3_ tu, real3_ tv, real3_ tw, real radius, real near, real *box) {
    real around = radius / cos(REAL(3.14159265358979323846) / POLYGON);
    box[0] = box[2] = INFINITY;
    box[1] = box[3] = -INFINITY;
    real u0 = around, v0 = 0, z0 = tw.x * u0 + tw.z;
    for (int k = 1; k <= POLYGON; k++) {
        real angle = REAL(6.28318530717958647692) * k / POLYGON;
        real u1 = around * cos(angle), v1 = around * sin(angle), z1 = tw.x * u1 + tw.y * v1 + tw.z;
        real cut = (near - z0) / (z1 - z0);
        bool crosses = (z0 >= near) != (z1 >= near);
        for (int end = 0; end < 2; end++) {
            if (end == 0 ? !crosses : !(z1 >= near)) continue;
            real u = end == 0 ? u0 + cut * (u1 - u0) : u1, v = end == 0 ? v0 + cut * (v1 - v0) : v1;
            real z = end == 0 ? near : z1;
            real x = (tu.x * u + tu.y * v + tu.z) / z, y = (tv.x * u + tv.y * v + tv.z) / z;
            box[0] = fmin(box[0], x);
            box[1] = fmax(box[1], x);
            box[2] = fmin(box[2], y);
            box[3] = fmax(box[3], y);
        }
        u0 = u1, v0 = v1, z0 = z1;
    }
    return box[0] <= box[1];
}

static inline real3_ rotate_to_camera(global const View *view, real3_ v) {
    global const real *r = view->rotation;
    real3_ c = {r[0] * v.x + r[1] * v.y + r[2] * v.z, r[3] * v.x + r[4] * v.y + r[5] * v.z,
                r[6] * v.x + r[7] * v.y + r[8] * v.z};
    return c;
}

typedef union {
    Splat splat;
    float4 words[sizeof(Splat) / 16];
#if SPLATS_PER_ITEM > 1
    uint scalars[sizeof(Splat) / 4];
#endif
} SplatWords;

//@@ camera
//@@ functions
//@@ footprint_here

#define RETURN_CULLED return
#if SPLATS_PER_ITEM > 1
// CPUs: projection of splat i, written to column k of `batch`, in a loop that compilers vectorise. Splats that cross the near plane need
// the loop over a polygon. It is left out if `crosses_near` is false: such splats get the key CROSSES_NEAR, and are projected again.
#define CROSSES_NEAR 0xFFFFFFFDu
#define KEY batch->keys[k]
typedef struct {
    uint keys[SPLATS_PER_ITEM], corners[SPLATS_PER_ITEM], windows[SPLATS_PER_ITEM], records[sizeof(Splat) / 4][SPLATS_PER_ITEM], bounds[sizeof(Bounds) / 4][SPLATS_PER_ITEM];
} Batch;
typedef union {
    Bounds bounds;
    uint scalars[sizeof(Bounds) / 4];
} BoundsWords;

INLINE void project_splat(
//@@ arguments project
    , uint i, uint view_index, Batch *batch, uint k, bool crosses_near)
#else
#define KEY keys[at]

kernel void project(
//@@ arguments project
)
#endif
{
#if SPLATS_PER_ITEM == 1
    uint i = get_global_id(0), view_index = get_global_id(1);
    if (i >= count) return;
#endif
    uint at = view_index * count + i;
    view += view_index;
    KEY = CULLED;
//@@ unculled
//@@ splat_view

    // read before the first test, so that memory latency is paid once; arrays are aligned for vector loads (Resident)
    real3_ mean = {means[3 * i], means[3 * i + 1], means[3 * i + 2]};
#if SPLATS_PER_ITEM > 1       // scalars: vector types here prevent vectorization across splats
    struct { float x, y, z, w; } quat = {quats[4 * i], quats[4 * i + 1], quats[4 * i + 2], quats[4 * i + 3]};
    struct { float x, y; } scale_uv = {scales[2 * i], scales[2 * i + 1]};
#else
    float4 quat = ((global const float4 *)quats)[i];
    float2 scale_uv = ((global const float2 *)scales)[i];
#endif
    float opacity = opacities[i];
    real3_ p = rotate_to_camera(view, mean);
    p.x += view->translation[0]; p.y += view->translation[1]; p.z += view->translation[2];
    blend_real log_opacity = (blend_real)ln((real)opacity);
    blend_real half_r2 = log_opacity - (blend_real)view->log_alpha_cutoff;
    if (!(half_r2 > 0.0f && opacity > 0.0f && opacity < INFINITY)) return;        // also culls NaN

    // columns of the rotation of an unnormalised quaternion
    real w = quat.x, x = quat.y, y = quat.z, z = quat.w;
    real s = REAL(2.0) / (w * w + x * x + y * y + z * z);
    real3_ tangent_u = {1 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y)};
    real3_ tangent_v = {s * (x * y - w * z), 1 - s * (x * x + z * z), s * (y * z + w * x)};

    real3_ a = rotate_to_camera(view, tangent_u), b = rotate_to_camera(view, tangent_v);
    real pz = p.z, near = view->near;
//@@ camera_depth
    real3_ unit_normal = cross3(a, b);
    real offset = dot3(unit_normal, p);       // signed distance of the plane from the camera centre
//@@ camera_offset
    // tested before fmax, which discards NaN
    if (!(scale_uv.x >= 0.0f && scale_uv.x < INFINITY && scale_uv.y >= 0.0f && scale_uv.y < INFINITY)) return;
    real su = fmax(scale_uv.x, MIN_SCALE), sv = fmax(scale_uv.y, MIN_SCALE);
    a.x *= su; a.y *= su; a.z *= su;
    b.x *= sv; b.y *= sv; b.z *= sv;
//@@ lowpass_make

    // depth range of the disk
    real radius = sqrt(REAL(2.0) * half_r2);
    real reach = radius * sqrt(a.z * a.z + b.z * b.z);
//@@ camera_reach
//@@ footprint_reach
    if (!(pz + reach >= near) || !(pz - reach <= view->far)) return;

    // these hooks declare center_x, center_y (projected centre), bounds, and the rows tu, tv, tw of M
//@@ footprint_spread
//@@ camera_bounds
//@@ camera_box
//@@ footprint_bounds
//@@ bounds_make
    int width = (int)view->width, height = (int)view->height;
    int y0, y1;
    bounds_rows(&bounds, height, &y0, &y1);
    float x0, x1;
    bounds_span(&bounds, (float)y0 + 0.5f, (float)y1 - 0.5f, &x0, &x1);
    // also culls a splat between two columns of samples, and NaN
    int first = pixel_above(x0 - 0.5f, width), last = pixel_below(x1 - 0.5f, width);
    if (!(y0 < y1 && x0 <= x1 && first < width && last >= 0 && first <= last)) return;

    if (y1 <= (int)view->first_row || y0 >= (int)view->end_row) {
        KEY = OUT_OF_BAND;
        return;
    }

    // anchor: the pixel of the image nearest to the centre
    int anchor_i = (int)fmin(fmax((float)center_x, 0.0f), (float)(width - 1));       // 0 for NaN
    int anchor_j = (int)fmin(fmax((float)center_y, 0.0f), (float)(height - 1));
    real anchor_x = anchor_i + REAL(0.5), anchor_y = anchor_j + REAL(0.5);
    // declares k0, kx, ky (n_u, n_v, D: constant, per x, per y), and the determinant of M
//@@ camera_forms
    real steepest = fmax(fmax(fabs(kx.x), fabs(ky.x)), fmax(fabs(kx.y), fabs(ky.y)));
//@@ camera_steepest
    if (!(steepest > 0 && steepest < (real)INFINITY)) return;
    real scale = (determinant < 0 ? -1 : 1) / steepest;
    real n_scale = scale * REAL(0.70710678118654752440);   // so that q / D^2 is rho / 2

    // Edge-on within rounding: the plane has no visible side, and only the low-pass may render the splat. The test depends on the
    // plane only, not on the splat's size or the focal length.
    real facing = fabs(offset) > (PROJECTION_FP64 ? REAL(1e-13) : REAL(1e-6)) * sqrt(dot3(p, p)) ? scale : 0;
//@@ camera_facing
    real z_numerator = determinant * facing;                               // depth = z_numerator / D

    Splat record;
    record.nu0 = (blend_real)(k0.x * n_scale); record.nux = (blend_real)(kx.x * n_scale); record.nuy = (blend_real)(ky.x * n_scale);
    record.nv0 = (blend_real)(k0.y * n_scale); record.nvx = (blend_real)(kx.y * n_scale); record.nvy = (blend_real)(ky.y * n_scale);
    record.d0 = (blend_real)(k0.z * facing); record.dx = (blend_real)(kx.z * facing); record.dy = (blend_real)(ky.z * facing);
    record.d_near = (blend_real)(z_numerator / near);
    record.log_opacity = log_opacity;
    record.ax = (float)anchor_i;
    record.ay = (float)anchor_j;
    record.y0 = (short)y0;
    record.y1 = (short)y1;
    record.x0 = (short)max(first, 0);
    record.x1 = (short)min(last + 1, width);
#if SPLATS_PER_ITEM > 1
//@@ project
    float key = (float)pz;
//@@ key
//@@ coplanar_key
    KEY = sortable(key);
    batch->windows[k] = tile_window(&bounds, record.x0, record.x1, y0, y1, width, height, &batch->corners[k]);
    SplatWords words = {record};
    BoundsWords bounds_words = {bounds};
    UNROLLED for (uint n = 0; n < sizeof(Splat) / 4; n++) batch->records[n][k] = words.scalars[n];
    UNROLLED for (uint n = 0; n < sizeof(Bounds) / 4; n++) batch->bounds[n][k] = bounds_words.scalars[n];
}

static inline Bounds bounds_of(const Batch *batch, uint k) {
    BoundsWords words;
    for (uint n = 0; n < sizeof(Bounds) / 4; n++) words.scalars[n] = batch->bounds[n][k];
    return words.bounds;
}

// Writes the record, window and keys of a projected splat. Hooks write to `record`: here it is the record in memory, without a copy,
// since reading four words that were written one by one would stall.
#define record splats[at]
#define bounds bounds_of(batch, k)
INLINE void write_splat(
//@@ arguments project
    , uint i, uint view_index, const Batch *batch, uint k) {
    uint at = view_index * count + i;
    keys[at] = batch->keys[k];
    if (batch->keys[k] >= OUT_OF_BAND) return;
    view += view_index;
//@@ splat_view
    real3_ mean = {means[3 * i], means[3 * i + 1], means[3 * i + 2]};
    const uint (*word)[SPLATS_PER_ITEM] = batch->records;
    for (uint n = 0; n < sizeof(Splat) / 4; n += 4)
        ((global uint4 *)(splats + at))[n / 4] = (uint4)(word[n][k], word[n + 1][k], word[n + 2][k], word[n + 3][k]);
//@@ color
    uint corner = batch->corners[k], window = batch->windows[k];
#else
//@@ color
//@@ project
    // vector stores
    SplatWords packed = {record};
    for (uint part = 0; part < sizeof(Splat) / 16; part++) ((global float4 *)(splats + at))[part] = packed.words[part];
    uint corner, window = tile_window(&bounds, record.x0, record.x1, y0, y1, width, height, &corner);
#endif
    if (window == 0) {
        // in any order, since lists are sorted later
        corner = atomic_inc(counters + COUNTER_BIG);
        if (corner < big_capacity) {
            big[corner] = at;
            big_bounds[corner] = bounds;
        }
    }
    windows[at] = (uint2)(corner, window);
#if SPLATS_PER_ITEM == 1
//@@ list
    float key = (float)pz;
//@@ key
//@@ coplanar_key
    KEY = sortable(key);
#endif
}

#if SPLATS_PER_ITEM > 1
#undef record
#undef bounds
#endif
#if SPLATS_PER_ITEM > 1 || defined(CULLING_GROUP)
// CULLED or OUT_OF_BAND for a group of splats outside of the frustum; 0: not culled. All centres are within `extent` of `mean`; infinite:
// never culled.
INLINE uint frustum_key(global const View *view, real3_ mean, real extent, real max_scale) {
    real3_ p = rotate_to_camera(view, mean);
    p.x += view->translation[0]; p.y += view->translation[1]; p.z += view->translation[2];
//@@ cull_frustum
    return 0;
}
#endif
//@@ project_kernels
#if SPLATS_PER_ITEM > 1
#undef RETURN_CULLED
#define RETURN_CULLED return CULLED
#ifndef BOX_HERE       // whether splat i is a box (effect/footprint_*.cl)
#define BOX_HERE false
#endif
INLINE uint splat_key(
//@@ arguments project
    , uint i, uint view_index) {
    view += view_index;
//@@ splat_view
    real3_ mean = {means[3 * i], means[3 * i + 1], means[3 * i + 2]};
    real max_scale = fmax(scales[2 * i], scales[2 * i + 1]);
//@@ max_scale
    return frustum_key(view, mean, !BOX_HERE && opacities[i] <= 1.0f ? 0 : INFINITY, max_scale);
}

kernel void project(
//@@ arguments project
) {
    uint view_index = get_global_id(1), first = get_global_id(0) * SPLATS_PER_ITEM, visible[SPLATS_PER_ITEM], length = 0;
    if (first >= count) return;
    Batch batch;
    VECTORISE for (uint k = 0; k < SPLATS_PER_ITEM; k++)
        batch.keys[k] = splat_key(
//@@ passed project
            , min(first + k, count - 1), view_index);
    for (uint k = 0; k < min(count - first, (uint)SPLATS_PER_ITEM); k++) {
        keys[view_index * count + first + k] = batch.keys[k];
        visible[length] = first + k;
        length += batch.keys[k] == 0;
    }
    if (length == 0) return;
    // complete vectors
    uint padded = (length + 7) & ~7u;
    for (uint k = length; k < padded; k++) visible[k] = visible[0];
    VECTORISE for (uint k = 0; k < padded; k++)
        project_splat(
//@@ passed project
            , visible[k], view_index, &batch, k, false);
    for (uint k = 0; k < length; k++) {
        if (batch.keys[k] == CROSSES_NEAR)
            project_splat(
//@@ passed project
                , visible[k], view_index, &batch, k, true);
        write_splat(
//@@ passed project
            , visible[k], view_index, &batch, k);
    }
}
#endif
