// Backward pass of blending for GPUs, in two kernels. `blend_checkpoints` loops over each tile's list once, front to back, and stores a
// checkpoint per pixel and SEGMENT splats: the transmittance in front of them, and the gradient with respect to the one behind. Segments are
// then independent: each work-group of `blend_backward` processes one, so that long lists occupy many groups. Sums over
// work-items are per splat, in a fixed order and without atomics.
// Barriers are only where the complete work-group reaches them.
#define PIXELS (TILE_W * TILE_H)
#define PARTS (GROUP + 1)                    // per field: one more than GROUP, against bank conflicts
#define PREFETCH_CHUNKS 8                       // loaded at once
#define UNROLL 2                            // splats of a cell's list per iteration

static inline Splat copy_of(local const Staged *staged) {
    Staged copy;
    for (int part = 0; part < VECTORS; part++) copy.words[part] = staged->words[part];
    return copy.splat;
}

static inline Intersection intersect_at(const Splat *s, int px, int py, const BlendConstants *constants, blend_real *x, blend_real *y,
                                blend_real *nu_x, blend_real *nv_x, blend_real *half_r2) {
    *x = (blend_real)(px - s->ax);
    *y = (blend_real)(py - s->ay);
    *nu_x = FMA(s->nux, *x, s->nu0);
    *nv_x = FMA(s->nvx, *x, s->nv0);
    *half_r2 = s->log_opacity - constants->log_alpha_cutoff;
    return intersect_row(s, *nu_x, *nv_x, FMA(s->dx, *x, s->d0), *y, *half_r2);
}

typedef struct {            // a splat at a pixel, before transmittance is known
    blend_real alpha, grad_weight;
    int mask;
} FragmentValues;

static inline FragmentValues fragment_values(const Splat *s, int px, int py, const PixelGradient *gradient, const BlendConstants *constants) {
    blend_real x, y, nu_x, nv_x, half_r2, lowpass_half_rho;
    Intersection c = intersect_at(s, px, py, constants, &x, &y, &nu_x, &nv_x, &half_r2);
    FragmentValues values;
    values.mask = fragment_mask(s, c, x, y, half_r2, constants->sample_area, &lowpass_half_rho);
    values.alpha = fragment_alpha(s, fragment_half_rho(s, c, INVERSE_D(c), lowpass_half_rho), constants->opacity_ceiling);
    const Geometry g = geometry_of(s, c, nu_x, nv_x, y, lowpass_half_rho);
    values.grad_weight = fragment_grad_weight(s, gradient, &g);
    return values;
}

// Attenuates a pixel by the splat; returns the alpha there.
static inline blend_real forward_fragment(const Splat *s, int px, int py, Pixel *pixel, const BlendConstants *constants) {
    blend_real x, y, nu_x, nv_x, half_r2, lowpass_half_rho;
    Intersection c = intersect_at(s, px, py, constants, &x, &y, &nu_x, &nv_x, &half_r2);
    int mask = fragment_mask(s, c, x, y, half_r2, constants->sample_area, &lowpass_half_rho);
    if (!VANY(mask)) return 0.0f;
    return attenuate(pixel, fragment_alpha(s, fragment_half_rho(s, c, INVERSE_D(c), lowpass_half_rho), constants->opacity_ceiling), mask, constants);
}

