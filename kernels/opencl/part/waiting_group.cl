// What waits at a pixel, for GPUs (slot/compose_pixel.cl): always WAITING fragments, sorted by depth, in registers. One more takes its
// place among them, and the nearest of all leaves.
//@ compose_types
#define NONE 0xFFFFFFFFu            // a place where nothing waits
typedef struct {
    wide z[WAITING], opacity[WAITING];
    uint splat[WAITING];
//@@ sorted
    wide from, until;               // depths between which fragments are taken: at the first from `from_splat` on in the
    uint from_splat, until_splat;   // list, at the second those before `until_splat`
} Waiting;

static inline void waiting_clear(Waiting *waiting) {
    for (int k = 0; k < WAITING; k++) {
        waiting->z[k] = -INFINITY;
        waiting->splat[k] = NONE;
    }
}

static inline void waiting_start(Waiting *waiting) {
    waiting_clear(waiting);
//@@ sorted_start
    waiting->from = -INFINITY;
    waiting->until = INFINITY;
    waiting->from_splat = waiting->until_splat = 0;
}
//@ unfinished
        & VMASK(pixel->waiting.from < INFINITY)
//@ compose_functions
// Whether a splat comes before another in the list.
static inline bool waiting_earlier(global const Splat *splats, uint splat, uint other) {
    wide nearest = splats[splat].nearest, than = splats[other].nearest;
    return nearest < than || (nearest == than && splat < other);
}

static inline void waiting_composite(Pixel *pixel, wide z, wide opacity, uint splat, global const Splat *splats,
                                     const BlendConstants *constants) {
    if (splat == NONE) return;
//@@ sorted_composite
    const Splat s = splats[splat];
    const Crossing nowhere = {1.0f};
    Seen seen = see(&s, nowhere, 1.0f);
    seen.z = z;
    composite(pixel, &seen, opacity, VMASK(true), constants);
}

// One fragment more, with nothing to come before `nearest`: the nearest is composited or, where it may not yet be, the furthest
// dropped.
static inline void waiting_push(Pixel *pixel, wide nearest, wide z, wide opacity, uint splat, global const Splat *splats,
                                const BlendConstants *constants) {
    Waiting *waiting = &pixel->waiting;
    if (fmin(z, waiting->z[0]) <= nearest) {
        bool first = z < waiting->z[0];
        wide first_z = first ? z : waiting->z[0], first_opacity = first ? opacity : waiting->opacity[0];
        uint first_splat = first ? splat : waiting->splat[0];
#pragma unroll
        for (int k = 0; k < WAITING; k++) {
            bool moves = k + 1 < WAITING && waiting->z[min(k + 1, WAITING - 1)] <= z, here = !moves && waiting->z[k] <= z;
            int from = min(k + 1, WAITING - 1);
            waiting->opacity[k] = moves ? waiting->opacity[from] : here ? opacity : waiting->opacity[k];
            waiting->splat[k] = moves ? waiting->splat[from] : here ? splat : waiting->splat[k];
            waiting->z[k] = moves ? waiting->z[from] : here ? z : waiting->z[k];
        }
        waiting_composite(pixel, first_z, first_opacity, first_splat, splats, constants);
        return;
    }
    bool last = waiting->z[WAITING - 1] <= z;
    uint dropped = last ? splat : waiting->splat[WAITING - 1];
//@@ sorted_drop
    waiting->until = last ? z : waiting->z[WAITING - 1];
    waiting->until_splat = dropped;
#pragma unroll
    for (int k = WAITING - 1; k >= 0; k--) {
        bool stays = waiting->z[k] <= z, here = !stays && (k == 0 || waiting->z[max(k - 1, 0)] <= z);
        int from = max(k - 1, 0);
        waiting->opacity[k] = stays ? waiting->opacity[k] : here ? opacity : waiting->opacity[from];
        waiting->splat[k] = stays ? waiting->splat[k] : here ? splat : waiting->splat[from];
        waiting->z[k] = stays ? waiting->z[k] : here ? z : waiting->z[from];
    }
}

// All fragments go the same way.
static inline bool waiting_not(const Waiting *waiting, wide nearest, wide z, int mask) { return false; }

// Takes a fragment of a splat of which none is nearer than `nearest`; place: the splat, which says where in the list it stands.
static inline void waiting_take(Pixel *pixel, wide nearest, wide z, wide opacity, uint splat, uint place, int mask,
                                global const Splat *splats, const BlendConstants *constants) {
    Waiting *waiting = &pixel->waiting;
    if (z > waiting->until || (z == waiting->until && !waiting_earlier(splats, place, waiting->until_splat))) return;
    if (z < waiting->from || (z == waiting->from && waiting_earlier(splats, place, waiting->from_splat))) return;
//@@ sorted_take
    waiting_push(pixel, nearest, z, opacity, splat, splats, constants);
}

//@@ plane_functions
// After the last splat of the list: composites what waits. Returns whether the list is to be gone through again.
static inline int waiting_end(Pixel *pixel, global const Splat *splats, const BlendConstants *constants) {
//@@ plane_end
    Waiting *waiting = &pixel->waiting;
    if (waiting->splat[WAITING - 1] != NONE) {
#pragma unroll
        for (int k = 0; k < WAITING; k++)
            waiting_composite(pixel, waiting->z[k], waiting->opacity[k], waiting->splat[k], splats, constants);
        waiting_clear(waiting);
    }
    waiting->from = waiting->until;
    waiting->from_splat = waiting->until_splat;
    waiting->until = INFINITY;
    return pixel_unfinished(pixel, constants);
}
//@ blend_arguments
                                , splats, lists[batch + which], lists[batch + which]
//@ pass
    local int again;
    do {
//@ pass_end
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item == 0) again = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int row = 0; row < ROWS; row++)
            if (px < width && py + row < height && waiting_end(&pixels[row], splats, &constants)) again = 1;
        barrier(CLK_LOCAL_MEM_FENCE);
        // uniform: every work-item reads the same vote
    } while (again);
