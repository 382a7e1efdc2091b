// What waits at a pixel, for GPUs (slot/compose_pixel.cl). The furthest are in registers, IN_REGISTERS of them, always full and
// sorted by depth: one more takes its place among them, and the nearest of all leaves. Nearly always it can be composited; else it goes
// to a queue in memory, which is short and mostly empty.
//@ compose_types
#define NONE 0xFFFFFFFFu            // a place where nothing waits
#define IN_REGISTERS (WAITING < 3 ? WAITING : 3)
#define QUEUED (WAITING - IN_REGISTERS)
typedef struct {                    // apart from what is to stay in registers: an index that is not constant puts all of a struct in memory
    wide z[QUEUED + 1], opacity[QUEUED + 1];    // a ring, sorted by depth
    uint splat[QUEUED + 1];
//@@ queued
} Queue;
typedef struct {
    wide z[IN_REGISTERS], opacity[IN_REGISTERS];
    uint splat[IN_REGISTERS];
    Queue *queue;
    uint head, count;               // of the queue
    bool bounded;                   // whether not all fragments are taken, but those between
//@@ sorted
    wide from, until;               // these depths: at the first from `from_splat` on in the list, at the second those before
    uint from_splat, until_splat;   // `until_splat`
} Waiting;

static inline void waiting_clear(Waiting *waiting) {
    for (int k = 0; k < IN_REGISTERS; k++) {
        waiting->z[k] = -INFINITY;
        waiting->splat[k] = NONE;
    }
}

static inline void waiting_start(Waiting *waiting) {
    waiting_clear(waiting);
    waiting->head = waiting->count = 0;
//@@ sorted_start
    waiting->bounded = false;
    waiting->from = -INFINITY;
    waiting->until = INFINITY;
    waiting->from_splat = waiting->until_splat = 0;
}
//@ group_start
    Queue queues[ROWS];
    for (int row = 0; row < ROWS; row++) pixels[row].waiting.queue = &queues[row];
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
//@@ sorted_composite
    const Splat s = splats[splat];
    const Crossing nowhere = {1.0f};
    Seen seen = see(&s, nowhere, 1.0f);
    seen.z = z;
    composite(pixel, &seen, opacity, VMASK(true), constants);
}

// Where the k-th of the queue lies.
static inline uint waiting_place(const Waiting *waiting, uint k) {
    uint at = waiting->head + k;
    return at < QUEUED ? at : at - QUEUED;
}

// Composites what of the queue lies no further than `nearest`.
static inline void waiting_leave(Pixel *pixel, wide nearest, global const Splat *splats, const BlendConstants *constants) {
    Waiting *waiting = &pixel->waiting;
    Queue *queue = waiting->queue;
    while (waiting->count > 0 && queue->z[waiting->head] <= nearest) {
        uint at = waiting->head;
        waiting->head = waiting_place(waiting, 1);
        waiting->count--;
        waiting_composite(pixel, queue->z[at], queue->opacity[at], queue->splat[at], splats, constants);
    }
}

// A fragment no further than those in registers, to the queue. Where that is full the furthest of all is dropped.
static inline void waiting_queue(Pixel *pixel, wide z, wide opacity, uint splat) {
    Waiting *waiting = &pixel->waiting;
    Queue *queue = waiting->queue;
    if (waiting->count == QUEUED) {
        uint dropped = waiting->splat[IN_REGISTERS - 1];
//@@ sorted_drop
        waiting->until = waiting->z[IN_REGISTERS - 1];
        waiting->until_splat = dropped;
        waiting->bounded = true;
#pragma unroll
        for (int k = IN_REGISTERS - 1; k > 0; k--) {
            waiting->z[k] = waiting->z[k - 1];
            waiting->opacity[k] = waiting->opacity[k - 1];
            waiting->splat[k] = waiting->splat[k - 1];
        }
        uint last = waiting_place(waiting, waiting->count - 1);
        bool further = QUEUED > 0 && queue->z[last] > z;
        waiting->z[0] = further ? queue->z[last] : z;
        waiting->opacity[0] = further ? queue->opacity[last] : opacity;
        waiting->splat[0] = further ? queue->splat[last] : splat;
        if (!further) return;
        waiting->count--;
    }
    uint k = waiting->count++, at = waiting_place(waiting, k);
    for (; k > 0; k--) {
        uint before = waiting_place(waiting, k - 1);
        if (queue->z[before] <= z) break;
        queue->z[at] = queue->z[before];
        queue->opacity[at] = queue->opacity[before];
        queue->splat[at] = queue->splat[before];
        at = before;
    }
    queue->z[at] = z;
    queue->opacity[at] = opacity;
    queue->splat[at] = splat;
}

