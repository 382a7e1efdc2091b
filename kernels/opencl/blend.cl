// Front-to-back alpha compositing of one fragment per pixel (2DGS, section 3.1): C = sum_k c_k alpha_k prod_{j<k} (1 - alpha_j).
// The schedules (schedule/*.cl) call it for the splats of a tile in depth order.

typedef struct {            // colour and outputs of a fragment or layer
    vfloat r, g, b;
//@@ attributes
} Attributes;

typedef union {
    Attributes attributes;
    vfloat fields[sizeof(Attributes) / sizeof(vfloat)];
} AttributeFields;

//@@ compose_types
typedef struct {
    vfloat t;               // transmittance in front of the next fragment
    vfloat r, g, b;
//@@ state
} Pixel;

typedef struct {            // uniforms of the blend stage
    wide log_cut, ceiling, stop, filter;
} BlendConstants;

static inline void pixel_start(Pixel *pixel) {
    pixel->t = 1.0f;
    pixel->r = 0.0f;
    pixel->g = 0.0f;
    pixel->b = 0.0f;
//@@ start
}

//@@ fragment_mask
//@@ fragment_half_rho

// Attributes of a fragment.
static inline Attributes fragment_attributes(const Splat *s, Crossing c, vfloat inverse_d) {
    Attributes attributes;
    attributes.r = s->r;
    attributes.g = s->g;
    attributes.b = s->b;
//@@ attribute_values
    return attributes;
}

// Composites a fragment in front of everything behind it, where `mask` is set and the pixel is not terminated.
static inline void composite(Pixel *pixel, const Attributes *attributes, vfloat opacity, vint mask, const BlendConstants *constants) {
    vint live = mask & VMASK(pixel->t > constants->stop);
//@@ stop
#if LANES == 1
    vfloat weight = pixel->t * VSELECT((vfloat)0.0f, opacity, live);
#else
    vfloat full_weight = pixel->t * opacity, weight = VSELECT((vfloat)0.0f, full_weight, live);
#endif
    pixel->r = FMA(weight, attributes->r, pixel->r);
    pixel->g = FMA(weight, attributes->g, pixel->g);
    pixel->b = FMA(weight, attributes->b, pixel->b);
//@@ composite
#if LANES == 1
    pixel->t = pixel->t - weight;
#else       // in the order of fragments; `live` is computed in parallel
    pixel->t = VSELECT(pixel->t, pixel->t - full_weight, live);
#endif
}

// Pixels that are not terminated.
static inline vint pixel_transmits(const Pixel *pixel, const BlendConstants *constants) {
    return VMASK(pixel->t > constants->stop)
//@@ transmits
        ;
}

// Pixels that a later fragment can still change.
static inline vint pixel_unfinished(const Pixel *pixel, const BlendConstants *constants) {
    return pixel_transmits(pixel, constants)
//@@ unfinished
        ;
}

//@@ compose_functions
// Renders a fragment where `mask` is set: composites it, or inserts it into the k-buffer.
static inline void pixel_blend(Pixel *pixel, const Splat *s, Crossing c, vint mask, vfloat screen,
                               const BlendConstants *constants
//@@ blend_parameters
) {
    vfloat inverse_d = INVERSE_D(c);
    vfloat opacity = fragment_opacity(s, fragment_half_rho(s, c, inverse_d, screen), constants->ceiling);
//@@ footprint_opacity
    const Attributes attributes = fragment_attributes(s, c, inverse_d);
//@@ occlude
//@@ layers
//@@ compose
}

// Stores LANES pixels at index `at` of each channel of `raw`; a channel has `channel_stride` samples.
#define PIXEL_STORE_BASE(pixel, raw, channel_stride, at) \
    BLOCK_STORE((pixel)->r, raw + (at), stride); \
    BLOCK_STORE((pixel)->g, raw + (channel_stride) + (at), stride); \
    BLOCK_STORE((pixel)->b, raw + 2 * (channel_stride) + (at), stride); \
    BLOCK_STORE((pixel)->t, raw + 3 * (channel_stride) + (at), stride)
