// Blend stage for CPUs: one work-item per tile, vectors of LANES pixels (a block); no barriers, no local memory.
// Index space: one work-item (and work-group) per tile of each view.
// Reads:  splats, lists, starts[tiles + 1]. Writes: raw (4 channels: r, g, b, transmittance) and the outputs' samples, for complete
// tiles; the images where resolving is fused.
// Splats are scattered in memory, so the next ones are prefetched.
#define PREFETCH_SPLATS 8
#define ROWS_TOGETHER 8         // of tiles

kernel void blend(
//@@ arguments blend
) {
    const BlendConstants constants = {log_alpha_cutoff, opacity_ceiling, transmittance_stop, sample_area};
    uint tile = first_tile + get_global_id(0);
    int tiles_x = (width + TILE_W - 1) / TILE_W, tiles_y = (height + TILE_H - 1) / TILE_H;
    const uint view_tiles = (uint)(tiles_x * tiles_y), view_index = tile / view_tiles, across = (uint)tiles_x;
    uint here = tile - view_index * view_tiles, column = here % across, row = here / across;
    if (first_tile % view_tiles == 0 && get_global_size(0) % view_tiles == 0) {
        // complete views: bands of rows column by column, since neighbours share splats in the cache
        uint first = here / (ROWS_TOGETHER * across) * ROWS_TOGETHER, rows = min((uint)ROWS_TOGETHER, (uint)tiles_y - first);
        column = (here - first * across) / rows;
        row = first + (here - first * across) % rows;
        tile = view_index * view_tiles + row * across + column;
    }
    int x0 = (int)column * TILE_W, y0 = (int)row * TILE_H;

    // in a tile without splats all blocks are equal, so only one is computed
    const uint base = starts[first_tile];
    const bool empty = starts[tile] == starts[tile + 1]
//@@ empty
        ;
    Pixel pixels[BLOCKS];
    for (int block = 0; block < (empty ? 1 : BLOCKS); block++) pixel_start(&pixels[block]);
//@@ lanes_start
//@@ pixels_start
    const uint in_image = empty ? 0 : blocks_within(0, min(width - x0, TILE_W), 0, min(height - y0, TILE_H));
    uint alive = in_image;      // blocks that are not terminated

//@@ pass
//@@ tile_loop
            vfloat x = (float)(x0 + LEFT(block)) + BLOCK_X - (vfloat)s.ax, y = (float)(y0 + TOP(block)) + BLOCK_Y - (vfloat)s.ay;
            vfloat nu_x = FMA((vfloat)s.nux, x, (vfloat)s.nu0);
            vfloat nv_x = FMA((vfloat)s.nvx, x, (vfloat)s.nv0);
            vfloat d_x = FMA((vfloat)s.dx, x, (vfloat)s.d0);
            Intersection c = intersect_row(&s, nu_x, nv_x, d_x, y, half_r2);
//@@ intersect
            vfloat lowpass_half_rho;
            vint mask = fragment_mask(&s, c, x, y, half_r2, constants.sample_area, &lowpass_half_rho);
//@@ mask
//@@ skip_fragment
            pixel_blend(&pixel, &s, c, mask, lowpass_half_rho, &constants
//@@ blend_arguments
            );
            if (UNLIKELY(!VANY(pixel_unfinished(&pixel, &constants)))) {
                alive &= ~(1u << block);
                break;
            }
//@@ tile_loop_end
//@@ pass_end

    size_t stride = (size_t)tiles_x * TILE_W, top = (size_t)view_index * tiles_y * TILE_H;
    for (int block = 0; block < BLOCKS; block++) {
        size_t at = (top + y0 + TOP(block)) * stride + x0 + LEFT(block);
        Pixel *pixel = &pixels[empty ? 0 : block];
        STORE_BASE(pixel, at);
//@@ store
    }
//@@ tile_stored
}
