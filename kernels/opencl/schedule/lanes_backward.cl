// Backward pass of blending for CPUs. Each work-item takes the next unprocessed tile until none is left, so that one tape per
// work-item is enough.
// Index space: one work-item (and work-group) per core.
// Reads:  splats, lists, starts[tiles + 1], windows, big_rows, splat_slots, and the gradients of the images.
// Writes: moments of each splat of the tile; tile_sums. Consumes: checkpoints, tapes; reserved[1], the number of tiles taken.
// Splats are scattered in memory, so the next ones are prefetched.
#define PREFETCH_SPLATS 8

// A chunk is as many splats of a tile's list as fit the tape: at least CHUNK, at most TAPE_SPLATS.
#define TAPE_SPLATS (8 * CHUNK)
#define TAPE_FRAGMENTS (CHUNK * BLOCKS)
#define CHECKPOINT_FLOATS (TILE_W * TILE_H + LANES)        // of a checkpoint: transmittance of each pixel, and the index of the first splat

typedef struct {            // fragments in the order of compositing, block by block
    vfloat transmittance[TAPE_FRAGMENTS], opacity[TAPE_FRAGMENTS];
    uint blocks[TAPE_SPLATS];      // per splat, as bits: blocks with fragments
    uint slots[TAPE_SPLATS];
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
    vfloat x, y, nu_x, nv_x, screen;
    vint mask;
    Crossing crossing;
} Block;

static inline BlockOrigin block_origin(const Splat *s, const Tile *tile) {
    const BlockOrigin place = {(float)(tile->x0 - s->ax) + BLOCK_X, (float)(tile->y0 - s->ay) + BLOCK_Y};
    return place;
}

static inline Block block_of(const Splat *s, const Tile *tile, const BlockOrigin *place, int block) {
    Block b;
    wide half_r2 = s->log_opacity - tile->constants->log_cut;
    b.x = place->x + tile->left[block];
    b.y = place->y + tile->top[block];
    b.nu_x = FMA((vfloat)s->nux, b.x, (vfloat)s->nu0);
    b.nv_x = FMA((vfloat)s->nvx, b.x, (vfloat)s->nv0);
    b.crossing = cross_row(s, b.nu_x, b.nv_x, FMA((vfloat)s->dx, b.x, (vfloat)s->d0), b.y, half_r2);
    b.mask = fragment_mask(s, b.crossing, b.x, b.y, half_r2, tile->constants->filter, &b.screen);
    return b;
}

// Attenuates the live blocks by the splat and records its fragments on the tape. Returns the blocks that are still live.
static inline uint forward_splat(const Splat *s, const Tile *tile, Pixel *pixels, uint alive, global Tape *tape, uint place) {
    const BlendConstants *constants = tile->constants;
    uint touched = alive & touched_blocks(s, tile->x0, tile->y0, s->log_opacity - constants->log_cut, constants->filter), contributing = 0;
    uint length = tape->length;
    const BlockOrigin at = block_origin(s, tile);
    for (; touched != 0; touched &= touched - 1) {
        int block = 31 - clz((int)(touched & -touched));
        const Block b = block_of(s, tile, &at, block);
        if (UNLIKELY(!VANY(b.mask))) continue;
        vfloat half_rho = fragment_half_rho(s, b.crossing, INVERSE_D(b.crossing), b.screen);
        vfloat opacity = fragment_opacity(s, half_rho, constants->ceiling);
        tape->transmittance[length] = pixels[block].t;
        tape->opacity[length++] = attenuate(&pixels[block], opacity, b.mask, constants);
        contributing |= 1u << block;
        if (UNLIKELY(!VANY(VMASK(pixel_transmittance(&pixels[block]) > constants->stop)))) alive &= ~(1u << block);
    }
    tape->length = length;
    tape->blocks[place] = contributing;
    return alive;
}

