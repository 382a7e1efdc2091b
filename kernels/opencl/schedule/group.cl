// For GPUs: one work-group draws one tile, one pixel per work-item; splats are staged in local memory.
// Barriers stand in loops whose bounds are the same for the whole group (numerics F5).
// Index space: work-groups of TILE_W * TILE_H, one per tile.
// Reads:  splats, lists, starts[tiles + 1]. Writes: raw (4 planes: r, g, b, transmittance) and the taps' planes, whole tiles.
#define STAGED 64

kernel __attribute__((reqd_work_group_size(TILE_W * TILE_H, 1, 1))) void blend(
    global const Splat *restrict splats,
    global const uint *restrict lists,
    global const uint *restrict starts,
    uint band_first,                         // the first tile of this launch; lists begin with its list
    int width, int height,
    float log_cut, float ceiling, float stop, float filter,
    global float *restrict raw
//@@ blend_args
) {
    local Splat staged[STAGED];
    local int alive;
    const BlendConstants constants = {log_cut, ceiling, stop, filter};
    uint tile = band_first + get_group_id(0), item = get_local_id(0);
    int tiles_x = (width + TILE_W - 1) / TILE_W, tiles_y = (height + TILE_H - 1) / TILE_H;
    int px = (int)(tile % (uint)tiles_x) * TILE_W + (int)(item % TILE_W);
    int py = (int)(tile / (uint)tiles_x) * TILE_H + (int)(item / TILE_W);

    Pixel own;
    Pixel *pixel = &own;
    pixel_start(pixel);
    bool in_picture = px < width && py < height;

    uint base = starts[band_first], start = starts[tile] - base, end = starts[tile + 1] - base;
    for (uint batch = start; batch < end; batch += STAGED) {
        uint length = min(end - batch, (uint)STAGED);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item == 0) alive = 0;
        // word by word, so that neighbours in the group read neighbours in memory
        for (uint word = item; word < length * (RECORD_BYTES / 4); word += TILE_W * TILE_H) {
            uint which = word / (RECORD_BYTES / 4), part = word % (RECORD_BYTES / 4);
            ((local uint *)staged)[word] = ((global const uint *)(splats + lists[batch + which]))[part];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        if (in_picture && pixel_unfinished(pixel, &constants)) alive = 1;
        for (uint k = 0; k < length; k++) {
            const Splat s = staged[k];
            if (!in_picture || !pixel_unfinished(pixel, &constants) || py < s.y0 || py >= s.y1) continue;
            float half_r2 = s.log_opacity - constants.log_cut;
            float x = (float)(px - s.ax), y = (float)(py - s.ay);
            Crossing c = cross_row(&s, FMA(s.nux, x, s.nu0), FMA(s.nvx, x, s.nv0), FMA(s.dx, x, s.d0), y, half_r2);
            float screen;
            int mask = fragment_mask(&s, c, x, y, half_r2, constants.filter, &screen);
            if (VANY(mask)) pixel_blend(pixel, &s, c, mask, screen, &constants);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        // uniform: every work-item reads the same vote, taken before this batch was drawn
        if (!alive) break;
    }

    pixel_finish(pixel, &constants);
    size_t stride = (size_t)tiles_x * TILE_W, plane = stride * tiles_y * TILE_H;
    size_t at = py * stride + px;
    PIXEL_STORE_BASE(pixel, raw, plane, at);
//@@ store
}
