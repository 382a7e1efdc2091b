// Compositing with coplanar groups: splats of one group have no order, and form one layer per pixel. The layer is the limit of
// cutting the splats into thin sheets and shuffling them, which is independent of order: optical depths
// tau = -ln(1 - opacity) add up, and colour, outputs and depth are means weighted by tau. A marker then does not change when its
// splats are reordered, or when camera rotation reorders the depths of their centres.
//
// Splats of a group are adjacent in the lists, at the nearest depth of the group (plane_keys). When another splat follows, the
// layer enters the k-buffer as one fragment (slot/compose_pixel.cl).
//@ project
    record.group = coplanar_groups[i];
//@ functions
#define COPLANAR_RADIUS REAL(64.0)       // in standard deviations; for boxes in half sides
//@ coplanar_depth_reach
    // depth range of the plane out to a fixed radius, beyond the reach of every alpha cut-off and low-pass: then the order of
    // layers does not depend on the cut-off, nor on boxes much smaller than a pixel
    if (coplanar_groups[i] >= 0) depth_reach = reach * (BOX_HERE ? COPLANAR_RADIUS : COPLANAR_RADIUS / radius);
//@ coplanar_nearest
    if (coplanar_groups[i] >= 0) record.nearest = (wide)plane_keys[coplanar_groups[i] * get_global_size(1) + number];
//@ coplanar_blocks_nearest
        if (s->group >= 0) min_depth = s->nearest;      // adjacent in each block
//@ coplanar_lookahead
                if (s.group >= 0) {                 // its layer may be nearer than this fragment, and at other pixels
                    z = s.nearest;
                    mask = -1;
                }
//@ chunk_end
        // in one chunk, unless they fill several: otherwise the next chunk starts with the group's first splat
        const int group = splats[lists[places[length - 1]]].group;
        if (group >= 0 && ((read < end && splats[lists[read]].group == group)
                           || (deferred_count > 0 && splats[lists[(uint)deferred[deferred_count - 1]]].group == group))) {
            uint before = length;
            while (before > 0 && splats[lists[places[before - 1]]].group == group) before--;
            if (before > 0 && reads) read -= length - before;
            if (before > 0 && !reads) deferred_count += length - before;
            if (before > 0) length = before;
        }
//@ coplanar_disc_depth
        if (s->group >= 0) on_plane = -1;           // also in the low-pass disc
//@ coplanar_attribute_depth
    attributes.z = fmax(attributes.z, (vfloat)s->nearest);
//@ compose_types
#define LAYER_FLAG 0x80000000u       // marks an index as that of a layer, not of a splat

typedef struct {
    int group;                  // -1: no layer
    wide nearest;               // sort key of its splats
    uint place;                 // position of its first splat in the list
    vint lanes;                 // where it has fragments
    vfloat opacity;             // 1 - the product of transmittances, accumulated directly to stay exact for faint layers
    vfloat optical_depth;       // sum over its fragments
    Attributes mean;                  // of its fragments, weighted by optical depth
//@@ layer_fields
} Layer;

static inline Layer no_layer(void) {
    Layer layer = {-1};         // all other fields 0
    return layer;
}
//@ state
    Layer open_layer;                 // layer that still accumulates fragments
//@ start
    pixel->open_layer = no_layer();
//@ k_buffer_queue_fields
    Attributes layers[K_BUFFER_SIZE + 1];   // splat index LAYER_FLAG + k refers to layer k
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
    // clamped to the optical depth at which float32 transmittance is 0
    vfloat tau = -LOG(fmax(1.0f - opacity, (vfloat)0x1p-24f));
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
// Completes the open layer and inserts it into the k-buffer, nearer by slightly more than the rounding of depths, so that it
// is in front of ungrouped splats in the same plane.
static inline void layer_close(Pixel *pixel, vfloat nearest, global const Splat *splats, const BlendConstants *constants) {
    const Layer *open_layer = &pixel->open_layer;
    if (open_layer->group < 0) return;
    vfloat z = fmax(FMA(fabs(open_layer->mean.z), (vfloat)-0x1p-16f, open_layer->mean.z), (vfloat)open_layer->nearest);
    k_buffer_insert(pixel, nearest, z, open_layer->opacity, &open_layer->mean, LAYER_FLAG, open_layer->place, open_layer->lanes,
                    splats, constants);
    pixel->open_layer = no_layer();
}

//@ coplanar_finish
    layer_close(pixel, INFINITY, splats, constants);
//@ compose_coplanar_group
    if (s->group != pixel->open_layer.group) {
        layer_close(pixel, this_nearest, splats, constants);
        pixel->open_layer.group = s->group;
        pixel->open_layer.nearest = s->nearest;
        pixel->open_layer.place = place;
    }
    if (s->group >= 0) {
        layer_add(&pixel->open_layer, s, &attributes, opacity, mask);
        return;
    }
