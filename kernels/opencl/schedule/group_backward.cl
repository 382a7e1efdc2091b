// For GPUs: one work-group takes a tile back, STAGED splats at a time that are fetched at once, in parts of at least CHUNK: as many
// as local memory has cells for, one for each pixel in a splat's bounds. A work-item walks its ROWS pixels through the part, forward
// and back, and leaves in the cells what each fragment takes and what its opacity is worth; then it adds up columns of pixels of one
// splat. So no sum runs across work-items but that of a splat's columns, in a fixed order and without atomics: parts do not change
// it. Most splats have few of a tile's pixels: all that are staged are then one part, of which work-items take the columns side by
// side. Barriers stand in loops whose bounds are the same for the whole group.
// Index space: work-groups of TILE_W * TILE_H / ROWS, one per tile.
// Reads:  splats, lists, starts[tiles + 1], windows, big_bounds, splat_slots, and the images' derivatives.
// Writes: moments, a slot for each splat of the tile; tile_sums. Uses up: checkpoints.
#define GROUP (TILE_W * TILE_H / ROWS)
#define STAGED (CHUNK < 8 ? 4 * CHUNK : 32) // no more than GROUP, and bits of a word
#define PIXELS (TILE_W * TILE_H)
#define PARTS (STAGED / CHUNK)
#define CELLS ((STAGED - 1) * PIXELS / PARTS + 1) // a part has the splats whose cells begin before the next multiple of them
#define SUMS (GROUP + 1)            // of one field: neighbours among the fields lie in other banks

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

typedef struct {                // what the staged splats have of the tile
    uint members[PARTS];        // of each part, as bits
    short cells[STAGED];        // where the cell of the tile's first pixel would be
    ushort areas[STAGED];
    ushort columns[STAGED];     // how many the splats before it have
    uchar widths[STAGED];
} Layout;

// First half of the layout: the sizes; nothing of splats that have none of the tile.
static inline void measure(local const Splat *s, int left, int top, uint item, local Layout *layout) {
    int w = min(s->x1 - left, TILE_W) - max(s->x0 - left, 0), h = min(s->y1 - top, TILE_H) - max(s->y0 - top, 0);
    layout->widths[item] = (uchar)(w > 0 && h > 0 ? w : 0);
    layout->areas[item] = (ushort)(w > 0 && h > 0 ? w * h : 0);
}

// Second half: the places.
static inline void arrange(local const Splat *s, int left, int top, uint item, local Layout *layout) {
    uint cells = 0, columns = 0;
    for (uint other = 0; other < item; other++) {
        cells += layout->areas[other];
        columns += layout->widths[other];
    }
    layout->cells[item] = (short)((int)(cells % CELLS) - max(s->y0 - top, 0) * layout->widths[item] - max(s->x0 - left, 0));
    layout->columns[item] = (ushort)columns;
    atomic_or(&layout->members[cells / CELLS], 1u << item);
}

