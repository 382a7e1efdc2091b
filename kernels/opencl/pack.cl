// Compaction for clouds that are projected in chunks: appends the visible splats of a chunk to those of preceding chunks, in
// order. The chunk is cut into CHUNKS pieces; the host adds up their counts.

// Index space: one work-item per piece. Reads: keys. Writes: piece_counts[0 .. CHUNKS): splats of the piece in this band,
// piece_counts[CHUNKS .. 2 * CHUNKS): splats of the piece in any band.
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
    piece_counts[piece] = packed;
    piece_counts[CHUNKS + piece] = visible;
}

// Index space: one work-item per piece. Reads: piece_offsets (output index of each piece), splats, keys, windows.
// Writes: splats_out, keys_out, windows_out.
kernel void pack_move(
//@@ arguments pack_move
) {
    uint piece = get_global_id(0);
    if (piece >= CHUNKS) return;
    uint each = (count + CHUNKS - 1) / CHUNKS;
    uint from = min(piece * each, count), to = min(from + each, count), offset = piece_offsets[piece];
    for (uint k = from; k < to; k++)
        if (keys[k] < OUT_OF_BAND) {
            splats_out[offset] = splats[k];
            keys_out[offset] = keys[k];
            windows_out[offset] = windows[k];
            offset++;
        }
}
