// Pruning and densification of an array: gathers the rows of the new set of splats. Reference: Plan in fidsplat/train/densify.py.

// Index space: one work-item per element of the new array (count, row). Reads: the old array, rows (count). Writes: its rows in
// this order, zeros from row `copied` on.
kernel void gather_rows(
//@@ arguments gather_rows
) {
    size_t k = get_global_id(0);
    uint i = (uint)(k / row);
    if (i < count) gathered[k] = i < copied ? source[rows[i] * (size_t)row + k % row] : 0.0f;
}
