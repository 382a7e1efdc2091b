// Backward pass of blending for CPUs. Each work-item takes the next unprocessed tile until none is left, so that one tape per
// work-item is enough.
// Index space: one work-item (and work-group) per core.
// Reads:  splats, lists, starts[tiles + 1], windows, big_rows, gradient_offsets, and the gradients of the images.
// Writes: record_gradients of each splat of the tile; background_sums. Reads and overwrites: checkpoints, tapes; reserved[1], the number of tiles that work-items have taken.
// Splats are scattered in memory, so the next ones are prefetched.
#define PREFETCH_SPLATS 8

// A segment is as many splats of a tile's list as fit the tape: at least SEGMENT, at most TAPE_SPLATS.
#define TAPE_SPLATS (8 * SEGMENT)
#define TAPE_FRAGMENTS (SEGMENT * BLOCKS)
#define CHECKPOINT_FLOATS (TILE_W * TILE_H + LANES)        // of a checkpoint: transmittance of each pixel, and the index of the first splat

typedef struct {            // fragments in the order of compositing, block by block
    vfloat transmittance[TAPE_FRAGMENTS], alpha[TAPE_FRAGMENTS];
    uint blocks[TAPE_SPLATS];      // per splat, as bits: blocks with fragments
    uint offsets[TAPE_SPLATS];
    uint length;            // number of blocks
} Tape;

typedef struct {
    int x0, y0;
    float left[BLOCKS], top[BLOCKS];    // corners of its blocks
    const BlendConstants *constants;
} Tile;

typedef struct {            // pixels of a tile's first block, relative to a splat's anchor; integers
    vfloat x, y;
} BlockOrigin;

typedef struct {            // a splat in a block: pixel positions relative to its anchor, and its forms
    vfloat x, y, nu_x, nv_x, lowpass_half_rho;
    vint mask;
    Intersection intersection;
} Block;

static inline BlockOrigin block_origin(const Splat *s, const Tile *tile) {
    const BlockOrigin origin = {(float)(tile->x0 - s->ax) + BLOCK_X, (float)(tile->y0 - s->ay) + BLOCK_Y};
    return origin;
}

static inline Block block_of(const Splat *s, const Tile *tile, const BlockOrigin *origin, int block) {
    Block b;
    blend_real half_r2 = s->log_opacity - tile->constants->log_alpha_cutoff;
    b.x = origin->x + tile->left[block];
    b.y = origin->y + tile->top[block];
    b.nu_x = FMA((vfloat)s->nux, b.x, (vfloat)s->nu0);
    b.nv_x = FMA((vfloat)s->nvx, b.x, (vfloat)s->nv0);
    b.intersection = intersect_row(s, b.nu_x, b.nv_x, FMA((vfloat)s->dx, b.x, (vfloat)s->d0), b.y, half_r2);
    b.mask = fragment_mask(s, b.intersection, b.x, b.y, half_r2, tile->constants->sample_area, &b.lowpass_half_rho);
    return b;
}

// Attenuates the live blocks by the splat and records its fragments on the tape. Returns the blocks that are still live.
static inline uint forward_splat(const Splat *s, const Tile *tile, Pixel *pixels, uint alive, global Tape *tape, uint tape_index) {
    const BlendConstants *constants = tile->constants;
    uint touched = alive & touched_blocks(s, tile->x0, tile->y0, s->log_opacity - constants->log_alpha_cutoff, constants->sample_area), contributing = 0;
    uint length = tape->length;
    const BlockOrigin at = block_origin(s, tile);
    for (; touched != 0; touched &= touched - 1) {
        int block = 31 - clz((int)(touched & -touched));
        const Block b = block_of(s, tile, &at, block);
        if (UNLIKELY(!VANY(b.mask))) continue;
        vfloat half_rho = fragment_half_rho(s, b.intersection, INVERSE_D(b.intersection), b.lowpass_half_rho);
        vfloat alpha = fragment_alpha(s, half_rho, constants->opacity_ceiling);
        tape->transmittance[length] = pixels[block].t;
        tape->alpha[length++] = attenuate(&pixels[block], alpha, b.mask, constants);
        contributing |= 1u << block;
        if (UNLIKELY(!VANY(VMASK(pixel_transmittance(&pixels[block]) > constants->transmittance_stop)))) alive &= ~(1u << block);
    }
    tape->length = length;
    tape->blocks[tape_index] = contributing;
    return alive;
}

