// For CPUs: one work-item draws one tile, a row of LANES pixels at a time; no barriers, no local memory.
// Index space: one work-item (and work-group) per tile of each view.
// Reads:  splats, lists, starts[tiles + 1]. Writes: raw (4 channels: r, g, b, transmittance) and the outputs' samples, whole tiles.
// Splats of a tile lie anywhere in memory; the ones to come are fetched ahead.
#define AHEAD_SPLATS 8

kernel void blend(
//@@ arguments blend
) {
    const BlendConstants constants = {log_cut, ceiling, stop, filter};
    uint tile = band_first + get_global_id(0);
    int tiles_x = (width + TILE_W - 1) / TILE_W, tiles_y = (height + TILE_H - 1) / TILE_H;
    uint number = tile / (uint)(tiles_x * tiles_y), here = tile - number * (uint)(tiles_x * tiles_y);
    int x0 = (int)(here % (uint)tiles_x) * TILE_W, y0 = (int)(here / (uint)tiles_x) * TILE_H;

    Pixel pixels[TILE_H];
    for (int row = 0; row < TILE_H; row++) pixel_start(&pixels[row]);
//@@ lanes_start
//@@ pixels_start
    // rows that still let light through; those below the picture never do
    int rows = min(height - y0, TILE_H);
    uint alive = rows == 32 ? 0xFFFFFFFFu : (1u << rows) - 1u;

    uint base = starts[band_first];
//@@ pass
    for (uint k = starts[tile] - base, end = starts[tile + 1] - base; k < end && alive; k++) {
        FETCH_AHEAD(splats + lists[min(k + AHEAD_SPLATS, end - 1)]);
        FETCH_AHEAD((global const char *)(splats + lists[min(k + AHEAD_SPLATS, end - 1)]) + 64);
        const Splat s = splats[lists[k]];
        wide half_r2 = s.log_opacity - constants.log_cut;
        int first = max(s.y0 - y0, 0), last = min(s.y1 - y0, TILE_H);
        vfloat x = (vfloat)(float)(x0 - s.ax) + VLANE;
        vfloat nu_x = FMA((vfloat)s.nux, x, (vfloat)s.nu0);
        vfloat nv_x = FMA((vfloat)s.nvx, x, (vfloat)s.nv0);
        vfloat d_x = FMA((vfloat)s.dx, x, (vfloat)s.d0);
        for (int row = first; row < last; row++) {
            if (!(alive >> row & 1u)) continue;
            wide y = (wide)(y0 + row - s.ay);
            Crossing c = cross_row(&s, nu_x, nv_x, d_x, y, half_r2);
//@@ cross
            vfloat screen;
            vint mask = fragment_mask(&s, c, x, y, half_r2, constants.filter, &screen);
//@@ mask
            if (!VANY(mask)) continue;
            pixel_blend(&pixels[row], &s, c, mask, screen, &constants
//@@ blend_arguments
            );
            if (!VANY(pixel_unfinished(&pixels[row], &constants))) alive &= ~(1u << row);
        }
    }
//@@ pass_end

    size_t stride = (size_t)tiles_x * TILE_W, top = (size_t)number * tiles_y * TILE_H;
    for (int row = 0; row < TILE_H; row++) {
        size_t at = (top + y0 + row) * stride + x0;
        Pixel *pixel = &pixels[row];
        PIXEL_STORE_BASE(pixel, raw, plane, at);
//@@ store
    }
}
