// Splats that are printed on one plane have no order: at a pixel they are one layer, which nothing cuts. Cutting each into
// ever thinner sheets and shuffling the sheets gives the limit that does not depend on the order: optical depths
// tau = -ln(1 - opacity) add up, and what the layer shows is the mean of its fragments weighted by tau. So a marker does
// not change when its splats are re-ordered or when a turning camera re-orders their centres (numerics C1).
//
// The splats of a plane arrive together (plane_keys), before anything that the layer is compared with. It is pending until
// a fragment of no plane (-1) arrives whose own depth at the pixel lies behind the layer's, or nothing more arrives. Of
// more than two pending layers the nearer of the first two is composited when the third begins.
//@ project
    record.plane = planes[i];
//@ key
    if (planes[i] >= 0) key = plane_keys[planes[i]];
//@ compose_types
typedef struct {
    vint plane;             // -1: no layer
    vfloat opacity;         // 1 - the product of its fragments' transmittances; itself, so that a faint one stays exact
    vfloat optical_depth;   // sum of its fragments'
    Seen mean;              // of its fragments by optical depth
//@@ layer
} Layer;

static inline Layer no_layer(void) {
    Layer layer = {(vint)(-1)};     // and the rest 0
    return layer;
}

//@ state
    Layer open, waiting;    // pending: the one that still gathers, and one that arrived before it
//@ start
    pixel->open = pixel->waiting = no_layer();
//@ compose_functions
// Makes a layer another one where `mask` is set.
static inline void layer_pick(Layer *layer, const Layer *other, vint mask) {
    layer->plane = VSELECT(layer->plane, other->plane, mask);
    layer->opacity = VSELECT(layer->opacity, other->opacity, mask);
    layer->optical_depth = VSELECT(layer->optical_depth, other->optical_depth, mask);
    layer->mean.r = VSELECT(layer->mean.r, other->mean.r, mask);
    layer->mean.g = VSELECT(layer->mean.g, other->mean.g, mask);
    layer->mean.b = VSELECT(layer->mean.b, other->mean.b, mask);
//@@ pick
}

// Adds a fragment where `mask` is set.
static inline void layer_gather(Layer *layer, const Splat *s, const Seen *seen, vfloat opacity, vint mask) {
    opacity = VSELECT((vfloat)0.0f, opacity, mask);
    // an opaque fragment has the optical depth at which float32 leaves no light
//@@ layer_tau
//@@ footprint_tau
    layer->plane = VSELECT(layer->plane, (vint)s->plane, mask);
    layer->opacity = FMA(opacity, 1.0f - layer->opacity, layer->opacity);
    layer->optical_depth += tau;
//@@ footprint_gather
    vfloat share = VSELECT((vfloat)0.0f, tau / layer->optical_depth, VMASK(tau > 0.0f));
    layer->mean.r = FMA(share, seen->r - layer->mean.r, layer->mean.r);
    layer->mean.g = FMA(share, seen->g - layer->mean.g, layer->mean.g);
    layer->mean.b = FMA(share, seen->b - layer->mean.b, layer->mean.b);
//@@ gather
}

static inline void layer_composite(Pixel *pixel, Layer *layer, vint mask, const BlendConstants *constants) {
    if (!VANY(mask)) return;
    const Layer none = no_layer();
    composite(pixel, &layer->mean, layer->opacity, mask, constants);
    layer_pick(layer, &none, mask);
}

// Composites the pending layers `open` and `waiting` (masks), the nearer first.
static inline void layers_composite(Pixel *pixel, vint open, vint waiting, const BlendConstants *constants) {
    vint nearer = open & waiting & VMASK(pixel->open.mean.z < pixel->waiting.mean.z);
    layer_composite(pixel, &pixel->open, nearer, constants);
    layer_composite(pixel, &pixel->waiting, waiting, constants);
    layer_composite(pixel, &pixel->open, open & ~nearer, constants);
}

// A layer of another plane begins: the open one waits, and of two that would wait the nearer is composited.
static inline void layers_shift(Pixel *pixel, vint begins, const BlendConstants *constants) {
    vint both = begins & VMASK(pixel->waiting.plane >= 0);
    vint nearer = both & VMASK(pixel->open.mean.z < pixel->waiting.mean.z);
    layer_composite(pixel, &pixel->open, nearer, constants);
    layer_composite(pixel, &pixel->waiting, both & ~nearer, constants);
    const Layer none = no_layer();
    vint moves = begins & ~nearer;
    layer_pick(&pixel->waiting, &pixel->open, moves);
    layer_pick(&pixel->open, &none, moves);
}
//@ compose
    if (s->plane < 0) {
        vint open = mask & VMASK(pixel->open.plane >= 0) & VMASK(pixel->open.mean.z < seen.z);
        vint waiting = mask & VMASK(pixel->waiting.plane >= 0) & VMASK(pixel->waiting.mean.z < seen.z);
        if (VANY(open | waiting)) layers_composite(pixel, open, waiting, constants);
        composite(pixel, &seen, opacity, mask, constants);
    } else {
        vint begins = mask & VMASK(pixel->open.plane >= 0) & VMASK(pixel->open.plane != (vint)s->plane);
        if (VANY(begins)) layers_shift(pixel, begins, constants);
        layer_gather(&pixel->open, s, &seen, opacity, mask);
    }
//@ finish
    layers_composite(pixel, VMASK(pixel->open.plane >= 0), VMASK(pixel->waiting.plane >= 0), constants);
