// Blend stage for GPUs: one work-group per tile, ROWS pixels of a column per work-item; splats are staged in local memory.
// Barriers are only in loops with the same bounds for the complete work-group.
//
// ITEMS neighbouring work-items share a cell of CELL_W x CELL_H pixels and loop over those staged splats that overlap the cell:
// the cells of one warp have lists of their own.
// Index space: work-groups of TILE_W * TILE_H / ROWS, one per tile of each view.
// Reads:  splats, lists, starts[tiles + 1]. Writes: raw (4 channels: r, g, b, transmittance) and the outputs' samples, for complete
// tiles.

// Whether a pixel has only colour, transmittance and a flag of termination. Fragments outside of the mask are then blended with weight 0
// instead of skipped: without a branch, the rows of a work-item are executed in parallel (instruction-level parallelism).
#define COLOURS_ONLY (sizeof(Pixel) <= 5 * sizeof(vfloat))

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void blend(
//@@ arguments blend
) {
    local Staged staged[STAGED];
    local uint cells[CELLS_Y * CELLS_STRIDE / 4];           // [row of cells][splat]: a byte of bits, one per cell that the splat overlaps
    local uint touched[CELLS_X * CELLS_Y][ITEMS];           // [cell][work-item]: bits of the splats in the work-item's share
    local uchar cell_splats[CELLS_X * CELLS_Y][CELLS_STRIDE];    // [cell]: staged splats that overlap it, in order
    local int alive;
    const BlendConstants constants = {log_alpha_cutoff, opacity_ceiling, transmittance_stop, sample_area};
    uint tile = longest_first ? tile_order[get_group_id(0)] : first_tile + get_group_id(0), item = get_local_id(0);
    int tiles_x = (width + TILE_W - 1) / TILE_W, tiles_y = (height + TILE_H - 1) / TILE_H;
    uint view_index = tile / (uint)(tiles_x * tiles_y), here = tile - view_index * (uint)(tiles_x * tiles_y);
    int x0 = (int)(here % (uint)tiles_x) * TILE_W, y0 = (int)(here / (uint)tiles_x) * TILE_H;
    uint block = item / 32, part = item % 32 / ITEMS, cell_item = item % ITEMS;
    uint cell_x = block % CELL_W * BLOCK_X + part % BLOCK_X, cell_y = block / CELL_W * CELL_W + part / BLOCK_X;
    uint cell = cell_y * CELLS_X + cell_x;
    int px = x0 + (int)(cell_x * CELL_W + cell_item % CELL_W), py = y0 + (int)(cell_y * CELL_H + cell_item / CELL_W * ROWS);

    Pixel pixels[ROWS];
    for (int row = 0; row < ROWS; row++) pixel_start(&pixels[row]);
//@@ group_start
//@@ pixels_start

    uint base = starts[first_tile], start = starts[tile] - base, end = starts[tile + 1] - base;
//@@ pass
    for (uint staged_start = start, length; staged_start < end; staged_start += length) {
        length = min(end - staged_start, (uint)STAGED);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item == 0) alive = 0;
        // in vectors, so that neighbouring work-items read consecutive memory
        for (uint word = item; word < length * VECTORS; word += GROUP) {
            uint which = word / VECTORS, part = word % VECTORS;
            staged[which].words[part] = ((global const float4 *)(splats + lists[staged_start + which]))[part];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
//@@ staged
        for (int row = 0; row < ROWS; row++)
            if (px < width && py + row < height && pixel_unfinished(&pixels[row], &constants)
//@@ staged_open
            ) alive = 1;
        find_cells(staged, length, x0, y0, &constants, cells, touched
//@@ cells_arguments
        );
        barrier(CLK_LOCAL_MEM_FENCE);
        // uniform: all work-items read the same vote, taken before these splats are blended
//@@ voted
        if (!alive) break;
        uint listed = list_cell(cells, cell_x, cell_y, cell_item, length, touched[cell], cell_splats[cell]);
        // skipped if all pixels of the work-item are terminated
        bool unfinished = false;
        for (int row = 0; row < ROWS; row++)
            unfinished |= pixel_unfinished(&pixels[row], &constants)
//@@ staged_open
                ;
        if (!unfinished) listed = 0;
        for (uint k = 0; k < listed; k++) {
            uint which = cell_splats[cell][k];
            Staged copy;
            for (int part = 0; part < VECTORS; part++) copy.words[part] = staged[which].words[part];
            const Splat s = copy.splat;
            blend_real half_r2 = s.log_opacity - constants.log_alpha_cutoff;
            blend_real x = (blend_real)(px - s.ax);
            blend_real nu_x = FMA(s.nux, x, s.nu0), nv_x = FMA(s.nvx, x, s.nv0), d_x = FMA(s.dx, x, s.d0);
            for (int row = 0; row < ROWS; row++) {
                blend_real y = (blend_real)(py + row - s.ay);
                Intersection c = intersect_row(&s, nu_x, nv_x, d_x, y, half_r2);
//@@ intersect
                blend_real lowpass_half_rho;
                int mask = fragment_mask(&s, c, x, y, half_r2, constants.sample_area, &lowpass_half_rho);
//@@ mask
                if (!COLOURS_ONLY && !VANY(mask & pixel_transmits(&pixels[row], &constants))) continue;
                pixel_blend(&pixels[row], &s, c, mask, lowpass_half_rho, &constants
//@@ blend_arguments
                );
            }
        }
    }
//@@ pass_end

    size_t stride = (size_t)tiles_x * TILE_W, top = (size_t)view_index * tiles_y * TILE_H;
    for (int row = 0; row < ROWS; row++) {
        size_t at = (top + py + row) * stride + px;
        Pixel *pixel = &pixels[row];
        STORE_BASE(pixel, at);
//@@ store
//@@ pixel_stored
    }
}
