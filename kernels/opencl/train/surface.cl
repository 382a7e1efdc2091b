// Normal consistency loss: rendered normals against the normals of the depth map. NumPy reference with formulas: `normal_loss` in
// fidsplat/train/losses.py.

// Ray through a pixel, with z = 1. lens: fx, fy, cx, cy.
static inline float3 ray_at(int x, int y, global const float *lens) {
    float3 ray = {(x + 0.5f - lens[2]) / lens[0], (y + 0.5f - lens[3]) / lens[1], 1.0f};
    return ray;
}

// Unprojected point of a pixel.
#define POINT(x, y) (ray_at(x, y, lenses + 4 * view_index) * depth[(y) * (size_t)width + (x)])
#define HAS_DEPTH(x, y) (depth[(y) * (size_t)width + (x)] > 0.0f)

// Index space: (columns, rows). Reads: the images, the mask. Writes: the gradients with respect to normals and, for each pixel, the
// differences of the points below and above it, right and left of it.
kernel void surface_normals(
//@@ arguments surface_normals
) {
    int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    size_t at = y * (size_t)width + x;
    bool counts = !masked || mask[at];
    float3 grad_n = 0.0f, grad_down = 0.0f, grad_across = 0.0f;
    if (counts && x > 0 && y > 0 && x + 1 < width && y + 1 < height && HAS_DEPTH(x, y) && HAS_DEPTH(x - 1, y) && HAS_DEPTH(x + 1, y)
        && HAS_DEPTH(x, y - 1) && HAS_DEPTH(x, y + 1)) {
        float3 down = POINT(x, y + 1) - POINT(x, y - 1), across = POINT(x + 1, y) - POINT(x - 1, y);
        float3 crossed = cross(down, across);
        float size = sqrt(dot(crossed, crossed));
        if (size > 0.0f) {
            float3 unit_n = crossed / size, own = vload3(at, normal);
            float share = normal_weight * alpha[at];
            grad_n = -share * unit_n;
            float3 grad_crossed = (-share / size) * (own - dot(unit_n, own) * unit_n);
            grad_down = cross(across, grad_crossed);
            grad_across = cross(grad_crossed, down);
        }
    }
    vstore3(grad_n, at, grad_normal);
    vstore3(grad_down, 2 * at, differences);
    vstore3(grad_across, 2 * at + 1, differences);
}

// Index space: (columns, rows). Reads: differences. Writes: the gradients with respect to depths.
kernel void surface_depths(
//@@ arguments surface_depths
) {
    int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    size_t at = y * (size_t)width + x;
    float3 by = 0.0f;
    if (y > 0) by += vload3(2 * (at - width), differences);
    if (y + 1 < height) by -= vload3(2 * (at + width), differences);
    if (x > 0) by += vload3(2 * (at - 1) + 1, differences);
    if (x + 1 < width) by -= vload3(2 * (at + 1) + 1, differences);
    float3 ray = ray_at(x, y, lenses + 4 * view_index);
    grad_depth[at] = ray.x * by.x + ray.y * by.y + by.z;
}
