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

//@@ blend_types
typedef struct {
    vfloat t;               // transmittance in front of the next fragment
//@@ color_state
//@@ state
} Pixel;

typedef struct {            // uniforms of the blend stage
    blend_real log_alpha_cutoff, opacity_ceiling, transmittance_stop, sample_area;
} BlendConstants;

static inline void pixel_start(Pixel *pixel) {
    pixel->t = 1.0f;
//@@ color_start
//@@ start
}

//@@ fragment_mask
//@@ fragment_half_rho

// Attributes of a fragment.
static inline Attributes fragment_attributes(const Splat *s, Intersection c, vfloat inverse_d) {
    Attributes attributes;
    attributes.r = s->r;
    attributes.g = s->g;
    attributes.b = s->b;
//@@ attribute_values
    return attributes;
}

// Composites a fragment in front of all later fragments, where `mask` is set and the pixel is not terminated.
static inline void composite(Pixel *pixel, const Attributes *attributes, vfloat alpha, vint mask, const BlendConstants *constants) {
    vint live = mask & VMASK(pixel->t > constants->transmittance_stop);
//@@ stop
//@@ color_composite
//@@ composite
//@@ color_transmit
}

// Pixels that are not terminated.
static inline vint pixel_transmits(const Pixel *pixel, const BlendConstants *constants) {
    return VMASK(pixel->t > constants->transmittance_stop)
//@@ transmits
        ;
}

// Pixels that a later fragment can still change.
static inline vint pixel_unfinished(const Pixel *pixel, const BlendConstants *constants) {
    return pixel_transmits(pixel, constants)
//@@ unfinished
        ;
}

//@@ blend_functions
// Renders a fragment where `mask` is set: composites it, or inserts it into the k-buffer.
static inline void pixel_blend(Pixel *pixel, const Splat *s, Intersection c, vint mask, vfloat lowpass_half_rho,
                               const BlendConstants *constants
//@@ blend_parameters
) {
    vfloat inverse_d = INVERSE_D(c);
    vfloat alpha = fragment_alpha(s, fragment_half_rho(s, c, inverse_d, lowpass_half_rho), constants->opacity_ceiling);
//@@ footprint_alpha
//@@ without_layers
    const Attributes attributes = fragment_attributes(s, c, inverse_d);
//@@ occlude
//@@ layers
//@@ blend_fragment
}

//@@ color_functions
