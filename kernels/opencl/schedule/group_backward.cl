// For GPUs: one work-group takes a tile back, CHUNK splats at a time of STAGED that are fetched at once. A work-item walks its ROWS
// pixels through the chunk, forward and back, and leaves in local memory what each fragment takes and what its opacity is worth; then
// it adds up one column of pixels of one splat. So no sum runs across work-items but that of a splat's columns, in a fixed order and
// without atomics. Most splats have few of a tile's pixels: each walks through those alone in whose bounds it lies, and columns
// beyond a splat's are not added. Barriers stand in loops whose bounds are the same for the whole group.
// Index space: work-groups of TILE_W * TILE_H / ROWS, one per tile.
// Reads:  splats, lists, starts[tiles + 1], windows, big_bounds, splat_slots, and the images' derivatives.
// Writes: moments, a slot for each splat of the tile; tile_sums. Uses up: checkpoints.
#define GROUP (TILE_W * TILE_H / ROWS)
#define STAGED (CHUNK < 8 ? 4 * CHUNK : 32) // no more than GROUP, and bits of a word
#define OF_CHUNK ((2u << (CHUNK - 1)) - 1u)
#define PIXELS (TILE_W * TILE_H)
#define STRIDE (PIXELS + TILE_W)   // of one splat's fragments: neighbours among the splats lie in other banks
#define PARTS (GROUP + 1)          // of one field's sums: neighbours among the fields lie in other banks

static inline Crossing cross_at(const Splat *s, int px, int py, const BlendConstants *constants, wide *x, wide *y,
                                wide *nu_x, wide *nv_x, wide *half_r2) {
    *x = (wide)(px - s->ax);
    *y = (wide)(py - s->ay);
    *nu_x = FMA(s->nux, *x, s->nu0);
    *nv_x = FMA(s->nvx, *x, s->nv0);
    *half_r2 = s->log_opacity - constants->log_cut;
    return cross_row(s, *nu_x, *nv_x, FMA(s->dx, *x, s->d0), *y, *half_r2);
}

// Lets the splat take its light at a pixel; returns its opacity there.
static inline wide walk_fragment(const Splat *s, int px, int py, Pixel *pixel, const BlendConstants *constants) {
    if (px < s->x0 || px >= s->x1 || py < s->y0 || py >= s->y1 || !(pixel->t > constants->stop)) return 0.0f;
    wide x, y, nu_x, nv_x, half_r2, screen;
    Crossing c = cross_at(s, px, py, constants, &x, &y, &nu_x, &nv_x, &half_r2);
    int mask = fragment_mask(s, c, x, y, half_r2, constants->filter, &screen);
    if (!VANY(mask)) return 0.0f;
    wide opacity = fragment_opacity(s, fragment_half_rho(s, c, 1.0f / c.d, screen), constants->ceiling);
    return take_light(pixel, opacity, mask, constants);
}

