// For CPUs: one work-item takes a tile back, a row of LANES pixels at a time.
// Index space: one work-item (and work-group) per tile.
// Reads:  splats, lists, starts[tiles + 1], windows, big_bounds, splat_slots, and the images' derivatives.
// Writes: moments, a slot for each splat of the tile; tile_sums. Uses up: checkpoints.
// Splats of a tile lie anywhere in memory; the ones to come are fetched ahead.
#define AHEAD_SPLATS 8

typedef struct {            // fragments of a chunk, by splat and row
    vfloat light[CHUNK][TILE_H], opacity[CHUNK][TILE_H];
    uint rows[CHUNK];       // bits: rows where anything is drawn
    uint slots[CHUNK];
} Tape;

typedef struct {
    int x0, y0;
    const BlendConstants *constants;
} Tile;

typedef struct {            // a splat in a tile: its forms in the first row of pixels, whose y is 0
    vfloat x, nu_x, nv_x, d_x;
    wide half_r2;
} Columns;

static inline Columns columns_of(const Splat *s, const Tile *tile) {
    Columns c;
    c.x = (vfloat)(float)(tile->x0 - s->ax) + VLANE;
    c.nu_x = FMA((vfloat)s->nux, c.x, (vfloat)s->nu0);
    c.nv_x = FMA((vfloat)s->nvx, c.x, (vfloat)s->nv0);
    c.d_x = FMA((vfloat)s->dx, c.x, (vfloat)s->d0);
    c.half_r2 = s->log_opacity - tile->constants->log_cut;
    return c;
}

// Lets the splat take its light in the rows that are alive; keeps on the tape what it took there. Returns which rows stay alive.
static inline uint walk_splat(const Splat *s, const Tile *tile, Pixel *pixels, uint alive, Tape *tape, uint place) {
    const BlendConstants *constants = tile->constants;
    const Columns columns = columns_of(s, tile);
    int first = max(s->y0 - tile->y0, 0), last = min(s->y1 - tile->y0, TILE_H);
    uint touched = 0;
    for (int row = first; row < last; row++) {
        if (!(alive >> row & 1u)) continue;
        wide y = (wide)(tile->y0 + row - s->ay);
        Crossing c = cross_row(s, columns.nu_x, columns.nv_x, columns.d_x, (vfloat)y, columns.half_r2);
        vfloat screen;
        vint mask = fragment_mask(s, c, columns.x, (vfloat)y, columns.half_r2, constants->filter, &screen);
        if (!VANY(mask)) continue;
        vfloat opacity = fragment_opacity(s, fragment_half_rho(s, c, 1.0f / c.d, screen), constants->ceiling);
        vfloat light = pixels[row].t;
        vfloat drawn = take_light(&pixels[row], opacity, mask, constants);
        touched |= 1u << row;
        tape->light[place][row] = light;
        tape->opacity[place][row] = drawn;
        if (!VANY(VMASK(pixels[row].t > constants->stop))) alive &= ~(1u << row);
    }
    tape->rows[place] = touched;
    return alive;
}

// Takes the splat's fragments on the tape back.
static inline Moments back_splat(const Splat *s, const Tile *tile, const Tape *tape, uint place, Loss *losses) {
    const BlendConstants *constants = tile->constants;
    const Columns columns = columns_of(s, tile);
    Sums sums = {0};
    for (uint rows = tape->rows[place]; rows != 0; rows &= rows - 1) {
        int row = 31 - clz(rows & -rows);
        wide y = (wide)(tile->y0 + row - s->ay);
        Crossing c = cross_row(s, columns.nu_x, columns.nv_x, columns.d_x, (vfloat)y, columns.half_r2);
        vfloat screen;
        fragment_mask(s, c, columns.x, (vfloat)y, columns.half_r2, constants->filter, &screen);
        const Geometry g = geometry_of(s, c, columns.nu_x, columns.nv_x, y, screen);
        vfloat opacity = tape->opacity[place][row], weight = tape->light[place][row] * opacity;
        vfloat by_log = take_back(&losses[row], fragment_worth(s, &losses[row], &g), weight, opacity);
        add_fragment(&sums, s, &losses[row], &g, weight, by_log, screen, y, constants);
    }
    return moments_of(&sums, s, columns.x, constants);
}

static inline void leave_nothing(global float *moments, uint slot) {
    const Moments nothing = {0};
    ((global Moments *)moments)[slot] = nothing;
}

// All that is asked of the splat that the list has at `next`.
#define FETCH_SPLAT(next)                                                          \
    FETCH_AHEAD(splats + lists[next]);                                             \
    FETCH_AHEAD((global const char *)(splats + lists[next]) + 64);                 \
    FETCH_AHEAD(windows + lists[next]);                                            \
    FETCH_AHEAD(splat_slots + lists[next])

