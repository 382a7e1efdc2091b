// What waits at a block of pixels, for CPUs (slot/compose_pixel.cl). At each pixel the furthest is `held`: one more takes its
// place or leaves again, and what leaves can nearly always be composited; else it goes to a queue, sorted at each pixel. So all
// fragments go the same way, and branches can be foreseen. An entry has a fragment at each pixel, of any splat; what it shows is
// kept by value.
//
// A tile's list is walked through in chunks, and of a chunk block after block: so what waits at a block stays in the cache, and
// each block has the chunk's splats in the order of their least depth there, which is mostly that of their fragments.
//@ compose_types
#define CHUNK 128
#define NOTHING INFINITY            // the depth where nothing waits in the queue
#define NONE (-INFINITY)            // and where nothing is held
typedef union {
    Seen seen;
    vfloat fields[sizeof(Seen) / sizeof(vfloat)];
} Shown;
typedef struct {
    wide depth;                     // the least in a block
    uint which;                     // splat of a chunk
} Listed;
typedef struct {                    // a fragment in each lane, of any splat
    vfloat z, opacity;
    vint place;                     // of its splat in the list
    Shown shown;
} Entry;
typedef struct {
    Entry held;
    Entry entries[WAITING];         // the queue, of WAITING - 1
    uchar order[WAITING];           // places in the above: `count` that are taken, the nearest first, then those that are free
    int count;
    int bounded;                    // whether not all fragments are taken, but those between
    vfloat from, until;             // these depths: at the first from `from_place` in the list on, at the second those before
    vint from_place, until_place;
} Waiting;

static inline void waiting_start(Waiting *waiting) {
    for (int k = 0; k < WAITING; k++) waiting->order[k] = (uchar)k;
    const Entry none = {(vfloat)NONE};      // and the rest 0, which shows nothing
    waiting->held = none;
    waiting->count = waiting->bounded = 0;
    waiting->from = -INFINITY;
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
        Listed sorted[BLOCKS][CHUNK + 2];       // between what is before and behind all
        for (int block = 0; block < BLOCKS; block++) {
            counts[block] = 0;
            sorted[block][0].depth = -INFINITY;
        }
        for (uint which = 0; which < length; which++) {
            FETCH_AHEAD(splats + lists[min(chunk + which + AHEAD_SPLATS, end - 1)]);
            FETCH_AHEAD((global const char *)(splats + lists[min(chunk + which + AHEAD_SPLATS, end - 1)]) + 64);
            const Splat s = splats[lists[chunk + which]];
            wide nearest[BLOCKS];
            for (int block = 0; block < BLOCKS; block++) nearest[block] = s.nearest;
            for (uint touched = alive & touched_blocks(&s, x0, y0, s.log_opacity - constants.log_cut, constants.filter, nearest);
                 touched != 0; touched &= touched - 1) {
                int block = 31 - clz((int)(touched & -touched));
                const Listed own = {nearest[block], which};
                Listed *at = &sorted[block][++counts[block]];
                for (; at[-1].depth > own.depth; at--) *at = at[-1];
                *at = own;
            }
        }
        const wide after = chunk + length < end ? splats[lists[chunk + length]].nearest : INFINITY;
        for (uint blocks = alive; blocks != 0; blocks &= blocks - 1) {
            int block = 31 - clz((int)(blocks & -blocks));
            const Listed *next = &sorted[block][1], *last = next + counts[block];
            sorted[block][counts[block] + 1].depth = INFINITY;
            for (; next < last && (alive >> block & 1u); next++) {
                const uint k = chunk + next->which;
                const wide following = fmin(next[1].depth, after);     // nothing that follows comes before it
                const Splat s = splats[lists[k]];
                wide half_r2 = s.log_opacity - constants.log_cut;
//@ walk_end
            }
        }
    }
