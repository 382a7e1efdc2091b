// Morton order of large clouds on GPUs: the splats of a warp write to the same tiles, and groups of splats can be culled. A counting sort by
// the cells of a grid; the order within a cell is arbitrary, since images do not depend on it.
#define BITS 7          // of a cell's coordinate

// Index space: one work-item per splat.
// Reads: means. Updates: cells, a counter for each cell of the grid from `low`, `scale` cells per metre: the number of its splats, or, if
// `scatter`, the position of its next splat. Writes, if `scatter`: order.
kernel void sort_by_cells(
    global const float *means, uint count, float low_x, float low_y, float low_z, float scale, global uint *cells, int scatter,
    global int *order) {
    uint i = get_global_id(0), cell = 0;
    if (i >= count) return;
    float3 at = (vload3(i, means) - (float3)(low_x, low_y, low_z)) * scale;
    uint3 axes = convert_uint3(fmin(fmax(at, 0.0f), (float)((1 << BITS) - 1)));     // 0 for NaN
    for (int bit = 0; bit < BITS; bit++)
        cell |= ((axes.x >> bit & 1u) | (axes.y >> bit & 1u) << 1 | (axes.z >> bit & 1u) << 2) << (3 * bit);
    uint position = atomic_inc(cells + cell);
    if (scatter) order[position] = (int)i;
}

// Index space: one work-item for each of the `words` words of each splat. Reads: source, order. Writes: gathered, zeros after `size` words.
kernel void gather_splats(global const uint *source, global const int *order, ulong size, uint words, global uint *gathered) {
    ulong at = get_global_id(0);
    gathered[at] = at < size ? source[(ulong)order[at / words] * words + at % words] : 0;
}

// Index space: one work-item per group of `group` splats. Reads: means, scales, opacities, and thickness, boxes if the cloud has these.
// Writes: spheres, the centre and radius of a sphere around the centres of a group; infinite if one of the splats must not be culled by
// its own sphere (part/cull_frustum.cl): boxes, and opacities above 1. max_scales.
kernel void bound_groups(
    global const float *means, global const float *scales, global const float *opacities, global const float *thickness,
    global const int *boxes, int has_thickness, int has_boxes, uint group, uint groups, global float4 *spheres, global float *max_scales) {
    uint first = get_global_id(0) * group;
    if (get_global_id(0) >= groups) return;
    float3 low = INFINITY, high = -INFINITY;
    float max_scale = 0, square = 0;
    for (uint i = first; i < first + group; i++) {
        low = fmin(low, vload3(i, means));
        high = fmax(high, vload3(i, means));
        max_scale = fmax(max_scale, fmax(scales[2 * i], scales[2 * i + 1]));
        if (has_thickness) max_scale = fmax(max_scale, thickness[i]);
    }
    float3 center = 0.5f * low + 0.5f * high;
    for (uint i = first; i < first + group; i++) {
        float3 offset = vload3(i, means) - center;
        square = fmax(square, dot(offset, offset));
        if (!(opacities[i] <= 1.0f) || (has_boxes && boxes[i])) square = INFINITY;
    }
    spheres[get_global_id(0)] = (float4)(center, 1.0001f * sqrt(square));       // for rounding
    max_scales[get_global_id(0)] = max_scale;
}