kernel void blend_backward(
//@@ arguments blend_backward
) {
    const BlendConstants constants = {log_cut, ceiling, stop, filter, log_ceiling};
    uint number = get_global_id(0);
    int tiles_x = (width + TILE_W - 1) / TILE_W;
    int column = (int)(number % (uint)tiles_x), tile_row = (int)(number / (uint)tiles_x);
    const Tile tile = {column * TILE_W, tile_row * TILE_H, &constants};
    uint start = starts[number], end = starts[number + 1];

    // the derivatives of the tile's pixels; there is nothing outside of the picture
    Loss losses[TILE_H];
    for (int row = 0; row < TILE_H; row++) {
        Loss *loss = &losses[row];
        int x = tile.x0, y = tile.y0 + row;
        size_t at = y * (size_t)stride + x;
        loss->r = pixels_of(by_rgb, 3, 0, x, y, width, height);
        loss->g = pixels_of(by_rgb, 3, 1, x, y, width, height);
        loss->b = pixels_of(by_rgb, 3, 2, x, y, width, height);
        loss->behind = FMA(loss->r, (vfloat)background_r, FMA(loss->g, (vfloat)background_g, loss->b * background_b));
//@@ loss_start
    }

    // forward: the light in front of each chunk; of the last one the fragments stay on the tape
    Pixel pixels[TILE_H];
    Tape tape;
    for (int row = 0; row < TILE_H; row++) pixel_start(&pixels[row], (vfloat)1.0f);
    int rows = min(height - tile.y0, TILE_H);
    uint alive = rows == 32 ? 0xFFFFFFFFu : (1u << rows) - 1u, walked = start;
    global float *own = checkpoints + (size_t)(start / CHUNK + number) * (TILE_W * TILE_H);
    for (; walked < end && alive; walked++) {
        uint place = (walked - start) % CHUNK, chunk = (walked - start) / CHUNK;
        for (int row = 0; place == 0 && row < TILE_H; row++)
            VSTORE(pixel_light(&pixels[row]), own + (size_t)chunk * (TILE_W * TILE_H) + row * TILE_W);
        FETCH_SPLAT(min(walked + AHEAD_SPLATS, end - 1));
        uint index = lists[walked];
        tape.slots[place] = splat_slots[index] + tile_rank(windows[index], big_bounds, column, tile_row, width, height);
        FETCH_AHEAD(moments + (size_t)tape.slots[place] * FIELDS);
        const Splat s = splats[index];
        alive = walk_splat(&s, &tile, pixels, alive, &tape, place);
    }
    vfloat behind_r = 0.0f, behind_g = 0.0f, behind_b = 0.0f;
    for (int row = 0; row < TILE_H; row++) {
        behind_r = FMA(pixels[row].t, losses[row].r, behind_r);
        behind_g = FMA(pixels[row].t, losses[row].g, behind_g);
        behind_b = FMA(pixels[row].t, losses[row].b, behind_b);
    }
    tile_sums[3 * number] = lane_sum(behind_r);
    tile_sums[3 * number + 1] = lane_sum(behind_g);
    tile_sums[3 * number + 2] = lane_sum(behind_b);

    // splats behind the last that was walked have nothing to do with the picture
    for (uint k = walked; k < end; k++) {
        FETCH_AHEAD(windows + lists[min(k + AHEAD_SPLATS, end - 1)]);
        FETCH_AHEAD(splat_slots + lists[min(k + AHEAD_SPLATS, end - 1)]);
        uint slot = splat_slots[lists[k]] + tile_rank(windows[lists[k]], big_bounds, column, tile_row, width, height);
        leave_nothing(moments, slot);
    }
    uint chunks = (walked - start + CHUNK - 1) / CHUNK;
    for (uint chunk = chunks; chunk-- > 0;) {
        uint first = start + chunk * CHUNK, length = min(walked - first, (uint)CHUNK);
        if (chunk + 1 < chunks) {
            alive = 0;
            for (int row = 0; row < rows; row++) {
                pixel_start(&pixels[row], VLOAD(own + (size_t)chunk * (TILE_W * TILE_H) + row * TILE_W));
                if (VANY(VMASK(pixels[row].t > constants.stop))) alive |= 1u << row;
            }
            for (uint place = 0; place < length; place++) {
                uint index = lists[first + place];
                tape.slots[place] = splat_slots[index] + tile_rank(windows[index], big_bounds, column, tile_row, width, height);
                const Splat s = splats[index];
                alive = walk_splat(&s, &tile, pixels, alive, &tape, place);
            }
        }
        for (uint place = length; place-- > 0;) {
            if (tape.rows[place] == 0) {
                leave_nothing(moments, tape.slots[place]);
                continue;
            }
            const Splat s = splats[lists[first + place]];
            ((global Moments *)moments)[tape.slots[place]] = back_splat(&s, &tile, &tape, place, losses);
        }
    }
}