// Backward pass of a splat's fragments, which are the last on the tape; removes them.
static inline void backward_splat(const Splat *s, const Tile *tile, global Tape *tape, uint tape_index, PixelGradient *gradients,
                                  global float *out) {
    const BlendConstants *constants = tile->constants;
    Sums sums = {0};
    uint blocks = tape->blocks[tape_index], at = tape->length -= popcount(blocks);
    const BlockOrigin corner = block_origin(s, tile);
    for (; blocks != 0; blocks &= blocks - 1, at++) {
        int block = 31 - clz((int)(blocks & -blocks));
        const Block b = block_of(s, tile, &corner, block);
        const Geometry g = geometry_of(s, b.intersection, b.nu_x, b.nv_x, b.y, b.lowpass_half_rho);
        vfloat alpha = tape->alpha[at], weight = tape->transmittance[at] * alpha;
        vfloat grad_log = backward_alpha(&gradients[block], fragment_grad_weight(s, &gradients[block], &g), weight, alpha);
        add_fragment(&sums, s, &gradients[block], &g, weight, grad_log, b.lowpass_half_rho, b.x, b.y, constants);
    }
    const Parts m = record_gradient_of(&sums, constants);
#if LANES == 16
    uint field = 0;
    for (; field + LANES <= FIELDS; field += LANES) VSTORE(lane_sums(m.fields + field), out + field);
    if (field < FIELDS) {
        float last[LANES];
        VSTORE(lane_sums(m.fields + field), last);
        for (uint k = 0; field + k < FIELDS; k++) out[field + k] = last[k];
    }
#else
    *(global RecordGradient *)out = m;
#endif
}

static inline void store_zero_gradient(global float *record_gradients, uint offset) {
    const RecordGradient nothing = {0};
    ((global RecordGradient *)record_gradients)[offset] = nothing;
}

// Prefetches all data of the splat at `next` in the list.
#define PREFETCH_SPLAT(next)                                                          \
    PREFETCH(splats + lists[next]);                                             \
    PREFETCH((global const char *)(splats + lists[next]) + 64);                 \
    PREFETCH(windows + lists[next]);                                            \
    PREFETCH(gradient_offsets + lists[next])