// Backward pass of a splat's fragments, which are the last on the tape; removes them.
static inline void backward_splat(const Splat *s, const Tile *tile, global Tape *tape, uint place, PixelGradient *gradients,
                                  global float *slot) {
    const BlendConstants *constants = tile->constants;
    Sums sums = {0};
    uint blocks = tape->blocks[place], at = tape->length -= popcount(blocks);
    const BlockOrigin corner = block_origin(s, tile);
    for (; blocks != 0; blocks &= blocks - 1, at++) {
        int block = 31 - clz((int)(blocks & -blocks));
        const Block b = block_of(s, tile, &corner, block);
        const Geometry g = geometry_of(s, b.crossing, b.nu_x, b.nv_x, b.y, b.screen);
        vfloat opacity = tape->opacity[at], weight = tape->transmittance[at] * opacity;
        vfloat by_log = backward_opacity(&gradients[block], fragment_by_weight(s, &gradients[block], &g), weight, opacity);
        add_fragment(&sums, s, &gradients[block], &g, weight, by_log, b.screen, b.x, b.y, constants);
    }
    const Parts m = moments_of(&sums, constants);
#if LANES == 16
    uint field = 0;
    for (; field + LANES <= FIELDS; field += LANES) VSTORE(lane_sums(m.fields + field), slot + field);
    if (field < FIELDS) {
        float last[LANES];
        VSTORE(lane_sums(m.fields + field), last);
        for (uint k = 0; field + k < FIELDS; k++) slot[field + k] = last[k];
    }
#else
    *(global Moments *)slot = m;
#endif
}

static inline void store_zero_moments(global float *moments, uint slot) {
    const Moments nothing = {0};
    ((global Moments *)moments)[slot] = nothing;
}

// Prefetches all data of the splat at `next` in the list.
#define PREFETCH_SPLAT(next)                                                          \
    PREFETCH(splats + lists[next]);                                             \
    PREFETCH((global const char *)(splats + lists[next]) + 64);                 \
    PREFETCH(windows + lists[next]);                                            \
    PREFETCH(splat_slots + lists[next])