// Index space: work-groups of TILE_W * TILE_H / ROWS, one per tile.
// Reads:  splats, lists, starts[tiles + 1], and the gradients of the images.
// Writes: checkpoints of all pixels ; reached_segments, segment_tiles; background_sums.
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void blend_checkpoints(
//@@ arguments blend_checkpoints
) {
    local Staged staged[STAGED];
    local uint cells[CELLS_Y * CELLS_STRIDE / 4];           // [row of cells][splat]: a byte of bits, one per cell that the splat overlaps
    local uint touched[CELLS_X * CELLS_Y][ITEMS];           // [cell][work-item]: bits of the splats in the work-item's share
    local uchar cell_splats[CELLS_X * CELLS_Y][STAGED];          // [cell]: staged splats that overlap it, in order
    local float parts[3 * PARTS];
    local int alive;
    local uint max_reached;
    const BlendConstants constants = {log_alpha_cutoff, opacity_ceiling, transmittance_stop, sample_area, log_ceiling};
    uint tile_index = get_group_id(0), item = get_local_id(0);
    int tiles_x = (width + TILE_W - 1) / TILE_W;
    int x0 = (int)(tile_index % (uint)tiles_x) * TILE_W, y0 = (int)(tile_index / (uint)tiles_x) * TILE_H;
    uint block = item / 32, part = item % 32 / ITEMS, cell_item = item % ITEMS;
    uint cell_x = block % CELL_W * BLOCK_X + part % BLOCK_X, cell_y = block / CELL_W * CELL_W + part / BLOCK_X;
    uint cell = cell_y * CELLS_X + cell_x;
    int column = (int)(cell_x * CELL_W + cell_item % CELL_W), top = (int)(cell_y * CELL_H + cell_item / CELL_W * ROWS);
    int px = x0 + column, py = y0 + top;
    uint start = starts[tile_index], end = starts[tile_index + 1], first_segment = start / SEGMENT + tile_index;
    for (uint k = first_segment + item; k <= end / SEGMENT + tile_index; k += GROUP) segment_tiles[k] = tile_index;

    PixelGradient gradients[ROWS];
    Pixel pixels[ROWS];
    vfloat transmittances[ROWS], grad_weights[ROWS];
    for (int row = 0; row < ROWS; row++) {
        PixelGradient *gradient = &gradients[row];
        int x = px, y = py + row;
        size_t at = y * (size_t)stride + x;
        gradient->r = pixels_of(grad_rgb, 3, 0, x, y, width, height);
        gradient->g = pixels_of(grad_rgb, 3, 1, x, y, width, height);
        gradient->b = pixels_of(grad_rgb, 3, 2, x, y, width, height);
        gradient->behind = FMA(gradient->r, (vfloat)background_r, FMA(gradient->g, (vfloat)background_g, gradient->b * background_b));
//@@ pixel_gradient_start
        // pixels outside of the image have no transmittance
        pixel_start(&pixels[row], x < width && y < height ? 1.0f : 0.0f);
        transmittances[row] = pixels[row].t;
        grad_weights[row] = 0.0f;
    }
    global float2 *checkpoint = (global float2 *)checkpoints + (size_t)first_segment * PIXELS + top * TILE_W + column;
    uint segment = 0, last_reached = 0;        // current segment; number of segments that transmittance reaches at this work-item's pixels
    if (item == 0) max_reached = 0;
    barrier(CLK_LOCAL_MEM_FENCE);

    for (uint staged_start = start; staged_start < end; staged_start += STAGED) {
        uint length = min(end - staged_start, (uint)STAGED);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item == 0) alive = 0;
        for (uint word = item; word < length * VECTORS; word += GROUP) {
            uint which = word / VECTORS, part = word % VECTORS;
            staged[which].words[part] = ((global const float4 *)(splats + lists[staged_start + which]))[part];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        bool unfinished = false;
        for (int row = 0; row < ROWS; row++) unfinished |= pixels[row].t > transmittance_stop;
        if (unfinished) alive = 1;
        find_cells(staged, length, x0, y0, &constants, cells, touched);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (!alive) break;
        uint listed = list_cell(cells, cell_x, cell_y, cell_item, length, touched[cell], cell_splats[cell]);
        if (!unfinished) listed = 0;
        uint beyond = (staged_start - start + length + SEGMENT - 1) / SEGMENT;      // segments up to the end of the staged splats
        for (uint k = 0; k <= listed; k += UNROLL) {
            // evaluated in parallel, since they do not depend on transmittance; attenuation is sequential
            uint which[UNROLL];
            FragmentValues values[UNROLL][ROWS];
            for (int next = 0; next < UNROLL; next++) {
                which[next] = k + next < listed ? cell_splats[cell][k + next] : 0;
                const Splat s = copy_of(&staged[which[next]]);
                for (int row = 0; row < ROWS; row++) values[next][row] = fragment_values(&s, px, py + row, &gradients[row], &constants);
            }
            for (int next = 0; next < UNROLL; next++) {
                // completed segments
                for (uint to = k + next < listed ? (staged_start - start + which[next]) / SEGMENT : beyond; segment < to; segment++)
                    for (int row = 0; row < ROWS; row++) {
                        checkpoint[(size_t)segment * PIXELS + row * TILE_W] = (float2)(transmittances[row], grad_weights[row]);
                        if (transmittances[row] > transmittance_stop) last_reached = segment + 1;
                        transmittances[row] = pixel_transmittance(&pixels[row]);
                        grad_weights[row] = 0.0f;
                    }
                if (k + next >= listed) break;
                for (int row = 0; row < ROWS; row++) {
                    blend_real transmittance = pixels[row].t;
                    blend_real composited = attenuate(&pixels[row], values[next][row].alpha, values[next][row].mask, &constants);
                    grad_weights[row] = FMA(transmittance * composited, values[next][row].grad_weight, grad_weights[row]);
                }
            }
        }
    }
    atomic_max(&max_reached, last_reached);
    barrier(CLK_LOCAL_MEM_FENCE);
    // gradient with respect to the transmittance behind each segment; for terminated pixels, that of the background
    for (int row = 0; row < ROWS; row++) {
        vfloat behind = gradients[row].behind, transmitted_behind = pixels[row].t * behind;
        for (int last = (int)max_reached - 1; last >= 0; last -= PREFETCH_CHUNKS) {
            float2 loaded[PREFETCH_CHUNKS];
            for (int k = 0; k < PREFETCH_CHUNKS; k++) loaded[k] = checkpoint[(size_t)max(last - k, 0) * PIXELS + row * TILE_W];
            for (int k = 0; k < min(PREFETCH_CHUNKS, last + 1); k++) {
                checkpoint[(size_t)(last - k) * PIXELS + row * TILE_W].y = behind;
                transmitted_behind += loaded[k].y;
                behind = loaded[k].x > transmittance_stop ? transmitted_behind / loaded[k].x : gradients[row].behind;
            }
        }
    }
    float behind_r = 0, behind_g = 0, behind_b = 0;
    for (int row = 0; row < ROWS; row++) {
        behind_r = FMA((float)pixels[row].t, (float)gradients[row].r, behind_r);
        behind_g = FMA((float)pixels[row].t, (float)gradients[row].g, behind_g);
        behind_b = FMA((float)pixels[row].t, (float)gradients[row].b, behind_b);
    }
    parts[item] = behind_r;
    parts[PARTS + item] = behind_g;
    parts[2 * PARTS + item] = behind_b;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) reached_segments[tile_index] = max_reached;
    if (item < 3) {
        real sum = 0;
        for (uint other = 0; other < GROUP; other++) sum += parts[item * PARTS + other];
        background_sums[3 * tile_index + item] = sum;
    }
}

