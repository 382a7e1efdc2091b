// Sort keys of fragment order by tile, for splats that overlap more tiles than a window (GPUs): such a splat's nearest point is mostly in
// another tile, and fragments would wait for it in the k-buffer.
//@ big_records
    global const Splat *records;
//@ big_record_arguments
            , splats
//@ big_key
        if (key >= FIRST_DEPTH_KEY)
            key = sortable(tile_nearest(splats->records[splat], tile % rect->tiles_x * TILE_W, tile / rect->tiles_x * TILE_H));
//@ staged
        for (uint which = item; which < length; which += GROUP) {
            local Splat *s = &staged[which].splat;
            // a rectangle that no window holds (tile_window)
            if ((s->y1 - 1) / TILE_H - s->y0 / TILE_H >= WINDOW_H || (s->x1 - 1) / TILE_W - s->x0 / TILE_W >= WINDOW_W)
                s->nearest = tile_nearest(*s, x0, y0);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
//@ blend_types
// Equal depths are ordered by the keys of splats, then by index, as in lists without keys by tile.
#define TIE_IN_FRONT(splat, other) precedes(splats, splat, other)
#define BEFORE_NEXT(z, nearest) ((z) < (nearest))
