// Compositing with coplanar groups: splats of one group have no order, and form one layer per pixel. The layer is the limit of
// cutting the splats into thin sheets and shuffling them, which is independent of order: optical depths
// tau = -ln(1 - alpha) add up, and colour, outputs and depth are means weighted by tau. A marker then does not change when its
// splats are reordered, or when camera rotation reorders the depths of their centres.
//
// Splats of groups are the first ones of a tile's list, group after group. A pass through the list finds at each pixel the nearest layer
// (`next`) behind that of the previous pass (`from`), composites the fragments of other splats between the two, in centre order or by
// fragment depth, then the layer. A pass that finds a layer is followed by another pass.
// Tiles without groups have a single pass without layers.
//@ project
    record.group = coplanar_groups[i];
//@ functions
#ifndef BOX_HERE
#define BOX_HERE false
#endif
#define COPLANAR_RADIUS REAL(64.0)       // in standard deviations; for boxes in half sides
//@ coplanar_depth_reach
    // depth range of the plane within a fixed radius, which is larger than that of any alpha cut-off and low-pass filter, also
    // for boxes much smaller than a pixel: the order of layers then does not depend on the cut-off
    if (coplanar_groups[i] >= 0) depth_reach = reach * (BOX_HERE ? COPLANAR_RADIUS : COPLANAR_RADIUS / radius);
//@ coplanar_nearest
    if (coplanar_groups[i] >= 0) record.nearest = -0x1p126f;
//@ coplanar_key
    if (coplanar_groups[i] >= 0) key = as_float(0xFF7FFFFFu - (uint)coplanar_groups[i]);     // below all depths
//@ blocks_parameters
                                   , const float *until
//@ blocks_arguments
                , until
//@ blocks_occluded
    if (until)
        for (int first = 0; first < BLOCKS; first += LANES)
            touched &= ~(VBITS(VMASK((vfloat)(s->z_center - s->z_reach) >= VLOAD(until + first))) << first);
//@ coplanar_blocks_nearest
        if (s->group >= 0) min_depth = -0x1p126f;
        if (until) outside |= VMASK(min_depth >= VLOAD(until + first));
//@ coplanar_lowpass_depth
        if (s->group >= 0) on_plane = -1;           // also in the low-pass disc
//@ blend_types
#define IN_LAYER(s) ((s)->group >= 0)
typedef struct {
    int group;                  // -1: no layer
    vfloat alpha;             // 1 - the product of transmittances, accumulated directly to stay exact for faint layers
    vfloat optical_depth;       // sum over its fragments
    Attributes mean;                  // of its fragments, weighted by optical depth
//@@ layer_fields
} Layer;

typedef struct {
    Layer current;                 // layer that still accumulates fragments
    AttributeFields next;       // nearest layer of this pass; its depth is infinite if there is none
    vfloat next_z, next_alpha;
    vint next_group;
    vfloat from;                // depth and group of the layer of the previous pass; infinite if there was none
    vint from_group;
} Layers;

static inline Layer no_layer(void) {
    Layer layer = {-1};         // all other fields 0
    return layer;
}
//@ state
    Layers *layers;             // 0 in a tile without groups
//@ start
    pixel->layers = 0;
//@ lanes_start
    Layers layers[BLOCKS];
    if (starts[tile] < starts[tile + 1] && splats[lists[starts[tile] - base]].group >= 0)
        for (int block = 0; block < BLOCKS; block++) layers_start(&pixels[block], layers + block);
    float layer_depths[BLOCKS + LANES] __attribute__((aligned(64)));   // of each block: behind them no fragment belongs to this pass
    const float *until = 0;                                 // these depths, once all layers are complete
//@ segment_of_layers
        // splats of groups have segments of their own
        if (pixels[0].layers) {
            if (splats[lists[segment]].group >= 0) until = 0;
            else if (!until) until = blocks_until(pixels, &constants, layer_depths);
            while (!until && splats[lists[segment + length - 1]].group < 0) length--;
        }
//@ segment_of_layers_sorted
        if (pixels[0].layers) {
            if (splats[lists[positions[0]]].group >= 0) until = 0;
            else if (!until) until = blocks_until(pixels, &constants, layer_depths);
            if (!until) {
                for (; splats[lists[positions[length - 1]]].group < 0; length--) read--;
                rest_nearest = INFINITY;        // not deferred
            }
        }
//@ group_start
    local uint layer_depth, any_layer;
    Layers layers[ROWS];
    blend_real until = INFINITY;      // behind it no fragment belongs to this pass; infinite until all layers are complete
    bool complete = false;
//@ staged
        // splats of groups are staged alone; all work-items branch alike
        if (staged[0].splat.group >= 0) {
            if (!pixels[0].layers)
                for (int row = 0; row < ROWS; row++) layers_start(&pixels[row], layers + row);
            while (staged[length - 1].splat.group < 0) length--;
            until = INFINITY;
            complete = false;
        } else if (pixels[0].layers && !complete) {
            if (item == 0) layer_depth = any_layer = 0;
            barrier(CLK_LOCAL_MEM_FENCE);
            for (int row = 0; row < ROWS; row++)
                if (px < width && py + row < height) {
                    atomic_max(&layer_depth, sortable(convert_float_rtp(layers_until(&pixels[row], &constants))));
                    if (pixels[row].layers->next_z < INFINITY) any_layer = 1;
                }
            barrier(CLK_LOCAL_MEM_FENCE);
            until = key_depth(layer_depth);
            complete = true;
            // conservative bounds list a group in tiles without its fragments
            if (!any_layer && from == -INFINITY)
                for (int row = 0; row < ROWS; row++) pixels[row].layers = 0;
        }