kernel void blend_backward(
//@@ arguments blend_backward
) {
    const BlendConstants constants = {log_cut, ceiling, stop, filter, log_ceiling};
    const int tiles_x = (width + TILE_W - 1) / TILE_W, tiles_y = (height + TILE_H - 1) / TILE_H;
    global Tape *tape = (global Tape *)tapes + get_global_id(0);
    Tile tile;
    tile.constants = &constants;
    for (int block = 0; block < BLOCKS; block++) {
        tile.left[block] = (float)LEFT(block);
        tile.top[block] = (float)TOP(block);
    }
    for (uint number; (number = atomic_inc(reserved + 1)) < (uint)(tiles_x * tiles_y);) {
        int column = (int)(number % (uint)tiles_x), tile_row = (int)(number / (uint)tiles_x);
        tile.x0 = column * TILE_W;
        tile.y0 = tile_row * TILE_H;
        uint start = starts[number], end = starts[number + 1];

        // gradients of the tile's pixels; 0 outside of the image
        PixelGradient gradients[BLOCKS];
        for (int block = 0; block < BLOCKS; block++) {
            PixelGradient *gradient = &gradients[block];
            int x = tile.x0 + LEFT(block), y = tile.y0 + TOP(block);
            size_t at = y * (size_t)stride + x;
            gradient->r = pixels_of(by_rgb, 3, 0, x, y, width, height);
            gradient->g = pixels_of(by_rgb, 3, 1, x, y, width, height);
            gradient->b = pixels_of(by_rgb, 3, 2, x, y, width, height);
            gradient->behind = FMA(gradient->r, (vfloat)background_r, FMA(gradient->g, (vfloat)background_g, gradient->b * background_b));
//@@ pixel_gradient_start
        }

        // forward: transmittance in front of each chunk; the last chunk's fragments stay on the tape
        Pixel pixels[BLOCKS];
        for (int block = 0; block < BLOCKS; block++) pixel_start(&pixels[block], (vfloat)1.0f);
        const uint in_image = blocks_within(0, min(width - tile.x0, TILE_W), 0, min(height - tile.y0, TILE_H));
        uint alive = in_image, position = start, first = start, chunk = 0;
        global float *own = checkpoints + (size_t)(start / CHUNK + number) * CHECKPOINT_FLOATS;
        tape->length = 0;
        for (; position < end && alive; position++) {
            if (position == start || tape->length + BLOCKS > TAPE_FRAGMENTS || position - first == TAPE_SPLATS) {
                chunk += position != start;
                first = position;
                tape->length = 0;
                for (int block = 0; block < BLOCKS; block++)
                    VSTORE(pixel_transmittance(&pixels[block]), own + (size_t)chunk * CHECKPOINT_FLOATS + block * LANES);
                ((global uint *)own)[(size_t)chunk * CHECKPOINT_FLOATS + TILE_W * TILE_H] = first;
            }
            PREFETCH_SPLAT(min(position + PREFETCH_SPLATS, end - 1));
            uint index = lists[position], place = position - first;
            tape->slots[place] = splat_slots[index] + tile_rank(windows[index], big_capacity, big_rows, column, tile_row);
            const Splat s = splats[index];
            alive = forward_splat(&s, &tile, pixels, alive, tape, place);
        }
        vfloat behind_r = 0.0f, behind_g = 0.0f, behind_b = 0.0f;
        for (int block = 0; block < BLOCKS; block++) {
            behind_r = FMA(pixels[block].t, gradients[block].r, behind_r);
            behind_g = FMA(pixels[block].t, gradients[block].g, behind_g);
            behind_b = FMA(pixels[block].t, gradients[block].b, behind_b);
        }
        tile_sums[3 * number] = lane_sum(behind_r);
        tile_sums[3 * number + 1] = lane_sum(behind_g);
        tile_sums[3 * number + 2] = lane_sum(behind_b);

        // splats behind the last one processed do not contribute
        for (uint k = position; k < end; k++) {
            PREFETCH(windows + lists[min(k + PREFETCH_SPLATS, end - 1)]);
            PREFETCH(splat_slots + lists[min(k + PREFETCH_SPLATS, end - 1)]);
            uint slot = splat_slots[lists[k]] + tile_rank(windows[lists[k]], big_capacity, big_rows, column, tile_row);
            store_zero_moments(moments, slot);
        }
        for (bool revisits = false; position > start; revisits = true) {
            if (revisits) {
                chunk--;
                first = ((global const uint *)own)[(size_t)chunk * CHECKPOINT_FLOATS + TILE_W * TILE_H];
                tape->length = 0;
                alive = in_image;
                for (int block = 0; block < BLOCKS; block++) {
                    pixel_start(&pixels[block], VLOAD(own + (size_t)chunk * CHECKPOINT_FLOATS + block * LANES));
                    if (!VANY(VMASK(pixels[block].t > constants.stop))) alive &= ~(1u << block);
                }
                for (uint k = first; k < position; k++) {
                    PREFETCH_SPLAT(min(k + PREFETCH_SPLATS, end - 1));
                    uint index = lists[k];
                    tape->slots[k - first] = splat_slots[index] + tile_rank(windows[index], big_capacity, big_rows, column, tile_row);
                    const Splat s = splats[index];
                    alive = forward_splat(&s, &tile, pixels, alive, tape, k - first);
                }
            }
            for (; position > first; position--) {
                uint place = position - 1 - first, next = max(position - 1, first + PREFETCH_SPLATS) - PREFETCH_SPLATS;
                PREFETCH(splats + lists[next]);
                PREFETCH((global const char *)(splats + lists[next]) + 64);
                PREFETCH(moments + (size_t)tape->slots[next - first] * FIELDS);
                if (tape->blocks[place] == 0) {
                    store_zero_moments(moments, tape->slots[place]);
                    continue;
                }
                const Splat s = splats[lists[position - 1]];
                backward_splat(&s, &tile, tape, place, gradients, moments + (size_t)tape->slots[place] * FIELDS);
            }
        }
    }
}