// Which of the splats from `first` to `last` has a column.
static inline uint owner_of(local const Layout *layout, uint first, uint last, uint column) {
    while (first < last) {
        uint middle = (first + last + 1) / 2;
        if (layout->columns[middle] <= column)
            first = middle;
        else
            last = middle - 1;
    }
    return first;
}

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void blend_backward(
//@@ arguments blend_backward
) {
    local Splat staged[STAGED];
    local float weights[CELLS + PIXELS], by_logs[CELLS + PIXELS];   // of fragments: opacity and light, then these
    local float parts[SUMS * FIELDS], carried[2][FIELDS];           // sums of columns; of a splat whose others come next
    local Loss shared[PIXELS];
    local Layout layout;
    local uint places[STAGED], bounds[TILE_W + TILE_H], reached;
    local int alive;
    const BlendConstants constants = {log_cut, ceiling, stop, filter, log_ceiling};
    uint number = get_group_id(0), item = get_local_id(0);
    int tiles_x = (width + TILE_W - 1) / TILE_W;
    int tile_column = (int)(number % (uint)tiles_x), tile_row = (int)(number / (uint)tiles_x);
    uint start = starts[number], end = starts[number + 1];
    // neighbours in a group take neighbours in a row; its pixels lie one below the other
    int column = item % TILE_W, top = item / TILE_W * ROWS, left = tile_column * TILE_W, above = tile_row * TILE_H;
    int px = left + column, py = above + top;

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

    // forward: the light in front of each part
    Pixel pixels[ROWS];
    for (int row = 0; row < ROWS; row++) pixel_start(&pixels[row], 1.0f);
    global float *own = checkpoints + (size_t)(start / CHUNK + number) * PIXELS + top * TILE_W + column;
    uint lit = 0;               // splats in parts that light of this work-item's pixels comes to
    if (item == 0) reached = 0;
    for (uint first = start; first < end; first += STAGED) {
        uint length = min(end - first, (uint)STAGED);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item == 0) alive = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item < length) staged[item] = splats[lists[first + item]];
        if (item < PARTS) layout.members[item] = 0;
        for (int row = 0; row < ROWS; row++)
            if (px < width && py + row < height && pixels[row].t > stop) alive = 1;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (!alive) break;
        find_bounds(staged, length, left, above, item, bounds);
        if (item < length) measure(&staged[item], left, above, item, &layout);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item < length) arrange(&staged[item], left, above, item, &layout);
        barrier(CLK_LOCAL_MEM_FENCE);
        uint mine = 0;
        for (int row = 0; row < ROWS; row++) mine |= bounds[TILE_W + top + row];
        mine &= bounds[column];
        for (uint part = 0; part < PARTS && layout.members[part] != 0; part++) {
            uint members = layout.members[part];
            for (int row = 0; row < ROWS; row++) {
                own[(size_t)((first - start) / CHUNK + part) * PIXELS + row * TILE_W] = pixel_light(&pixels[row]);
                if (px < width && py + row < height && pixels[row].t > stop) lit = first - start + 32 - clz(members);
            }
            for (uint bits = mine & members; bits != 0; bits &= bits - 1) {
                const Splat s = staged[31 - clz(bits & -bits)];
                for (int row = 0; row < ROWS; row++) walk_fragment(&s, px, py + row, &pixels[row], &constants);
            }
        }
    }
    atomic_max(&reached, lit);
    barrier(CLK_LOCAL_MEM_FENCE);
    const uint beyond = start + reached;
    float behind_r = 0, behind_g = 0, behind_b = 0;
    for (int row = 0; row < ROWS; row++) {
        behind_r = FMA((float)pixels[row].t, (float)losses[row].r, behind_r);
        behind_g = FMA((float)pixels[row].t, (float)losses[row].g, behind_g);
        behind_b = FMA((float)pixels[row].t, (float)losses[row].b, behind_b);
    }
    parts[item] = behind_r;
    parts[SUMS + item] = behind_g;
    parts[2 * SUMS + item] = behind_b;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < 3) {
        real sum = 0;
        for (uint other = 0; other < GROUP; other++) sum += parts[item * SUMS + other];
        tile_sums[3 * number + item] = sum;
    }

    // splats behind the last part have nothing to do with the picture
    for (uint k = beyond + item; k < end; k += GROUP) {
        uint slot = splat_slots[lists[k]] + tile_rank(windows[lists[k]], big_bounds, tile_column, tile_row, width, height);
        for (uint field = 0; field < FIELDS; field++) moments[(size_t)slot * FIELDS + field] = 0.0f;
    }
    // back, part by part
    for (uint block = (beyond - start + STAGED - 1) / STAGED; block-- > 0;) {
        uint first = start + block * STAGED, length = min(beyond - first, (uint)STAGED);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item < length) {
            uint index = lists[first + item];
            staged[item] = splats[index];
            places[item] = splat_slots[index] + tile_rank(windows[index], big_bounds, tile_column, tile_row, width, height);
        }
        if (item < PARTS) layout.members[item] = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        find_bounds(staged, length, left, above, item, bounds);
        if (item < length) measure(&staged[item], left, above, item, &layout);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item < length) {
            arrange(&staged[item], left, above, item, &layout);
            if (layout.widths[item] == 0)
                for (uint field = 0; field < FIELDS; field++) moments[(size_t)places[item] * FIELDS + field] = 0.0f;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint part = PARTS; part-- > 0;) {
            const uint members = layout.members[part];
            if (members == 0) continue;
            for (int row = 0; row < ROWS; row++) {
                int down = top + row;
                uint within = bounds[column] & bounds[TILE_W + down] & members;
                Pixel pixel;
                pixel_start(&pixel, own[(size_t)(block * PARTS + part) * PIXELS + row * TILE_W]);
                for (uint bits = within; bits != 0; bits &= bits - 1) {
                    uint place = 31 - clz(bits & -bits);
                    int cell = layout.cells[place] + down * layout.widths[place] + column;
                    const Splat s = staged[place];
                    weights[cell] = pixel.t;
                    by_logs[cell] = walk_fragment(&s, px, py + row, &pixel, &constants);
                }
                for (uint bits = within, place; bits != 0; bits ^= 1u << place) {
                    place = 31 - clz(bits);
                    int cell = layout.cells[place] + down * layout.widths[place] + column;
                    wide opacity = by_logs[cell], weight = weights[cell] * opacity, by_log = 0.0f;
                    if (opacity > 0.0f) {
                        const Splat s = staged[place];
                        wide x, y, nu_x, nv_x, half_r2, screen;
                        Crossing c = cross_at(&s, px, py + row, &constants, &x, &y, &nu_x, &nv_x, &half_r2);
                        fragment_mask(&s, c, x, y, half_r2, constants.filter, &screen);
                        const Geometry g = geometry_of(&s, c, nu_x, nv_x, y, screen);
                        by_log = take_back(&losses[row], fragment_worth(&s, &losses[row], &g), weight, opacity);
                    }
                    weights[cell] = weight;
                    by_logs[cell] = by_log;
                }
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            // columns of splats, GROUP at a time
            uint least = 31 - clz(members & -members), most = 31 - clz(members), turn = 0;
            uint to = layout.columns[most] + layout.widths[most];
            for (uint from = layout.columns[least]; from < to; from += GROUP, turn ^= 1) {
                uint stop_at = min(from + GROUP, to);
                if (from + item < stop_at) {
                    uint place = owner_of(&layout, least, most, from + item);
                    const Splat s = staged[place];
                    int across = max(s.x0 - left, 0) + (int)(from + item - layout.columns[place]), lowest = min(s.y1 - above, TILE_H);
                    Sums sums = {0};
                    wide column_x = (wide)(left + across - s.ax);
                    for (int row = max(s.y0 - above, 0); row < lowest; row++) {
                        int cell = layout.cells[place] + row * layout.widths[place] + across;
                        wide weight = weights[cell], by_log = by_logs[cell];
                        if (weight == 0.0f) continue;
                        wide x, y, nu_x, nv_x, half_r2, screen;
                        Crossing c = cross_at(&s, left + across, above + row, &constants, &x, &y, &nu_x, &nv_x, &half_r2);
                        fragment_mask(&s, c, x, y, half_r2, constants.filter, &screen);
                        const Geometry g = geometry_of(&s, c, nu_x, nv_x, y, screen);
                        const Loss loss = shared[row * TILE_W + across];
                        add_fragment(&sums, &s, &loss, &g, weight, by_log, screen, y, &constants);
                    }
                    const Moments m = moments_of(&sums, &s, column_x, &constants);
                    for (uint field = 0; field < FIELDS; field++) parts[field * SUMS + item] = ((const float *)&m)[field];
                }
                barrier(CLK_LOCAL_MEM_FENCE);
                // columns of a splat, of which the last may lie in the next turn
                uint front = owner_of(&layout, least, most, from), back = owner_of(&layout, least, most, stop_at - 1);
                for (uint cell = item; cell < (back + 1 - front) * FIELDS; cell += GROUP) {
                    uint field = cell % FIELDS, place = front + cell / FIELDS;
                    uint begins = layout.columns[place], ends = begins + layout.widths[place];
                    float sum = begins < from ? carried[turn][field] : 0.0f;
                    for (uint k = max(begins, from); k < min(ends, stop_at); k++) sum += parts[field * SUMS + k - from];
                    if (ends <= stop_at)
                        moments[(size_t)places[place] * FIELDS + field] = sum;
                    else
                        carried[turn ^ 1][field] = sum;
                }
                barrier(CLK_LOCAL_MEM_FENCE);
            }
        }
    }
}