//@ compose_functions
// Composites what waits nearer than `nearest`, but what shares an entry with something further.
static inline void waiting_leave(Pixel *pixel, wide nearest, const BlendConstants *constants) {
    Waiting *waiting = &pixel->waiting;
    int left = 0;
    for (; left < waiting->count; left++) {
        const Entry *entry = &waiting->entries[waiting->order[left]];
        vint waits = VMASK(entry->z < NOTHING), ready = waits & VMASK(entry->z < nearest);
        if (VANY(waits & ~ready)) break;
        composite(pixel, &entry->shown.seen, entry->opacity, ready, constants);
    }
    if (left == 0) return;
    uchar free[WAITING];
    for (int k = 0; k < left; k++) free[k] = waiting->order[k];
    waiting->count -= left;
    for (int k = 0; k < waiting->count; k++) waiting->order[k] = waiting->order[k + left];
    for (int k = 0; k < left; k++) waiting->order[waiting->count + k] = free[k];
}

static inline void waiting_exchange(vfloat *one, vfloat *other, vint mask) {
    vfloat kept = *one;
    *one = VSELECT(kept, *other, mask);
    *other = VSELECT(*other, kept, mask);
}

static inline void entry_exchange(Entry *one, Entry *other, vint mask) {
    waiting_exchange(&one->z, &other->z, mask);
    waiting_exchange(&one->opacity, &other->opacity, mask);
    vint place = one->place;
    one->place = VSELECT(place, other->place, mask);
    other->place = VSELECT(other->place, place, mask);
    for (uint field = 0; field < sizeof(Seen) / sizeof(vfloat); field++)
        waiting_exchange(&one->shown.fields[field], &other->shown.fields[field], mask);
}

// Where one comes before the other: of equal depths the first in the list.
static inline vint entry_before(const Entry *one, const Entry *other) {
    return VMASK(one->z < other->z) | (VMASK(one->z == other->z) & VMASK(one->place < other->place));
}

// Puts what leaves `held` into the queue. Where that is full, what is held is dropped for it: the furthest of all.
static inline void waiting_queue(Waiting *waiting, Entry *own) {
    own->z = VSELECT(own->z, (vfloat)NOTHING, VMASK(own->z == NONE));
    for (int k = 0; k < waiting->count; k++) {
        Entry *other = &waiting->entries[waiting->order[k]];
        vint before = entry_before(own, other);
        if (VANY(before)) entry_exchange(own, other, before);
        if (!VANY(VMASK(own->z < NOTHING))) return;
    }
    if (waiting->count < WAITING - 1) {
        waiting->entries[waiting->order[waiting->count++]] = *own;
        return;
    }
    vint dropped = VMASK(own->z < NOTHING);
    waiting->until = VSELECT(waiting->until, waiting->held.z, dropped);
    waiting->until_place = VSELECT(waiting->until_place, waiting->held.place, dropped);
    waiting->bounded = 1;
    entry_exchange(own, &waiting->held, dropped);
}

// Takes a fragment of the splat at `place` in the list, with nothing to come before `nearest`.
static inline void waiting_take(Pixel *pixel, wide nearest, vfloat z, vfloat opacity, const Seen *seen, uint splat, uint place,
                                vint mask, global const Splat *splats, const BlendConstants *constants) {
    Waiting *waiting = &pixel->waiting;
    vint here = (vint)(int)place;
    if (waiting->bounded) {
        mask &= VMASK(z < waiting->until) | (VMASK(z == waiting->until) & VMASK(here < waiting->until_place));
        mask &= VMASK(z > waiting->from) | (VMASK(z == waiting->from) & VMASK(here >= waiting->from_place));
        if (!VANY(mask)) return;
    }
    Entry own = {VSELECT((vfloat)NONE, z, mask), opacity, here};
    own.shown.seen = *seen;
    entry_exchange(&own, &waiting->held, mask & ~entry_before(&own, &waiting->held));
    vint leaves = VMASK(own.z > NONE);
    if (waiting->count == 0 && !VANY(VMASK(own.z >= nearest)))
        composite(pixel, &own.shown.seen, own.opacity, leaves, constants);
    else {
        if (VANY(leaves)) waiting_queue(waiting, &own);
        waiting_leave(pixel, nearest, constants);
    }
}

//@@ plane_functions
// After the last splat of the list: composites what waits. Returns where the list is to be gone through again.
static inline vint waiting_end(Pixel *pixel, global const Splat *splats, const BlendConstants *constants) {
//@@ plane_end
    waiting_leave(pixel, INFINITY, constants);
    Entry *held = &pixel->waiting.held;
    composite(pixel, &held->shown.seen, held->opacity, VMASK(held->z > NONE), constants);
    held->z = NONE;
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
