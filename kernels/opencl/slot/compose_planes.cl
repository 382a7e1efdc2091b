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
#define PLANE_RADIUS REAL(64.0)       // standard deviations; of boxes half sides
//@ plane_depth_reach
    // its fragments lie on the plane as far out as any cut-off and a low-pass let them be drawn: so those that a cut-off leaves
    // out move no layer, nor do boxes that are a small part of a pixel
    if (planes[i] >= 0) depth_reach = reach * (BOX_HERE ? PLANE_RADIUS : PLANE_RADIUS / radius);
//@ plane_nearest
    if (planes[i] >= 0) record.nearest = (wide)plane_keys[planes[i] * get_global_size(1) + number];
//@ plane_blocks_nearest
        if (s->plane >= 0) least = s->nearest;      // a plane's stand together, in each block
//@ plane_ahead
                if (s.plane >= 0) {                 // its layer may be nearer than its fragment, and be where that is not
                    z = s.nearest;
                    mask = -1;
                }
//@ chunk_end
        // and in one chunk, unless they fill several: the next begins with the first of them
        const int plane = splats[lists[places[length - 1]]].plane;
        if (plane >= 0 && ((read < end && splats[lists[read]].plane == plane)
                           || (count_early > 0 && splats[lists[(uint)early[count_early - 1]]].plane == plane))) {
            uint before = length;
            while (before > 0 && splats[lists[places[before - 1]]].plane == plane) before--;
            if (before > 0 && reads) read -= length - before;
            if (before > 0 && !reads) count_early += length - before;
            if (before > 0) length = before;
        }
//@ plane_dot_depth
        if (s->plane >= 0) on_plane = -1;           // in the dot too
//@ plane_see_depth
    seen.z = fmax(seen.z, (vfloat)s->nearest);
//@ compose_types
#define LAYER 0x80000000u       // among indices of splats: none, but a layer

typedef struct {
    int plane;                  // -1: no layer
    wide nearest;               // its splats' key
    uint place;                 // of the first of its splats in the list
    vint lanes;                 // where it has fragments
    vfloat opacity;             // 1 - the product of its fragments' transmittances; itself, so that a faint one stays exact
    vfloat optical_depth;       // sum of its fragments'
    Seen mean;                  // of its fragments by optical depth
//@@ layer
} Layer;

static inline Layer no_layer(void) {
    Layer layer = {-1};         // and the rest 0
    return layer;
}
//@ state
    Layer open;                 // the one that still gathers
//@ start
    pixel->open = no_layer();
//@ queued
    Seen layers[WAITING + 1];   // an index of a splat that is LAYER + k stands for the k-th
    uint layer_splats[WAITING + 1];
//@ sorted
    uint unused_layers;
//@ sorted_start
    waiting->unused_layers = ~0u;
//@ sorted_take
    if (splat & LAYER) {
        uint at = 31 - clz(waiting->unused_layers & -waiting->unused_layers);
        waiting->unused_layers &= waiting->unused_layers - 1;
        waiting->queue->layers[at] = pixel->open.mean;
        waiting->queue->layer_splats[at] = place;
        splat = LAYER | at;
    }
//@ sorted_drop
    if (dropped & LAYER) {
        waiting->unused_layers |= 1u << (dropped & ~LAYER);
        dropped = waiting->queue->layer_splats[dropped & ~LAYER];
    }
//@ sorted_composite
    if (splat & LAYER) {
        composite(pixel, &pixel->waiting.queue->layers[splat & ~LAYER], opacity, VMASK(true), constants);
        pixel->waiting.unused_layers |= 1u << (splat & ~LAYER);
        return;
    }
//@ compose_functions
// Adds a fragment where `mask` is set.
static inline void layer_gather(Layer *layer, const Splat *s, const Seen *seen, vfloat opacity, vint mask) {
    opacity = VSELECT((vfloat)0.0f, opacity, mask);
    // an opaque fragment has the optical depth at which float32 leaves no light
//@@ layer_tau
//@@ footprint_tau
    layer->lanes |= mask;
    layer->opacity = FMA(opacity, 1.0f - layer->opacity, layer->opacity);
    layer->optical_depth += tau;
//@@ footprint_gather
    vfloat share = VSELECT((vfloat)0.0f, tau / layer->optical_depth, VMASK(tau > 0.0f));
    layer->mean.r = FMA(share, seen->r - layer->mean.r, layer->mean.r);
    layer->mean.g = FMA(share, seen->g - layer->mean.g, layer->mean.g);
    layer->mean.b = FMA(share, seen->b - layer->mean.b, layer->mean.b);
//@@ gather
}
//@ plane_functions
// Nothing more comes of the open layer's plane: it waits, nearer by a little more than depths are rounded, so that it lies
// before splats of no plane that lie in it.
static inline void layer_close(Pixel *pixel, vfloat nearest, global const Splat *splats, const BlendConstants *constants) {
    const Layer *open = &pixel->open;
    if (open->plane < 0) return;
    vfloat z = fmax(FMA(fabs(open->mean.z), (vfloat)-0x1p-16f, open->mean.z), (vfloat)open->nearest);
    waiting_take(pixel, nearest, z, open->opacity, &open->mean, LAYER, open->place, open->lanes, splats, constants);
    pixel->open = no_layer();
}

//@ plane_end
    layer_close(pixel, INFINITY, splats, constants);
//@ compose_plane
    if (s->plane != pixel->open.plane) {
        layer_close(pixel, coming, splats, constants);
        pixel->open.plane = s->plane;
        pixel->open.nearest = s->nearest;
        pixel->open.place = place;
    }
    if (s->plane >= 0) {
        layer_gather(&pixel->open, s, &seen, opacity, mask);
        return;
    }
