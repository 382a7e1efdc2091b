// Splats that are printed on one plane have no order: at a pixel they are one layer, which nothing cuts. Cutting each into
// ever thinner sheets and shuffling the sheets gives the limit that does not depend on the order: optical depths
// tau = -ln(1 - opacity) add up, and what the layer shows is the mean of its fragments weighted by tau, its depth too. So a
// marker does not change when its splats are re-ordered or when a turning camera re-orders their centres (numerics C1).
//
// The splats of a plane stand together in the lists, where the nearest point of the plane puts them (plane_keys). When another
// splat follows, the layer waits as one fragment, among the others (slot/compose_pixel.cl).
//@ project
    record.plane = planes[i];
//@ functions
#define COPLANAR_RADIUS REAL(64.0)       // standard deviations; of boxes half sides
//@ coplanar_depth_reach
    // its fragments lie on the plane as far out as any cut-off and a low-pass let them be drawn: so those that a cut-off leaves
    // out move no layer, nor do boxes that are a small part of a pixel
    if (planes[i] >= 0) depth_reach = reach * (BOX_HERE ? COPLANAR_RADIUS : COPLANAR_RADIUS / radius);
//@ coplanar_nearest
    if (planes[i] >= 0) record.nearest = (wide)plane_keys[planes[i] * get_global_size(1) + number];
//@ coplanar_blocks_nearest
        if (s->plane >= 0) min_depth = s->nearest;      // a plane's stand together, in each block
//@ coplanar_lookahead
                if (s.plane >= 0) {                 // its layer may be nearer than its fragment, and be where that is not
                    z = s.nearest;
                    mask = -1;
                }
//@ chunk_end
        // and in one chunk, unless they fill several: the next begins with the first of them
        const int plane = splats[lists[places[length - 1]]].plane;
        if (plane >= 0 && ((read < end && splats[lists[read]].plane == plane)
                           || (deferred_count > 0 && splats[lists[(uint)deferred[deferred_count - 1]]].plane == plane))) {
            uint before = length;
            while (before > 0 && splats[lists[places[before - 1]]].plane == plane) before--;
            if (before > 0 && reads) read -= length - before;
            if (before > 0 && !reads) deferred_count += length - before;
            if (before > 0) length = before;
        }
//@ coplanar_dot_depth
        if (s->plane >= 0) on_plane = -1;           // in the dot too
//@ coplanar_attribute_depth
    attributes.z = fmax(attributes.z, (vfloat)s->nearest);
//@ compose_types
#define LAYER_FLAG 0x80000000u       // among indices of splats: none, but a layer

typedef struct {
    int plane;                  // -1: no layer
    wide nearest;               // its splats' key
    uint place;                 // of the first of its splats in the list
    vint lanes;                 // where it has fragments
    vfloat opacity;             // 1 - the product of its fragments' transmittances; itself, so that a faint one stays exact
    vfloat optical_depth;       // sum of its fragments'
    Attributes mean;                  // of its fragments by optical depth
//@@ layer_fields
} Layer;

static inline Layer no_layer(void) {
    Layer layer = {-1};         // and the rest 0
    return layer;
}
//@ state
    Layer open_layer;                 // the one that still gathers
//@ start
    pixel->open_layer = no_layer();
//@ k_buffer_queue_fields
    Attributes layers[K_BUFFER_SIZE + 1];   // an index of a splat that is LAYER_FLAG + k stands for the k-th
    uint layer_splats[K_BUFFER_SIZE + 1];
//@ k_buffer_fields
    uint free_layers;
//@ k_buffer_init
    k_buffer->free_layers = ~0u;
//@ k_buffer_insertion
    if (splat & LAYER_FLAG) {
        uint at = 31 - clz(k_buffer->free_layers & -k_buffer->free_layers);
        k_buffer->free_layers &= k_buffer->free_layers - 1;
        k_buffer->queue->layers[at] = pixel->open_layer.mean;
        k_buffer->queue->layer_splats[at] = place;
        splat = LAYER_FLAG | at;
    }
//@ k_buffer_eviction
    if (dropped & LAYER_FLAG) {
        k_buffer->free_layers |= 1u << (dropped & ~LAYER_FLAG);
        dropped = k_buffer->queue->layer_splats[dropped & ~LAYER_FLAG];
    }
//@ k_buffer_composition
    if (splat & LAYER_FLAG) {
        composite(pixel, &pixel->k_buffer.queue->layers[splat & ~LAYER_FLAG], opacity, VMASK(true), constants);
        pixel->k_buffer.free_layers |= 1u << (splat & ~LAYER_FLAG);
        return;
    }
//@ compose_functions
// Adds a fragment where `mask` is set.
static inline void layer_add(Layer *layer, const Splat *s, const Attributes *attributes, vfloat opacity, vint mask) {
    opacity = VSELECT((vfloat)0.0f, opacity, mask);
    // an opaque fragment has the optical depth at which float32 leaves no light
//@@ layer_tau
//@@ footprint_tau
    layer->lanes |= mask;
    layer->opacity = FMA(opacity, 1.0f - layer->opacity, layer->opacity);
    layer->optical_depth += tau;
//@@ footprint_layer
    vfloat share = VSELECT((vfloat)0.0f, tau / layer->optical_depth, VMASK(tau > 0.0f));
    layer->mean.r = FMA(share, attributes->r - layer->mean.r, layer->mean.r);
    layer->mean.g = FMA(share, attributes->g - layer->mean.g, layer->mean.g);
    layer->mean.b = FMA(share, attributes->b - layer->mean.b, layer->mean.b);
//@@ layer_accumulate
}
//@ coplanar_functions
// Nothing more comes of the open layer's plane: it waits, nearer by a little more than depths are rounded, so that it lies
// before splats of no plane that lie in it.
static inline void layer_close(Pixel *pixel, vfloat nearest, global const Splat *splats, const BlendConstants *constants) {
    const Layer *open_layer = &pixel->open_layer;
    if (open_layer->plane < 0) return;
    vfloat z = fmax(FMA(fabs(open_layer->mean.z), (vfloat)-0x1p-16f, open_layer->mean.z), (vfloat)open_layer->nearest);
    k_buffer_insert(pixel, nearest, z, open_layer->opacity, &open_layer->mean, LAYER_FLAG, open_layer->place, open_layer->lanes, splats, constants);
    pixel->open_layer = no_layer();
}

//@ coplanar_finish
    layer_close(pixel, INFINITY, splats, constants);
//@ compose_coplanar_group
    if (s->plane != pixel->open_layer.plane) {
        layer_close(pixel, this_nearest, splats, constants);
        pixel->open_layer.plane = s->plane;
        pixel->open_layer.nearest = s->nearest;
        pixel->open_layer.place = place;
    }
    if (s->plane >= 0) {
        layer_add(&pixel->open_layer, s, &attributes, opacity, mask);
        return;
    }
