// Colours and transmittance of a pixel in the type of fragments.
//@ color_state
    vfloat r, g, b;
//@ color_start
    pixel->r = 0.0f;
    pixel->g = 0.0f;
    pixel->b = 0.0f;
//@ color_composite
#if LANES == 1
    vfloat weight = pixel->t * VSELECT((vfloat)0.0f, alpha, live);
#else
    vfloat full_weight = pixel->t * alpha, weight = VSELECT((vfloat)0.0f, full_weight, live);
#endif
    pixel->r = FMA(weight, attributes->r, pixel->r);
    pixel->g = FMA(weight, attributes->g, pixel->g);
    pixel->b = FMA(weight, attributes->b, pixel->b);
//@ color_transmit
#if LANES == 1
    pixel->t = pixel->t - weight;
#else       // sequential in the order of fragments; `live` is computed in parallel
    pixel->t = VSELECT(pixel->t, pixel->t - full_weight, live);
#endif
//@ color_functions
// Stores LANES pixels at index `at` of each channel of `raw`; a channel has `channel_stride` samples.
#define PIXEL_STORE_BASE(pixel, raw, channel_stride, at) \
    BLOCK_STORE((pixel)->r, raw + (at), stride); \
    BLOCK_STORE((pixel)->g, raw + (channel_stride) + (at), stride); \
    BLOCK_STORE((pixel)->b, raw + 2 * (channel_stride) + (at), stride); \
    BLOCK_STORE((pixel)->t, raw + 3 * (channel_stride) + (at), stride)
