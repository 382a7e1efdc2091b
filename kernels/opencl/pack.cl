// Compaction for clouds that are projected in chunks: appends the visible splats of a chunk to those of preceding chunks, in
// order. The chunk is cut into CHUNKS pieces; the host adds up their counts.

// Index space: one work-item per piece. Reads: keys. Writes: held[0 .. CHUNKS): splats of the piece in this band,
// held[CHUNKS .. 2 * CHUNKS): splats of the piece in any band.
kernel void pack_count(
//@@ arguments pack_count
) {
    uint piece = get_global_id(0);
    if (piece >= CHUNKS) return;
    uint each = (count + CHUNKS - 1) / CHUNKS;
    uint from = min(piece * each, count), to = min(from + each, count), packed = 0, visible = 0;
    for (uint k = from; k < to; k++) {
        packed += keys[k] < OUT_OF_BAND;
        visible += keys[k] != CULLED;
    }
    held[piece] = packed;
    held[CHUNKS + piece] = visible;
}

// Index space: one work-item per piece. Reads: places (output index of each piece), splats, keys, windows.
// Writes: splats_out, keys_out, windows_out.
kernel void pack_move(
//@@ arguments pack_move
) {
    uint piece = get_global_id(0);
    if (piece >= CHUNKS) return;
    uint each = (count + CHUNKS - 1) / CHUNKS;
    uint from = min(piece * each, count), to = min(from + each, count), place = places[piece];
    for (uint k = from; k < to; k++)
        if (keys[k] < OUT_OF_BAND) {
            splats_out[place] = splats[k];
            keys_out[place] = keys[k];
            windows_out[place] = windows[k];
            place++;
        }
}
