// The splats that go on, and those that come: the twin of fidsplat/train/densify.py's Plan.

// Index space: one work-item per number of an array (count, row) that is made. Reads: the array that there was, rows (count). Writes:
// its rows in this order, zeros from the row `kept` on.
kernel void pick(
//@@ arguments pick
) {
    size_t k = get_global_id(0);
    uint i = (uint)(k / row);
    if (i < count) picked[k] = i < kept ? before[rows[i] * (size_t)row + k % row] : 0.0f;
}