kernel void blend_backward(
//@@ arguments blend_backward
) {
    const BlendConstants constants = {log_alpha_cutoff, opacity_ceiling, transmittance_stop, sample_area, log_ceiling};
    const int tiles_x = (width + TILE_W - 1) / TILE_W, tiles_y = (height + TILE_H - 1) / TILE_H;
    global Tape *tape = (global Tape *)tapes + get_global_id(0);
    Tile tile;
    tile.constants = &constants;
    for (int block = 0; block < BLOCKS; block++) {
        tile.left[block] = (float)LEFT(block);
        tile.top[block] = (float)TOP(block);
    }
    for (uint tile_index; (tile_index = atomic_inc(reserved + 1)) < (uint)(tiles_x * tiles_y);) {
        int column = (int)(tile_index % (uint)tiles_x), tile_row = (int)(tile_index / (uint)tiles_x);
        tile.x0 = column * TILE_W;
        tile.y0 = tile_row * TILE_H;
        uint start = starts[tile_index], end = starts[tile_index + 1];

        // gradients of the tile's pixels; 0 outside of the image
        PixelGradient gradients[BLOCKS];
        for (int block = 0; block < BLOCKS; block++) {
            PixelGradient *gradient = &gradients[block];
            int x = tile.x0 + LEFT(block), y = tile.y0 + TOP(block);
            size_t at = y * (size_t)stride + x;
            gradient->r = pixels_of(grad_rgb, 3, 0, x, y, width, height);
            gradient->g = pixels_of(grad_rgb, 3, 1, x, y, width, height);
            gradient->b = pixels_of(grad_rgb, 3, 2, x, y, width, height);
            gradient->behind = FMA(gradient->r, (vfloat)background_r, FMA(gradient->g, (vfloat)background_g, gradient->b * background_b));
//@@ pixel_gradient_start
        }

        // forward: transmittance in front of each segment; the last segment's fragments stay on the tape
        Pixel pixels[BLOCKS];
        for (int block = 0; block < BLOCKS; block++) pixel_start(&pixels[block], (vfloat)1.0f);
        const uint in_image = blocks_within(0, min(width - tile.x0, TILE_W), 0, min(height - tile.y0, TILE_H));
        uint alive = in_image, position = start, first = start, segment = 0;
        global float *own = checkpoints + (size_t)(start / SEGMENT + tile_index) * CHECKPOINT_FLOATS;
        tape->length = 0;
        for (; position < end && alive; position++) {
            if (position == start || tape->length + BLOCKS > TAPE_FRAGMENTS || position - first == TAPE_SPLATS) {
                segment += position != start;
                first = position;
                tape->length = 0;
                for (int block = 0; block < BLOCKS; block++)
                    VSTORE(pixel_transmittance(&pixels[block]), own + (size_t)segment * CHECKPOINT_FLOATS + block * LANES);
                ((global uint *)own)[(size_t)segment * CHECKPOINT_FLOATS + TILE_W * TILE_H] = first;
            }
            PREFETCH_SPLAT(min(position + PREFETCH_SPLATS, end - 1));
            uint index = lists[position], tape_index = position - first;
            tape->offsets[tape_index] = gradient_offsets[index] + tile_rank(windows[index], big_capacity, big_rows, column, tile_row);
            const Splat s = splats[index];
            alive = forward_splat(&s, &tile, pixels, alive, tape, tape_index);
        }
        vfloat behind_r = 0.0f, behind_g = 0.0f, behind_b = 0.0f;
        for (int block = 0; block < BLOCKS; block++) {
            behind_r = FMA(pixels[block].t, gradients[block].r, behind_r);
            behind_g = FMA(pixels[block].t, gradients[block].g, behind_g);
            behind_b = FMA(pixels[block].t, gradients[block].b, behind_b);
        }
        background_sums[3 * tile_index] = lane_sum(behind_r);
        background_sums[3 * tile_index + 1] = lane_sum(behind_g);
        background_sums[3 * tile_index + 2] = lane_sum(behind_b);

        // splats behind the last one processed do not contribute
        for (uint k = position; k < end; k++) {
            PREFETCH(windows + lists[min(k + PREFETCH_SPLATS, end - 1)]);
            PREFETCH(gradient_offsets + lists[min(k + PREFETCH_SPLATS, end - 1)]);
            uint offset = gradient_offsets[lists[k]] + tile_rank(windows[lists[k]], big_capacity, big_rows, column, tile_row);
            store_zero_gradient(record_gradients, offset);
        }
        for (bool revisits = false; position > start; revisits = true) {
            if (revisits) {
                segment--;
                first = ((global const uint *)own)[(size_t)segment * CHECKPOINT_FLOATS + TILE_W * TILE_H];
                tape->length = 0;
                alive = in_image;
                for (int block = 0; block < BLOCKS; block++) {
                    pixel_start(&pixels[block], VLOAD(own + (size_t)segment * CHECKPOINT_FLOATS + block * LANES));
                    if (!VANY(VMASK(pixels[block].t > constants.transmittance_stop))) alive &= ~(1u << block);
                }
                for (uint k = first; k < position; k++) {
                    PREFETCH_SPLAT(min(k + PREFETCH_SPLATS, end - 1));
                    uint index = lists[k];
                    tape->offsets[k - first] = gradient_offsets[index] + tile_rank(windows[index], big_capacity, big_rows, column, tile_row);
                    const Splat s = splats[index];
                    alive = forward_splat(&s, &tile, pixels, alive, tape, k - first);
                }
            }
            for (; position > first; position--) {
                uint tape_index = position - 1 - first, next = max(position - 1, first + PREFETCH_SPLATS) - PREFETCH_SPLATS;
                PREFETCH(splats + lists[next]);
                PREFETCH((global const char *)(splats + lists[next]) + 64);
                PREFETCH(record_gradients + (size_t)tape->offsets[next - first] * FIELDS);
                if (tape->blocks[tape_index] == 0) {
                    store_zero_gradient(record_gradients, tape->offsets[tape_index]);
                    continue;
                }
                const Splat s = splats[lists[position - 1]];
                backward_splat(&s, &tile, tape, tape_index, gradients, record_gradients + (size_t)tape->offsets[tape_index] * FIELDS);
            }
        }
    }
}
