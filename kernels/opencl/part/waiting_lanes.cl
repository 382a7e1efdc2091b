// What waits at a row of pixels, for CPUs (slot/compose_pixel.cl): a queue of fragments as they come, each of one splat in some
// of the lanes, in an order that is right in every lane. A fragment that is in front of another in one lane and behind it in the
// next is cut in two. What can be composited is so when the queue fills.
//@ compose_types
#define LEAST_DUE min(16, WAITING)
typedef struct {
    vfloat z[WAITING + 1];      // NaN in lanes where it does not wait
    vfloat opacity[WAITING + 1];
    uint splat[WAITING + 1], place[WAITING + 1];
//@@ queue
    uchar order[WAITING + 1];   // places in the above: `count` that are taken, the nearest first, then those that are free
    int count, due;             // at `due` what can be composited is so
    vfloat furthest;            // of all that have waited
    int bounded;                // whether not all fragments are taken, but those between
    vfloat from, until;         // these depths: at the first from `from_place` in the list on, at the second those before
    vint from_place, until_place;
} Waiting;

static inline void waiting_start(Waiting *waiting) {
    for (int k = 0; k <= WAITING; k++) waiting->order[k] = (uchar)k;
    waiting->count = waiting->bounded = 0;
    waiting->due = LEAST_DUE;
    waiting->furthest = waiting->from = -INFINITY;
    waiting->until = INFINITY;
    waiting->from_place = waiting->until_place = 0;
}
//@ compose_functions
static inline Seen waiting_seen(const Waiting *waiting, int at, vint mask, global const Splat *splats) {
//@@ queue_seen
    const Splat s = splats[waiting->splat[at]];
    const Crossing nowhere = {(vfloat)1.0f};
    Seen seen = see(&s, nowhere, (vfloat)1.0f);
    seen.z = VSELECT((vfloat)0.0f, waiting->z[at], mask);
    return seen;
}

// Composites what waits no further than `nearest`.
static inline void waiting_composite(Pixel *pixel, wide nearest, global const Splat *splats, const BlendConstants *constants) {
    Waiting *waiting = &pixel->waiting;
    int kept = 0;
    for (int k = 0; k < waiting->count; k++) {
        int at = waiting->order[k];
        vint ready = VMASK(waiting->z[at] <= nearest);
        if (VANY(ready)) {
            const Seen seen = waiting_seen(waiting, at, ready, splats);
            composite(pixel, &seen, waiting->opacity[at], ready, constants);
            if (!VANY(VMASK(waiting->z[at] > nearest))) continue;
            waiting->z[at] = VSELECT(waiting->z[at], (vfloat)NAN, ready);
        }
        waiting->order[k] = waiting->order[kept];
        waiting->order[kept++] = (uchar)at;
    }
    waiting->count = kept;
    // so seldom that few are looked at in vain
    waiting->due = min(kept + max(kept / 2, LEAST_DUE), WAITING);
}

// Puts a fragment before the `before`-th; the last that waits is dropped if there are too many.
static inline void waiting_put(Pixel *pixel, int before, vfloat z, vfloat opacity, uint splat, uint place) {
    Waiting *waiting = &pixel->waiting;
    int at = waiting->order[waiting->count];
    waiting->z[at] = z;
    waiting->opacity[at] = opacity;
    waiting->splat[at] = splat;
    waiting->place[at] = place;
//@@ queue_put
    for (int k = waiting->count; k > before; k--) waiting->order[k] = waiting->order[k - 1];
    waiting->order[before] = (uchar)at;
    if (++waiting->count <= WAITING) return;
    int last = waiting->order[--waiting->count];
    vint dropped = VMASK(waiting->z[last] == waiting->z[last]);
    waiting->until = VSELECT(waiting->until, waiting->z[last], dropped);
    waiting->until_place = VSELECT(waiting->until_place, (vint)(int)waiting->place[last], dropped);
    waiting->bounded = 1;
}

// Whether a fragment need not wait: nothing waits, and nothing that follows can be nearer.
static inline bool waiting_not(const Waiting *waiting, wide nearest, vfloat z, vint mask) {
    return waiting->count == 0 && !waiting->bounded && !VANY(mask & VMASK(z > nearest));
}

// Takes a fragment of the splat at `place` in the list, of which none is nearer than `nearest`.
static inline void waiting_take(Pixel *pixel, wide nearest, vfloat z, vfloat opacity, uint splat, uint place, vint mask,
                                global const Splat *splats, const BlendConstants *constants) {
    Waiting *waiting = &pixel->waiting;
    if (waiting->bounded) {
        vint here = (vint)(int)place;
        mask &= VMASK(z < waiting->until) | (VMASK(z == waiting->until) & VMASK(here < waiting->until_place));
        mask &= VMASK(z > waiting->from) | (VMASK(z == waiting->from) & VMASK(here >= waiting->from_place));
        if (!VANY(mask)) return;
    }
    vfloat own = VSELECT((vfloat)NAN, z, mask);
    // lanes in which it may lie before something; those in which it cannot be put further in front
    vint lanes = VMASK(own < waiting->furthest), settled = 0;
    waiting->furthest = fmax(waiting->furthest, own);
    int at = waiting->count;
    for (int k = waiting->count - 1; k >= 0 && VANY(lanes & ~settled); k--) {
        vfloat other = waiting->z[waiting->order[k]];
        settled |= VMASK(own >= other);
        if (VANY(VMASK(own < other))) {
            if (VANY(settled)) {
                waiting_put(pixel, at, VSELECT((vfloat)NAN, own, settled), opacity, splat, place);
                own = VSELECT(own, (vfloat)NAN, settled);
                lanes &= ~settled;
                settled = 0;
            }
            at = k;
        }
    }
    waiting_put(pixel, at, own, opacity, splat, place);
    if (waiting->count >= waiting->due) waiting_composite(pixel, nearest, splats, constants);
}

//@@ plane_functions
// After the last splat of the list: composites what waits. Returns where the list is to be gone through again.
static inline vint waiting_end(Pixel *pixel, global const Splat *splats, const BlendConstants *constants) {
//@@ plane_end
    waiting_composite(pixel, INFINITY, splats, constants);
    pixel->waiting.from = pixel->waiting.until;
    pixel->waiting.from_place = pixel->waiting.until_place;
    pixel->waiting.until = INFINITY;
    return VMASK(pixel->waiting.from < INFINITY) & pixel_unfinished(pixel, constants);
}
//@ blend_arguments
                        , splats, lists[k], k
//@ pass
    do {
//@ pass_end
        alive = 0;
        for (int block = 0; block < BLOCKS; block++)
            if ((on_picture >> block & 1u) && VANY(waiting_end(&pixels[block], splats, &constants))) alive |= 1u << block;
    } while (alive);
