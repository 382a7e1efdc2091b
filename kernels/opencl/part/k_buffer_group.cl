// Per-pixel k-buffer for GPUs: sorts fragments by depth before compositing (effect/order_pixel.cl). The farthest IN_REGISTERS
// fragments are in registers, sorted by depth. A new fragment is inserted there, and the nearest is pushed out: it can nearly always be
// composited, else it enters a queue in memory, which is short and mostly empty.
//@ blend_types
#ifndef TIE_IN_FRONT
#define TIE_IN_FRONT(splat, other) true         // fragments of equal depths arrive in their order
#define BEFORE_NEXT(z, nearest) ((z) <= (nearest))
#endif
#define IN_FRONT(z, splat, other_z, other) ((z) < (other_z) || ((z) == (other_z) && TIE_IN_FRONT(splat, other)))
#define NO_SPLAT 0xFFFFFFFFu            // an unused entry
#define IN_REGISTERS (K_BUFFER_SIZE < 3 ? K_BUFFER_SIZE : 3)
#define QUEUE_CAPACITY (K_BUFFER_SIZE - IN_REGISTERS)
typedef struct {                    // in memory: an index that is not constant moves a complete struct out of registers
    blend_real z[QUEUE_CAPACITY + 1], alpha[QUEUE_CAPACITY + 1];    // ring buffer, sorted by depth
    uint splat[QUEUE_CAPACITY + 1];
} Queue;
typedef struct {
    blend_real z[IN_REGISTERS], alpha[IN_REGISTERS];
    uint splat[IN_REGISTERS];
    Queue *queue;
    uint head, count;               // of the queue
    bool bounded;                   // fragments outside of [from, until) are skipped
    blend_real from, until;               // depths; at depth `from` only splats from `from_splat` on, at depth `until` only splats before
    uint from_splat, until_splat;   // `until_splat`
} KBuffer;

static inline void k_buffer_clear(KBuffer *k_buffer) {
    for (int k = 0; k < IN_REGISTERS; k++) {
        k_buffer->z[k] = -INFINITY;
        k_buffer->splat[k] = NO_SPLAT;
    }
}

static inline void k_buffer_start(KBuffer *k_buffer) {
    k_buffer_clear(k_buffer);
    k_buffer->head = k_buffer->count = 0;
    k_buffer->bounded = false;
    k_buffer->from = -INFINITY;
    k_buffer->until = INFINITY;
    k_buffer->from_splat = k_buffer->until_splat = 0;
}
//@ group_start
    Queue queues[ROWS];
    for (int row = 0; row < ROWS; row++) pixels[row].k_buffer.queue = &queues[row];
//@ pass_unfinished
        & VMASK(pixel->k_buffer.from < INFINITY)
//@ blend_functions
// Order of two splats in the list.
static inline bool precedes(global const Splat *splats, uint splat, uint other) {
    blend_real nearest = splats[splat].nearest, than = splats[other].nearest;
    return nearest < than || (nearest == than && splat < other);
}

static inline void k_buffer_composite(Pixel *pixel, blend_real z, blend_real alpha, uint splat, global const Splat *splats,
                                     const BlendConstants *constants) {
    const Splat s = splats[splat];
    const Intersection nowhere = {1.0f};
    Attributes attributes = fragment_attributes(&s, nowhere, 1.0f);
    attributes.z = z;
    composite(pixel, &attributes, alpha, VMASK(true), constants);
}

// Index of the queue's k-th entry in the ring buffer.
static inline uint queue_index(const KBuffer *k_buffer, uint k) {
    uint at = k_buffer->head + k;
    return at < QUEUE_CAPACITY ? at : at - QUEUE_CAPACITY;
}

// Composites all queued fragments up to depth `nearest`.
static inline void k_buffer_flush(Pixel *pixel, blend_real nearest, global const Splat *splats, const BlendConstants *constants) {
    KBuffer *k_buffer = &pixel->k_buffer;
    Queue *queue = k_buffer->queue;
    while (k_buffer->count > 0 && BEFORE_NEXT(queue->z[k_buffer->head], nearest)) {
        uint at = k_buffer->head;
        k_buffer->head = queue_index(k_buffer, 1);
        k_buffer->count--;
        k_buffer_composite(pixel, queue->z[at], queue->alpha[at], queue->splat[at], splats, constants);
    }
}

