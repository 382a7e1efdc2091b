// Resolve fused into blend, for one sample per pixel: saves a launch, and the buffer `raw`, as colours stay in registers.
//@ color_functions
#define BASE_SAMPLE(channel, at) base[channel]
#define STORE_BASE(pixel, at) float base[4]; PIXEL_STORE_BASE(pixel, base, 1, 0)
//@ pixel_stored
        if (px < width && py + row < height) {
            const int x = px, y = py + row;
            const size_t first = at;
//@@ resolve_pixel
        }