// One fragment more, with nothing to come before `nearest`.
static inline void waiting_push(Pixel *pixel, wide nearest, wide z, wide opacity, uint splat, global const Splat *splats,
                                const BlendConstants *constants) {
    Waiting *waiting = &pixel->waiting;
    // a layer that ends may be nearer than what follows it in the list, and than what waits
    waiting_leave(pixel, fmin(nearest, z), splats, constants);
    bool first = z < waiting->z[0];
    wide first_z = first ? z : waiting->z[0], first_opacity = first ? opacity : waiting->opacity[0];
    uint first_splat = first ? splat : waiting->splat[0];
#pragma unroll
    for (int k = 0; k < IN_REGISTERS; k++) {
        int from = min(k + 1, IN_REGISTERS - 1);
        bool moves = k + 1 < IN_REGISTERS && waiting->z[from] <= z, here = waiting->z[k] <= z;
        waiting->opacity[k] = moves ? waiting->opacity[from] : here ? opacity : waiting->opacity[k];
        waiting->splat[k] = moves ? waiting->splat[from] : here ? splat : waiting->splat[k];
        waiting->z[k] = moves ? waiting->z[from] : here ? z : waiting->z[k];
    }
    if (first_splat == NONE) return;
    if (waiting->count == 0 && first_z <= nearest)
        waiting_composite(pixel, first_z, first_opacity, first_splat, splats, constants);
    else
        waiting_queue(pixel, first_z, first_opacity, first_splat);
}

// Takes a fragment of a splat of which none is nearer than `nearest`; place: the splat, which says where in the list it stands.
static inline void waiting_take(Pixel *pixel, wide nearest, wide z, wide opacity, const Seen *seen, uint splat, uint place,
                                int mask, global const Splat *splats, const BlendConstants *constants) {
    Waiting *waiting = &pixel->waiting;
    if (waiting->bounded) {
        if (z > waiting->until || (z == waiting->until && !waiting_earlier(splats, place, waiting->until_splat))) return;
        if (z < waiting->from || (z == waiting->from && waiting_earlier(splats, place, waiting->from_splat))) return;
    }
//@@ sorted_take
    waiting_push(pixel, nearest, z, opacity, splat, splats, constants);
}

//@@ plane_functions
// After the last splat of the list: composites what waits. Returns whether the list is to be gone through again.
static inline int waiting_end(Pixel *pixel, global const Splat *splats, const BlendConstants *constants) {
//@@ plane_end
    Waiting *waiting = &pixel->waiting;
    waiting_leave(pixel, INFINITY, splats, constants);
#pragma unroll
    for (int k = 0; k < IN_REGISTERS; k++)
        if (waiting->splat[k] != NONE)
            waiting_composite(pixel, waiting->z[k], waiting->opacity[k], waiting->splat[k], splats, constants);
    waiting_clear(waiting);
    waiting->from = waiting->until;
    waiting->from_splat = waiting->until_splat;
    waiting->until = INFINITY;
    waiting->bounded = true;        // where nothing was dropped nothing is taken, if the list is gone through again for others
    return pixel_unfinished(pixel, constants);
}
//@ blend_arguments
                                , splats, lists[batch + which], lists[batch + which], s.nearest
                                , staged[k + 1 < listed ? places[cell][k + 1] : length - 1].splat.nearest
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
