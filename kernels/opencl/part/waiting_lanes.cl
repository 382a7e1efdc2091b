// What waits at a row of pixels, for CPUs (slot/compose_pixel.cl): a queue of fragments as they come, each of one splat in some
// of the lanes, in an order that is right in every lane. A fragment that is in front of another in one lane and behind it in the
// next is cut in two. What can be composited is so when the queue fills.
//
// A tile's list is walked through in chunks, and of a chunk block after block: so what waits at a block stays in the cache, and
// each block has the chunk's splats in the order of their least depth there. Nearly always that is the order of their fragments
// too, and nothing waits.
//@ compose_types
#define BY_BLOCKS
#define CHUNK 128
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
//@ blocks_parameters
                                   , wide *nearest
//@ blocks_nearest
        vfloat least = s->nearest;
//@@ camera_blocks_nearest
//@@ plane_blocks_nearest
        VSTORE(least, nearest + first);
//@ walk
    for (uint chunk = starts[tile] - base, end = starts[tile + 1] - base; chunk < end && alive; chunk += CHUNK) {
        uint length = min(end - chunk, (uint)CHUNK);
        // of each block its splats and their least depths there, sorted; ties as they are in the list
        int counts[BLOCKS];
        uchar sorted[BLOCKS][CHUNK];
        wide depths[BLOCKS][CHUNK + 1];
        for (int block = 0; block < BLOCKS; block++) counts[block] = 0;
        for (uint which = 0; which < length; which++) {
            FETCH_AHEAD(splats + lists[min(chunk + which + AHEAD_SPLATS, end - 1)]);
            FETCH_AHEAD((global const char *)(splats + lists[min(chunk + which + AHEAD_SPLATS, end - 1)]) + 64);
            const Splat s = splats[lists[chunk + which]];
            wide nearest[BLOCKS];
            for (int block = 0; block < BLOCKS; block++) nearest[block] = s.nearest;
            for (uint touched = alive & touched_blocks(&s, x0, y0, s.log_opacity - constants.log_cut, constants.filter, nearest);
                 touched != 0; touched &= touched - 1) {
                int block = 31 - clz((int)(touched & -touched)), at = counts[block]++;
                for (; at > 0 && depths[block][at - 1] > nearest[block]; at--) {
                    depths[block][at] = depths[block][at - 1];
                    sorted[block][at] = sorted[block][at - 1];
                }
                depths[block][at] = nearest[block];
                sorted[block][at] = (uchar)which;
            }
        }
        const wide after = chunk + length < end ? splats[lists[chunk + length]].nearest : INFINITY;
        for (uint blocks = alive; blocks != 0; blocks &= blocks - 1) {
            int block = 31 - clz((int)(blocks & -blocks));
            depths[block][counts[block]] = INFINITY;
            for (int number = 0; number < counts[block] && (alive >> block & 1u); number++) {
                const uint k = chunk + sorted[block][number];
                // nothing comes before this depth any more; nothing that follows this one
                const wide nearest = fmin(depths[block][number], after), following = fmin(depths[block][number + 1], after);
                const Splat s = splats[lists[k]];
                wide half_r2 = s.log_opacity - constants.log_cut;
                waiting_leave(&pixels[block], nearest, splats, &constants);
//@ walk_end
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

// Composites what waits nearer than `nearest`.
static inline void waiting_composite(Pixel *pixel, wide nearest, global const Splat *splats, const BlendConstants *constants) {
    Waiting *waiting = &pixel->waiting;
    int kept = 0;
    for (int k = 0; k < waiting->count; k++) {
        int at = waiting->order[k];
        vint ready = VMASK(waiting->z[at] < nearest);
        if (VANY(ready)) {
            const Seen seen = waiting_seen(waiting, at, ready, splats);
            composite(pixel, &seen, waiting->opacity[at], ready, constants);
            if (!VANY(VMASK(waiting->z[at] >= nearest))) continue;
            waiting->z[at] = VSELECT(waiting->z[at], (vfloat)NAN, ready);
        }
        waiting->order[k] = waiting->order[kept];
        waiting->order[kept++] = (uchar)at;
    }
    waiting->count = kept;
    // so seldom that few are looked at in vain
    waiting->due = min(kept + max(kept / 2, LEAST_DUE), WAITING);
}

// The same, where that is all that waits.
static inline void waiting_leave(Pixel *pixel, wide nearest, global const Splat *splats, const BlendConstants *constants) {
    Waiting *waiting = &pixel->waiting;
    if (waiting->count == 0 || VANY(VMASK(waiting->furthest >= nearest))) return;
    waiting_composite(pixel, nearest, splats, constants);
    waiting->furthest = -INFINITY;
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

// Whether a fragment need not wait: nothing waits, and nothing that follows is nearer than `nearest`.
static inline bool waiting_not(const Waiting *waiting, wide nearest, vfloat z, vint mask) {
    return waiting->count == 0 && !waiting->bounded && !VANY(mask & VMASK(z >= nearest));
}

// Takes a fragment of the splat at `place` in the list, with nothing to come before `nearest`.
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
    vint lanes = VMASK(own <= waiting->furthest), settled = 0;
    waiting->furthest = fmax(waiting->furthest, own);
    int at = waiting->count;
    for (int k = waiting->count - 1; k >= 0 && VANY(lanes & ~settled); k--) {
        int ahead = waiting->order[k];
        vfloat other = waiting->z[ahead];
        bool first = place < waiting->place[ahead];         // of equal depths
        settled |= first ? VMASK(own > other) : VMASK(own >= other);
        if (VANY(first ? VMASK(own <= other) : VMASK(own < other))) {
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
                        , splats, lists[k], k, following
//@ pass
    do {
//@ pass_end
        alive = 0;
        for (int block = 0; block < BLOCKS; block++)
            if ((on_picture >> block & 1u) && VANY(waiting_end(&pixels[block], splats, &constants))) alive |= 1u << block;
    } while (alive);