// For each column of the tile, then each row, the staged splats in whose bounds it lies, as bits.
static inline void find_bounds(local const Splat *staged, uint length, int left, int top, uint item, local uint *bounds) {
    for (uint k = item; k < TILE_W + TILE_H; k += GROUP) {
        bool across = k < TILE_W;
        int at = across ? left + (int)k : top + (int)k - TILE_W;
        uint bits = 0;
        for (uint place = 0; place < length; place++) {
            local const Splat *s = &staged[place];
            int low = across ? s->x0 : s->y0, high = across ? s->x1 : s->y1;
            if (at >= low && at < high) bits |= 1u << place;
        }
        bounds[k] = bits;
    }
}

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void blend_backward(
//@@ arguments blend_backward
) {
    local Splat staged[STAGED];
    local float weights[CHUNK * STRIDE], by_logs[CHUNK * STRIDE];   // by splat and pixel: opacity and light, then these
    local float parts[PARTS * FIELDS];
    local Loss shared[PIXELS];
    local uint places[STAGED], bounds[TILE_W + TILE_H], reached;
    local int alive;
    const BlendConstants constants = {log_cut, ceiling, stop, filter, log_ceiling};
    uint number = get_group_id(0), item = get_local_id(0);
    int tiles_x = (width + TILE_W - 1) / TILE_W;
    int tile_column = (int)(number % (uint)tiles_x), tile_row = (int)(number / (uint)tiles_x);
    uint start = starts[number], end = starts[number + 1];
    // neighbours in a group take neighbours in a row; its pixels lie one below the other
    int column = item % TILE_W, top = item / TILE_W * ROWS, px = tile_column * TILE_W + column, py = tile_row * TILE_H + top;

    Loss losses[ROWS];
    for (int row = 0; row < ROWS; row++) {
        Loss *loss = &losses[row];
        int x = px, y = py + row;
        size_t at = y * (size_t)stride + x;
        loss->r = pixels_of(by_rgb, 3, 0, x, y, width, height);
        loss->g = pixels_of(by_rgb, 3, 1, x, y, width, height);
        loss->b = pixels_of(by_rgb, 3, 2, x, y, width, height);
        loss->behind = FMA(loss->r, (vfloat)background_r, FMA(loss->g, (vfloat)background_g, loss->b * background_b));
//@@ loss_start
        shared[(top + row) * TILE_W + column] = *loss;
    }

    // forward: the light in front of each chunk
    Pixel pixels[ROWS];
    for (int row = 0; row < ROWS; row++) pixel_start(&pixels[row], 1.0f);
    global float *own = checkpoints + (size_t)(start / CHUNK + number) * PIXELS + top * TILE_W + column;
    uint lit = 0;               // chunks that light of this work-item's pixels comes to
    if (item == 0) reached = 0;
    for (uint first = start; first < end; first += STAGED) {
        uint length = min(end - first, (uint)STAGED);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item == 0) alive = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item < length) staged[item] = splats[lists[first + item]];
        for (int row = 0; row < ROWS; row++)
            if (px < width && py + row < height && pixels[row].t > stop) alive = 1;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (!alive) break;
        find_bounds(staged, length, tile_column * TILE_W, tile_row * TILE_H, item, bounds);
        barrier(CLK_LOCAL_MEM_FENCE);
        uint mine = 0;
        for (int row = 0; row < ROWS; row++) mine |= bounds[TILE_W + top + row];
        mine &= bounds[column];
        for (uint base = 0; base < length; base += CHUNK) {
            uint chunk = (first - start + base) / CHUNK;
            for (int row = 0; row < ROWS; row++) {
                own[(size_t)chunk * PIXELS + row * TILE_W] = pixel_light(&pixels[row]);
                if (px < width && py + row < height && pixels[row].t > stop) lit = chunk + 1;
            }
            for (uint bits = mine >> base & OF_CHUNK; bits != 0; bits &= bits - 1) {
                const Splat s = staged[base + 31 - clz(bits & -bits)];
                for (int row = 0; row < ROWS; row++) walk_fragment(&s, px, py + row, &pixels[row], &constants);
            }
        }
    }
    atomic_max(&reached, lit);
    barrier(CLK_LOCAL_MEM_FENCE);
    const uint chunks = reached;
    float behind_r = 0, behind_g = 0, behind_b = 0;
    for (int row = 0; row < ROWS; row++) {
        behind_r = FMA((float)pixels[row].t, (float)losses[row].r, behind_r);
        behind_g = FMA((float)pixels[row].t, (float)losses[row].g, behind_g);
        behind_b = FMA((float)pixels[row].t, (float)losses[row].b, behind_b);
    }
    parts[item] = behind_r;
    parts[PARTS + item] = behind_g;
    parts[2 * PARTS + item] = behind_b;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < 3) {
        real sum = 0;
        for (uint other = 0; other < GROUP; other++) sum += parts[item * PARTS + other];
        tile_sums[3 * number + item] = sum;
    }

    // splats behind the last chunk have nothing to do with the picture
    for (uint k = start + chunks * CHUNK + item; k < end; k += GROUP) {
        uint slot = splat_slots[lists[k]] + tile_rank(windows[lists[k]], big_bounds, tile_column, tile_row, width, height);
        for (uint field = 0; field < FIELDS; field++) moments[(size_t)slot * FIELDS + field] = 0.0f;
    }
    // back, chunk by chunk
    for (uint block = (chunks * CHUNK + STAGED - 1) / STAGED; block-- > 0;) {
        uint first = start + block * STAGED, length = min(min(end, start + chunks * CHUNK) - first, (uint)STAGED);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item < length) {
            uint index = lists[first + item];
            staged[item] = splats[index];
            places[item] = splat_slots[index] + tile_rank(windows[index], big_bounds, tile_column, tile_row, width, height);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        find_bounds(staged, length, tile_column * TILE_W, tile_row * TILE_H, item, bounds);
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint chunk = (length + CHUNK - 1) / CHUNK; chunk-- > 0;) {
            uint base = chunk * CHUNK, count = min(length - base, (uint)CHUNK);
            for (int row = 0; row < ROWS; row++) {
                uint mine = (top + row) * TILE_W + column;
                uint within = (bounds[column] & bounds[TILE_W + top + row]) >> base & OF_CHUNK;
                Pixel pixel;
                pixel_start(&pixel, own[(size_t)(block * (STAGED / CHUNK) + chunk) * PIXELS + row * TILE_W]);
                for (uint bits = within; bits != 0; bits &= bits - 1) {
                    uint place = 31 - clz(bits & -bits);
                    const Splat s = staged[base + place];
                    weights[place * STRIDE + mine] = pixel.t;
                    by_logs[place * STRIDE + mine] = walk_fragment(&s, px, py + row, &pixel, &constants);
                }
                for (uint bits = within, place; bits != 0; bits ^= 1u << place) {
                    place = 31 - clz(bits);
                    wide opacity = by_logs[place * STRIDE + mine], weight = weights[place * STRIDE + mine] * opacity, by_log = 0.0f;
                    if (opacity > 0.0f) {
                        const Splat s = staged[base + place];
                        wide x, y, nu_x, nv_x, half_r2, screen;
                        Crossing c = cross_at(&s, px, py + row, &constants, &x, &y, &nu_x, &nv_x, &half_r2);
                        fragment_mask(&s, c, x, y, half_r2, constants.filter, &screen);
                        const Geometry g = geometry_of(&s, c, nu_x, nv_x, y, screen);
                        by_log = take_back(&losses[row], fragment_worth(&s, &losses[row], &g), weight, opacity);
                    }
                    weights[place * STRIDE + mine] = weight;
                    by_logs[place * STRIDE + mine] = by_log;
                }
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            // a column of a splat
            uint place = item / TILE_W;
            if (place < count && (bounds[column] >> (base + place) & 1u)) {
                const Splat s = staged[base + place];
                Sums sums = {0};
                wide x = (wide)(px - s.ax);
                int above = tile_row * TILE_H, last = min(s.y1 - above, TILE_H);
                for (int row = max(s.y0 - above, 0); row < last; row++) {
                    uint at = row * TILE_W + column;
                    wide weight = weights[place * STRIDE + at], by_log = by_logs[place * STRIDE + at];
                    if (weight == 0.0f) continue;
                    wide y, nu_x, nv_x, half_r2, screen;
                    Crossing c = cross_at(&s, px, above + row, &constants, &x, &y, &nu_x, &nv_x, &half_r2);
                    fragment_mask(&s, c, x, y, half_r2, constants.filter, &screen);
                    const Geometry g = geometry_of(&s, c, nu_x, nv_x, y, screen);
                    const Loss loss = shared[at];
                    add_fragment(&sums, &s, &loss, &g, weight, by_log, screen, y, &constants);
                }
                const Moments m = moments_of(&sums, &s, x, &constants);
                for (uint field = 0; field < FIELDS; field++) parts[field * PARTS + item] = ((const float *)&m)[field];
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            for (uint cell = item; cell < count * FIELDS; cell += GROUP) {
                uint field = cell % FIELDS, splat = cell / FIELDS;
                int before = tile_column * TILE_W, beyond = min(staged[base + splat].x1 - before, TILE_W);
                float sum = 0;
                for (int other = max(staged[base + splat].x0 - before, 0); other < beyond; other++)
                    sum += parts[field * PARTS + splat * TILE_W + other];
                moments[(size_t)places[base + splat] * FIELDS + field] = sum;
            }
        }
    }
}