//@ cells_parameters
                                 , blend_real until
//@ cells_arguments
                          , until
//@ cells_occluded
    if (until < INFINITY && tile_nearest(*s, left, top) >= until) return;
//@ termination_known
            && !pixels[0].layers
//@ pass_unfinished
        & VMASK(!pixel->layers || pixel->layers->from < INFINITY)
//@ blend_functions
static inline void layers_start(Pixel *pixel, Layers *layers) {
    const Layers none = {{-1}};     // all other fields 0
    *layers = none;
    pixel->layers = layers;
    layers->next_z = INFINITY;
    layers->from = -INFINITY;
    layers->from_group = -1;
}

// Adds a fragment where `mask` is set.
static inline void layer_add(Layer *layer, const Splat *s, const Attributes *attributes, vfloat alpha, vint mask) {
    alpha = VSELECT((vfloat)0.0f, alpha, mask);
    // clamped to the optical depth at which float32 transmittance is 0; below 1e-3, where 1 - alpha rounds, by its series to 3e-7
    vfloat tau = VSELECT(-LOG(fmax(1.0f - alpha, (vfloat)0x1p-24f)), FMA(0.5f * alpha, alpha, alpha), VMASK(alpha < 1e-3f));
//@@ footprint_tau
    layer->alpha = FMA(alpha, 1.0f - layer->alpha, layer->alpha);
    layer->optical_depth += tau;
//@@ footprint_layer
    vfloat share = VSELECT((vfloat)0.0f, tau / layer->optical_depth, VMASK(tau > 0.0f));
    layer->mean.r = FMA(share, attributes->r - layer->mean.r, layer->mean.r);
    layer->mean.g = FMA(share, attributes->g - layer->mean.g, layer->mean.g);
    layer->mean.b = FMA(share, attributes->b - layer->mean.b, layer->mean.b);
//@@ layer_accumulate
}

// Completes the current layer: keeps it where it is the nearest one of this pass. It is nearer by slightly more than the rounding of
// depths, so that it is in front of ungrouped splats in the same plane.
static inline void layer_close(Layers *layers) {
    if (layers->current.group < 0) return;
    const AttributeFields own = {layers->current.mean};
    const vfloat z = FMA(fabs(own.attributes.z), (vfloat)-0x1p-16f, own.attributes.z);
    vint nearest = VMASK(layers->current.optical_depth > 0.0f) & VMASK(z < layers->next_z);
    nearest &= VMASK(z > layers->from) | (VMASK(z == layers->from) & VMASK(layers->current.group > layers->from_group));
    layers->next_z = VSELECT(layers->next_z, z, nearest);
    layers->next_alpha = VSELECT(layers->next_alpha, layers->current.alpha, nearest);
    layers->next_group = VSELECT(layers->next_group, (vint)layers->current.group, nearest);
#if LANES == 1
    if (nearest) layers->next = own;
#else
    for (uint field = 0; field < sizeof(Attributes) / sizeof(vfloat); field++)
        layers->next.fields[field] = VSELECT(layers->next.fields[field], own.fields[field], nearest);
#endif
    layers->current = no_layer();
}

// Completes the layers: the depth behind which no fragment belongs to this pass.
static inline vfloat layers_until(Pixel *pixel, const BlendConstants *constants) {
    layer_close(pixel->layers);
    const vint open = pixel_transmits(pixel, constants) & VMASK(pixel->layers->from < INFINITY);
    return VSELECT((vfloat)-INFINITY, pixel->layers->next_z, open);
}
//@ blocks_functions
// The largest one of each block.
static inline const float *blocks_until(Pixel *pixels, const BlendConstants *constants, float *depths) {
    for (int block = 0; block < BLOCKS; block++) {
        const vfloat lanes = layers_until(&pixels[block], constants);
        depths[block] = -INFINITY;
        for (int lane = 0; lane < LANES; lane++) depths[block] = fmax(depths[block], ((const float *)&lanes)[lane]);
    }
    return depths;
}
//@ layers
    if (pixel->layers) {
        Layers *layers = pixel->layers;
        if (s->group != layers->current.group) {
            layer_close(layers);
            layers->current.group = s->group;
        }
        if (s->group >= 0) {
            layer_add(&layers->current, s, &attributes, alpha, mask);
            return;
        }
        mask &= VMASK(attributes.z >= layers->from) & VMASK(attributes.z < layers->next_z);
        if (!VANY(mask)) return;
    }
//@ pass_from
    if (pixel->layers) from = fmax(from, pixel->layers->from);
//@ layers_finish
    if (pixel->layers) {
        Layers *layers = pixel->layers;
        layer_close(layers);
        const vint passed = ~repeats, ready = passed & VMASK(layers->next_z < INFINITY);
        composite(pixel, &layers->next.attributes, layers->next_alpha, ready, constants);
        layers->from = VSELECT(layers->from, layers->next_z, passed);
        layers->from_group = VSELECT(layers->from_group, layers->next_group, passed);
        layers->next_z = INFINITY;
        repeats |= ready;
//@@ layer_passed
    }
