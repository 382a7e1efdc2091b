// For GPUs: one work-group draws one tile, ROWS pixels of a column per work-item; splats are staged in local memory.
// Barriers stand in loops whose bounds are the same for the whole group (numerics F5).
// Index space: work-groups of TILE_W * TILE_H / ROWS, one per tile of each view.
// Reads:  splats, lists, starts[tiles + 1]. Writes: raw (4 channels: r, g, b, transmittance) and the outputs' samples, whole tiles.
#define GROUP (TILE_W * TILE_H / ROWS)
// Neighbours in a group draw a block of BLOCK_W x BLOCK_H pixels, so that a splat that misses it costs it nothing.
#define BLOCK_W 8
#define BLOCK_H (4 * ROWS)
#define BLOCKS (TILE_W * TILE_H / (BLOCK_W * BLOCK_H))
#define STAGED 128
enum { VECTORS = sizeof(Splat) / 16 };       // of 16 bytes, in a record

typedef union {              // what is staged of a splat, as vectors for fewer reads
    Splat splat;
    float4 words[VECTORS];
} Staged;

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void blend(
//@@ arguments blend
) {
    local Staged staged[STAGED];
    local uint touched[BLOCKS][STAGED / 32]; // bits: which staged splats can touch a block
    local int alive;
    const BlendConstants constants = {log_cut, ceiling, stop, filter};
    uint tile = band_first + get_group_id(0), item = get_local_id(0);
    int tiles_x = (width + TILE_W - 1) / TILE_W, tiles_y = (height + TILE_H - 1) / TILE_H;
    uint number = tile / (uint)(tiles_x * tiles_y), here = tile - number * (uint)(tiles_x * tiles_y);
    int x0 = (int)(here % (uint)tiles_x) * TILE_W, y0 = (int)(here / (uint)tiles_x) * TILE_H;
    uint block = item / 32;
    int px = x0 + (int)(block % (TILE_W / BLOCK_W) * BLOCK_W + item % BLOCK_W);
    int py = y0 + (int)(block / (TILE_W / BLOCK_W) * BLOCK_H + item % 32 / BLOCK_W * ROWS);

    Pixel pixels[ROWS];
    for (int row = 0; row < ROWS; row++) pixel_start(&pixels[row]);
//@@ group_start
//@@ pixels_start

    uint base = starts[band_first], start = starts[tile] - base, end = starts[tile + 1] - base;
//@@ pass
    for (uint batch = start; batch < end; batch += STAGED) {
        uint length = min(end - batch, (uint)STAGED);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item == 0) alive = 0;
        for (uint word = item; word < BLOCKS * (STAGED / 32); word += GROUP) touched[word / (STAGED / 32)][word % (STAGED / 32)] = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        // vector by vector, so that neighbours in the group read neighbours in memory
        for (uint word = item; word < length * VECTORS; word += GROUP) {
            uint which = word / VECTORS, part = word % VECTORS;
            staged[which].words[part] = ((global const float4 *)(splats + lists[batch + which]))[part];
        }
        for (int row = 0; row < ROWS; row++)
            if (px < width && py + row < height && pixel_unfinished(&pixels[row], &constants)) alive = 1;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint cell = item; cell < length * BLOCKS; cell += GROUP) {
            uint which = cell / BLOCKS, other = cell % BLOCKS;
            int left = x0 + (int)(other % (TILE_W / BLOCK_W)) * BLOCK_W, top = y0 + (int)(other / (TILE_W / BLOCK_W)) * BLOCK_H;
            local const Splat *s = &staged[which].splat;
            if (s->x0 < left + BLOCK_W && s->x1 > left && s->y0 < top + BLOCK_H && s->y1 > top)
                atomic_or(&touched[other][which / 32], 1u << (which % 32));
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        // uniform: every work-item reads the same vote, taken before this batch is drawn
        if (!alive) break;
        for (uint word = 0; word < STAGED / 32; word++)
            for (uint bits = touched[block][word]; bits != 0; bits &= bits - 1) {
                uint which = word * 32 + 31 - clz(bits & -bits);
                Staged copy;
                for (int part = 0; part < VECTORS; part++) copy.words[part] = staged[which].words[part];
                const Splat s = copy.splat;
                wide half_r2 = s.log_opacity - constants.log_cut;
                wide x = (wide)(px - s.ax);
                wide nu_x = FMA(s.nux, x, s.nu0), nv_x = FMA(s.nvx, x, s.nv0), d_x = FMA(s.dx, x, s.d0);
                for (int row = 0; row < ROWS; row++) {
                    if (!pixel_unfinished(&pixels[row], &constants)) continue;
                    wide y = (wide)(py + row - s.ay);
                    Crossing c = cross_row(&s, nu_x, nv_x, d_x, y, half_r2);
//@@ cross
                    wide screen;
                    int mask = fragment_mask(&s, c, x, y, half_r2, constants.filter, &screen);
//@@ mask
                    if (!VANY(mask)) continue;
                    pixel_blend(&pixels[row], &s, c, mask, screen, &constants
//@@ blend_arguments
                    );
                }
            }
    }
//@@ pass_end

    size_t stride = (size_t)tiles_x * TILE_W, top = (size_t)number * tiles_y * TILE_H;
    for (int row = 0; row < ROWS; row++) {
        size_t at = (top + py + row) * stride + px;
        Pixel *pixel = &pixels[row];
        PIXEL_STORE_BASE(pixel, raw, plane, at);
//@@ store
    }
}
