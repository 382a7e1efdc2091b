// Colours and transmittance in half precision, two in one register: (r, g) and (b, transmittance). Opacities, colours and each sum are
// rounded to half, to nearest even. Intersections, lists and outputs other than rgb and alpha stay in float.
//@ arithmetic
// A pair of halves. HALF_PAIR rounds two floats, HALF_FMA rounds once; without a vendor's instructions, the same bits in float.
#ifndef HALF_FMA
typedef struct {
    vfloat low, high;
} half_pair;
#define HALF_LOW(pair) ((pair).low)
#define HALF_HIGH(pair) ((pair).high)

// Nearest half of a float below 65520: 11 significant bits, or a multiple of 2^-24 where it is subnormal.
static inline vfloat round_half(vfloat x) {
    vint bits = VAS_INT(x);
    vfloat normal = VAS_FLOAT((bits + 0xFFF + (bits >> 13 & 1)) & ~0x1FFF);
    return VSELECT(normal, (x + 0.75f) - 0.75f, VMASK(fabs(x) < 0x1p-14f));
}

// Nearest half of a * b + c for halves. The product is exact; the sum is rounded to odd, so that two roundings equal one.
static inline vfloat fma_half(vfloat a, vfloat b, vfloat c) {
    vfloat product = a * b, sum = product + c, other = sum - product;
    vfloat rest = (product - (sum - other)) + (c - other);
    vint bits = VAS_INT(sum), away = 1 - 2 * (((VAS_INT(rest) ^ bits) >> 31) & 1);
    return round_half(VAS_FLOAT(VSELECT(bits, bits + away, VMASK(rest != 0.0f) & VMASK((bits & 1) == 0))));
}

static inline half_pair HALF_PAIR(vfloat low, vfloat high) {
    half_pair pair = {round_half(low), round_half(high)};
    return pair;
}
static inline half_pair HALF_BY_HIGH(half_pair a, half_pair b) {        // a times the high half of b
    half_pair pair = {round_half(a.low * b.high), round_half(a.high * b.high)};
    return pair;
}
static inline half_pair HALF_FMA(half_pair a, half_pair b, half_pair c) {
    half_pair pair = {fma_half(a.low, b.low, c.low), fma_half(a.high, b.high, c.high)};
    return pair;
}

static inline uint pack_halves(float low, float high) {
    uint words;
    vstore_half_rte(low, 0, (half *)&words);
    vstore_half_rte(high, 1, (half *)&words);
    return words;
}
#define WORDS_LOW(words) vload_half(0, (const half *)&(words))
#define WORDS_HIGH(words) vload_half(1, (const half *)&(words))
#define COLOR_RG(attributes) HALF_PAIR((attributes)->r, (attributes)->g)
#define COLOR_B1(attributes) HALF_PAIR((attributes)->b, (vfloat)-1.0f)
#else
#define pack_halves HALF_PAIR
#define WORDS_LOW HALF_LOW
#define WORDS_HIGH HALF_HIGH
#define COLOR_RG(attributes) (attributes)->rg
#define COLOR_B1(attributes) (attributes)->b1
#define COLOR_WORDS
#endif
static inline float within_half(float color) { return clamp(color, -65504.0f, 65504.0f); }     // the range of halves
//@ splat_view
    blend_real unpacked_r, unpacked_g, unpacked_b;
//@ color
    record.rg = pack_halves(within_half(unpacked_r), within_half(unpacked_g));
    record.b1 = pack_halves(within_half(unpacked_b), -1.0f);
//@ attributes
#ifdef COLOR_WORDS
    half_pair rg, b1;           // the colour, packed
#endif
//@ attribute_values
#ifdef COLOR_WORDS
    attributes.rg = s->rg;
    attributes.b1 = s->b1;
#endif
//@ layer_accumulate
#ifdef COLOR_WORDS
    layer->mean.rg = HALF_PAIR(layer->mean.r, layer->mean.g);
    layer->mean.b1 = HALF_PAIR(layer->mean.b, -1.0f);
#endif
//@ external_attributes
#ifdef COLOR_WORDS
        attributes.rg = HALF_PAIR(attributes.r, attributes.g);
        attributes.b1 = HALF_PAIR(attributes.b, -1.0f);
#endif
//@ color_state
    half_pair rg, bt;           // (r, g) and (b, t)
//@ color_start
    pixel->rg = HALF_PAIR((vfloat)0.0f, (vfloat)0.0f);
    pixel->bt = HALF_PAIR((vfloat)0.0f, (vfloat)1.0f);
//@ color_composite
    vfloat visible = VSELECT((vfloat)0.0f, alpha, live);
    half_pair weights = HALF_BY_HIGH(HALF_PAIR(visible, visible), pixel->bt);
    vfloat weight = HALF_LOW(weights);
    pixel->rg = HALF_FMA(weights, COLOR_RG(attributes), pixel->rg);
    pixel->bt = HALF_FMA(weights, COLOR_B1(attributes), pixel->bt);
//@ color_transmit
    pixel->t = HALF_HIGH(pixel->bt);
//@ color_functions
// Stores LANES pixels at index `at` of each channel of `raw`; a channel has `channel_stride` samples.
#define PIXEL_STORE_BASE(pixel, raw, channel_stride, at) \
    BLOCK_STORE(HALF_LOW((pixel)->rg), raw + (at), stride); \
    BLOCK_STORE(HALF_HIGH((pixel)->rg), raw + (channel_stride) + (at), stride); \
    BLOCK_STORE(HALF_LOW((pixel)->bt), raw + 2 * (channel_stride) + (at), stride); \
    BLOCK_STORE((pixel)->t, raw + 3 * (channel_stride) + (at), stride)