// Enqueues a fragment that is not behind those in registers. If the queue is full, the farthest fragment of all is dropped.
static inline void k_buffer_enqueue(Pixel *pixel, blend_real z, blend_real alpha, uint splat, global const Splat *splats) {
    KBuffer *k_buffer = &pixel->k_buffer;
    Queue *queue = k_buffer->queue;
    if (k_buffer->count == QUEUE_CAPACITY) {
        uint dropped = k_buffer->splat[IN_REGISTERS - 1];
        k_buffer->until = k_buffer->z[IN_REGISTERS - 1];
        k_buffer->until_splat = dropped;
        k_buffer->bounded = true;
#pragma unroll
        for (int k = IN_REGISTERS - 1; k > 0; k--) {
            k_buffer->z[k] = k_buffer->z[k - 1];
            k_buffer->alpha[k] = k_buffer->alpha[k - 1];
            k_buffer->splat[k] = k_buffer->splat[k - 1];
        }
        uint last = queue_index(k_buffer, k_buffer->count - 1);
        bool further = QUEUE_CAPACITY > 0 && !IN_FRONT(queue->z[last], queue->splat[last], z, splat);
        k_buffer->z[0] = further ? queue->z[last] : z;
        k_buffer->alpha[0] = further ? queue->alpha[last] : alpha;
        k_buffer->splat[0] = further ? queue->splat[last] : splat;
        if (!further) return;
        k_buffer->count--;
    }
    uint k = k_buffer->count++, at = queue_index(k_buffer, k);
    for (; k > 0; k--) {
        uint before = queue_index(k_buffer, k - 1);
        if (IN_FRONT(queue->z[before], queue->splat[before], z, splat)) break;
        queue->z[at] = queue->z[before];
        queue->alpha[at] = queue->alpha[before];
        queue->splat[at] = queue->splat[before];
        at = before;
    }
    queue->z[at] = z;
    queue->alpha[at] = alpha;
    queue->splat[at] = splat;
}

// Inserts a fragment; no later fragment is nearer than `nearest`.
static inline void k_buffer_push(Pixel *pixel, blend_real nearest, blend_real z, blend_real alpha, uint splat, global const Splat *splats,
                                const BlendConstants *constants) {
    KBuffer *k_buffer = &pixel->k_buffer;
    // the new fragment may be nearer than queued ones
    k_buffer_flush(pixel, fmin(nearest, z), splats, constants);
    bool in_front[IN_REGISTERS], ties = false;      // of the new fragment
#pragma unroll
    for (int k = 0; k < IN_REGISTERS; k++) {
        in_front[k] = k_buffer->z[k] <= z;
        ties |= k_buffer->z[k] == z;
    }
    if (ties) {         // one branch for all, since ties are rare
#pragma unroll
        for (int k = 0; k < IN_REGISTERS; k++) in_front[k] = IN_FRONT(k_buffer->z[k], k_buffer->splat[k], z, splat);
    }
    bool first = !in_front[0];
    blend_real first_z = first ? z : k_buffer->z[0], first_alpha = first ? alpha : k_buffer->alpha[0];
    uint first_splat = first ? splat : k_buffer->splat[0];
#pragma unroll
    for (int k = 0; k < IN_REGISTERS; k++) {
        int from = min(k + 1, IN_REGISTERS - 1);
        bool moves = k + 1 < IN_REGISTERS && in_front[from], here = in_front[k];
        k_buffer->alpha[k] = moves ? k_buffer->alpha[from] : here ? alpha : k_buffer->alpha[k];
        k_buffer->splat[k] = moves ? k_buffer->splat[from] : here ? splat : k_buffer->splat[k];
        k_buffer->z[k] = moves ? k_buffer->z[from] : here ? z : k_buffer->z[k];
    }
    if (first_splat == NO_SPLAT) return;
    if (k_buffer->count == 0 && BEFORE_NEXT(first_z, nearest))
        k_buffer_composite(pixel, first_z, first_alpha, first_splat, splats, constants);
    else
        k_buffer_enqueue(pixel, first_z, first_alpha, first_splat, splats);
}

// Inserts a fragment of a splat, none of whose fragments is nearer than `nearest`. position: index that gives its position in the list.
static inline void k_buffer_insert(Pixel *pixel, blend_real nearest, blend_real z, blend_real alpha, const Attributes *attributes, uint splat, uint position,
                                int mask, global const Splat *splats, const BlendConstants *constants) {
    KBuffer *k_buffer = &pixel->k_buffer;
    if (k_buffer->bounded) {
        if (z > k_buffer->until || (z == k_buffer->until && !precedes(splats, position, k_buffer->until_splat))) return;
        if (z < k_buffer->from || (z == k_buffer->from && precedes(splats, position, k_buffer->from_splat))) return;
    }
    k_buffer_push(pixel, nearest, z, alpha, splat, splats, constants);
}
//@ k_buffer_finish
    KBuffer *k_buffer = &pixel->k_buffer;
    k_buffer_flush(pixel, INFINITY, splats, constants);
#pragma unroll
    for (int k = 0; k < IN_REGISTERS; k++)
        if (k_buffer->splat[k] != NO_SPLAT)
            k_buffer_composite(pixel, k_buffer->z[k], k_buffer->alpha[k], k_buffer->splat[k], splats, constants);
    k_buffer_clear(k_buffer);
    k_buffer->from = k_buffer->until;
    k_buffer->from_splat = k_buffer->until_splat;
    k_buffer->until = INFINITY;
    k_buffer->bounded = true;        // in another pass (for other pixels), a pixel that dropped nothing skips all fragments
    repeats = VMASK(k_buffer->from < INFINITY);
//@ staged_open
            && staged[0].splat.nearest <= pixels[row].k_buffer.until      // else the buffer is full of nearer fragments
//@ pass_from
    from = fmax(from, pixel->k_buffer.from);
//@ layer_passed
        if (ready) k_buffer->from = -INFINITY;
//@ blend_arguments
                                , splats, lists[staged_start + which], lists[staged_start + which]
                                , staged[k + 1 < listed ? cell_splats[cell][k + 1] : length - 1].splat.nearest