#undef GROUP
#undef PARTS
#define GROUP BACKWARD_ITEMS
#define PARTS (GROUP + 1)
#define PIXELS_PER_ITEM (PIXELS / GROUP)                // pixels per work-item
#define PATCH_W 8                            // of the 32 work-items of a warp
#define PATCH_H (4 * PIXELS_PER_ITEM)
#define PATCHES_X (TILE_W / PATCH_W)
#define PATCHES (PIXELS / (PATCH_W * PATCH_H))
#define SHARE_OF_SPLAT (GROUP / SEGMENT)       // work-items that sum a splat's fragments
#define STRIDE (PIXELS + TILE_W)             // per splat: more than PIXELS, against bank conflicts
#define SCRATCH (2 * SEGMENT * STRIDE > PARTS * FIELDS ? 2 * SEGMENT * STRIDE : PARTS * FIELDS)

// Index space: work-groups of GROUP, one per segment of a tile's list.
// Reads:  splats, lists, starts[tiles + 1], windows, big_bounds, gradient_offsets, checkpoints, reached_segments, segment_tiles, and the gradients
// of the images. Writes: record_gradients of each splat of each tile.
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void blend_backward(
//@@ arguments blend_backward
) {
    local Staged staged[SEGMENT];
    local float scratch[SCRATCH];
    local float2 *fragments = (local float2 *)scratch;      // [splat][pixel]: transmittance, alpha; then weight, gradient of ln(opacity)
    local PixelGradient shared[PIXELS];
    local uint offsets[SEGMENT], within[PATCHES];               // bits: splats whose bounds overlap a patch
    const BlendConstants constants = {log_alpha_cutoff, opacity_ceiling, transmittance_stop, sample_area, log_ceiling};
    uint id = get_group_id(0), item = get_local_id(0);
    int tiles_x = (width + TILE_W - 1) / TILE_W, tiles_y = (height + TILE_H - 1) / TILE_H, tiles = tiles_x * tiles_y;
    if (id >= starts[tiles] / SEGMENT + tiles) return;
    uint tile_index = segment_tiles[id], start = starts[tile_index], end = starts[tile_index + 1];
    uint segment = id - (start / SEGMENT + tile_index), first = start + segment * SEGMENT;
    if (first >= end) return;
    uint count = min(end - first, (uint)SEGMENT);
    int tile_column = (int)(tile_index % (uint)tiles_x), tile_row = (int)(tile_index / (uint)tiles_x);
    int x0 = tile_column * TILE_W, y0 = tile_row * TILE_H;

    for (uint word = item; word < count * VECTORS; word += GROUP) {
        uint which = word / VECTORS, part = word % VECTORS;
        staged[which].words[part] = ((global const float4 *)(splats + lists[first + which]))[part];
    }
    for (uint which = GROUP - 1 - item; which < count; which += GROUP) {
        uint index = lists[first + which];
        offsets[which] = gradient_offsets[index] + tile_rank(windows[index], big_bounds, tile_column, tile_row, width, height);
    }
    if (item < PATCHES) within[item] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (segment >= reached_segments[tile_index]) {          // no transmittance left
        for (uint cell = item; cell < count * FIELDS; cell += GROUP)
            record_gradients[(size_t)offsets[cell / FIELDS] * FIELDS + cell % FIELDS] = 0.0f;
        return;
    }
    for (uint cell = item; cell < PATCHES * count; cell += GROUP) {
        uint patch = cell % PATCHES, which = cell / PATCHES;
        int left = x0 + (int)(patch % PATCHES_X) * PATCH_W, top = y0 + (int)(patch / PATCHES_X) * PATCH_H;
        local const Splat *s = &staged[which].splat;
        if (s->x0 < left + PATCH_W && s->x1 > left && s->y0 < top + PATCH_H && s->y1 > top) atomic_or(&within[patch], 1u << which);
    }
    uint patch = item / 32, in_patch = item % 32;
    int column = (int)(patch % PATCHES_X * PATCH_W + in_patch % PATCH_W), px = x0 + column;
    int top = (int)(patch / PATCHES_X * PATCH_H + in_patch / PATCH_W);
    PixelGradient gradients[PIXELS_PER_ITEM];
    Pixel pixels[PIXELS_PER_ITEM];
    for (int k = 0; k < PIXELS_PER_ITEM; k++) {
        PixelGradient *gradient = &gradients[k];
        int x = px, y = y0 + top + 4 * k;
        size_t at = y * (size_t)stride + x, mine = (top + 4 * k) * TILE_W + column;
        gradient->r = pixels_of(grad_rgb, 3, 0, x, y, width, height);
        gradient->g = pixels_of(grad_rgb, 3, 1, x, y, width, height);
        gradient->b = pixels_of(grad_rgb, 3, 2, x, y, width, height);
        gradient->behind = FMA(gradient->r, (vfloat)background_r, FMA(gradient->g, (vfloat)background_g, gradient->b * background_b));
//@@ pixel_gradient_start
        float2 checkpoint = ((global const float2 *)checkpoints)[(size_t)id * PIXELS + mine];
        gradient->behind = checkpoint.y;
        shared[mine] = *gradient;
        pixel_start(&pixels[k], checkpoint.x);
    }
    barrier(CLK_LOCAL_MEM_FENCE);

    const uint mine = within[patch];
    for (uint bits = mine; bits != 0; bits &= bits - 1) {
        uint which = 31 - clz((int)(bits & -bits));
        const Splat s = copy_of(&staged[which]);
        for (int k = 0; k < PIXELS_PER_ITEM; k++) {
            int y = y0 + top + 4 * k;
            blend_real transmittance = 0.0f, alpha = 0.0f;
            if (pixels[k].t > transmittance_stop && px >= s.x0 && px < s.x1 && y >= s.y0 && y < s.y1) {
                transmittance = pixels[k].t;
                alpha = forward_fragment(&s, px, y, &pixels[k], &constants);
            }
            fragments[which * STRIDE + (top + 4 * k) * TILE_W + column] = (float2)(transmittance, alpha);
        }
    }
    // each work-item reads only what it wrote, but without a barrier NVIDIA's compiler (driver 580) moved the read before the write
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint bits = mine, which; bits != 0; bits ^= 1u << which) {
        which = 31 - clz((int)bits);
        for (int k = 0; k < PIXELS_PER_ITEM; k++) {
            local float2 *at = &fragments[which * STRIDE + (top + 4 * k) * TILE_W + column];
            float2 here = *at;
            if (here.y > 0.0f) {
                const Splat s = staged[which].splat;
                blend_real weight = here.x * here.y, x, y, nu_x, nv_x, half_r2, lowpass_half_rho;
                Intersection c = intersect_at(&s, px, y0 + top + 4 * k, &constants, &x, &y, &nu_x, &nv_x, &half_r2);
                fragment_mask(&s, c, x, y, half_r2, constants.sample_area, &lowpass_half_rho);
                const Geometry g = geometry_of(&s, c, nu_x, nv_x, y, lowpass_half_rho);
                *at = (float2)(weight, backward_alpha(&gradients[k], fragment_grad_weight(&s, &gradients[k], &g), weight, here.y));
            } else
                (*at).x = 0.0f;
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);

    // one column per work-item of a splat; for narrow splats the work-items share a column's rows
    uint which = item / SHARE_OF_SPLAT;
    Sums sums = {0};
    if (which < count) {
        const Splat s = copy_of(&staged[which]);
        int left = max(s.x0 - x0, 0), right = min(s.x1 - x0, TILE_W), below = min(s.y1 - y0, TILE_H), across = right - left;
        int row_step = across > SHARE_OF_SPLAT / 2 ? 1 : across > SHARE_OF_SPLAT / 4 ? 2 : 4, columns = SHARE_OF_SPLAT / row_step;
        int share = item % SHARE_OF_SPLAT, column = left + share % columns;
        for (int row = column < right ? max(s.y0 - y0, 0) + share / columns : below; row < below; row += row_step) {
            uint at = row * TILE_W + column;
            float2 here = fragments[which * STRIDE + at];
            if (here.x == 0.0f) continue;
            blend_real x, y, nu_x, nv_x, half_r2, lowpass_half_rho;
            Intersection c = intersect_at(&s, x0 + column, y0 + row, &constants, &x, &y, &nu_x, &nv_x, &half_r2);
            fragment_mask(&s, c, x, y, half_r2, constants.sample_area, &lowpass_half_rho);
            const Geometry g = geometry_of(&s, c, nu_x, nv_x, y, lowpass_half_rho);
            const PixelGradient gradient = shared[at];
            add_fragment(&sums, &s, &gradient, &g, here.x, here.y, lowpass_half_rho, x, y, &constants);
        }
    }
    const RecordGradient m = record_gradient_of(&sums, &constants);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint field = 0; field < FIELDS; field++) scratch[field * PARTS + item] = ((const float *)&m)[field];
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint cell = item; cell < count * FIELDS; cell += GROUP) {
        uint field = cell % FIELDS, splat = cell / FIELDS;
        float sum = 0;
        for (uint other = 0; other < SHARE_OF_SPLAT; other++) sum += scratch[field * PARTS + splat * SHARE_OF_SPLAT + other];
        record_gradients[(size_t)offsets[splat] * FIELDS + field] = sum;
    }
}
