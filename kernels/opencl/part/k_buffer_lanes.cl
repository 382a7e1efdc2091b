// k-buffer of a block of pixels for CPUs: sorts fragments by depth before compositing (effect/order_pixel.cl). An entry has one
// fragment per pixel, each of any splat, with its attributes by value. The farthest fragment of each pixel is in `farthest`. A new
// fragment replaces it or is pushed out; the fragment pushed out can nearly always be composited, else it enters a queue that is
// sorted per pixel. All fragments take the same path, so branches are predictable.
//
// A tile's list is processed in segments, and a segment block by block: the k-buffer of a block stays in the cache, and each block sorts
// the segment's splats by their minimum depth there, which is mostly the order of their fragments. Two measures keep the queue short
// where splats are large, and cost nothing where they are small:
// - Deferral: where many splats of a segment are behind the next splat of the list (their nearest points are in other tiles), they
//   are deferred and form segments in the order of their minimum depths in the tile, once no unread splat is nearer.
// - Lookahead: where many fragments are queued at a block, the depths of the next splats are evaluated before blending, so that
//   the bound at each pixel is the exact depth of the next fragment.
// Neither changes the order of fragments, which is by depth, then by position in the list.
//@ blend_types
#define SEGMENT 128                   // splats; a multiple of 64 and a power of two
#define DEFERRED_CAPACITY 2048                  // deferred splats; when full, the nearest are processed early
#define DEFER_THRESHOLD (SEGMENT / 4)            // splats of a segment behind the next one, from which on the tile defers
#define LOOKAHEAD_QUEUE 4                     // queued fragments of a block, from which on lookahead is used
#define LOOKAHEAD_FACTOR 4                   // splats evaluated per splat required, to amortise lookahead
#define EMPTY_Z INFINITY            // depth of an empty lane of the queue
#define NO_FRAGMENT (-INFINITY)            // depth of an empty lane of `farthest`
typedef struct {                    // one fragment per lane
    vfloat z, alpha;
    vint position;                     // position of its splat in the list
    AttributeFields data;
} Entry;
typedef struct {                    // not in registers
    Entry entries[K_BUFFER_SIZE];         // K_BUFFER_SIZE - 1 are used
    uchar order[K_BUFFER_SIZE];           // indices of entries: `count` used ones, nearest first, then the free ones
    int count;
    int bounded;                    // fragments outside of [from, until) are skipped
    vfloat from, until;             // depths; at depth `from` only positions from `from_position` on, at depth `until` only positions before
    vint from_position, until_position;
} Queue;
typedef struct {
    Entry farthest;
    Queue *queue;
} KBuffer;

static inline void k_buffer_start(KBuffer *k_buffer) {
    const Entry none = {(vfloat)NO_FRAGMENT};      // other fields are 0, so that it contributes nothing
    k_buffer->farthest = none;
}

static inline void queue_start(Queue *queue) {
    for (int k = 0; k < K_BUFFER_SIZE; k++) queue->order[k] = (uchar)k;
    queue->count = queue->bounded = 0;
    queue->from = -INFINITY;
    queue->until = INFINITY;
    queue->from_position = queue->until_position = 0;
}

// Bits of a depth as an integer of the same order; its own inverse.
static inline vint in_order(vint bits) { return bits ^ ((bits >> 31) & 0x7FFFFFFF); }

// Sort key of a depth, rounded down like depths in blocks.
static inline uint rounded_key(blend_real depth) { return sortable((float)depth) & -SEGMENT; }

// Rounded sort key of the minimum depth in `blocks`; keys: depths of a splat in each block.
static inline uint min_key(const int *keys, uint blocks) {
    int min_depth = 0x7FFFFFFF;
    for (; blocks != 0; blocks &= blocks - 1) min_depth = min(min_depth, keys[31 - clz((int)(blocks & -blocks))]);
    return ((uint)min_depth & -SEGMENT) ^ 0x80000000u;
}

// Inserts `taken` distinct keys, at most SEGMENT, into the `count` sorted keys of `deferred`, largest first. Returns the new count.
static inline int insert_deferred(ulong *deferred, int count, const ulong *new_keys, int taken) {
    ulong sorted[SEGMENT];
    for (int k = 0; k < taken; k++) {
        int before = 0;
        for (int other = 0; other < taken; other++) before += new_keys[other] > new_keys[k];
        sorted[before] = new_keys[k];
    }
    int old = count - 1, own = taken - 1;
    for (int to = count + taken - 1; own >= 0; to--)
        deferred[to] = old >= 0 && deferred[old] < sorted[own] ? deferred[old--] : sorted[own--];
    return count + taken;
}
//@ lanes_start
    Queue queues[BLOCKS];
    for (int block = 0; block < (empty ? 1 : BLOCKS); block++) {
        queue_start(&queues[block]);
        pixels[block].k_buffer.queue = &queues[block];
    }
//@ blocks_parameters
                                   , int which, int *keys
//@ blocks_nearest_stored
        VSTORE((in_order(VAS_INT(min_depth)) & -SEGMENT) | which, keys + first);
//@ tile_loop
    ulong deferred[DEFERRED_CAPACITY];         // (minimum depth in the tile, position), farthest first
    int deferred_count = 0;
    bool ordered = false;       // all further splats are deferred
    for (uint read = starts[tile] - base, end = starts[tile + 1] - base; (read < end || deferred_count > 0) && alive;) {
        uint positions[SEGMENT], listed[SEGMENT], length = 0;      // positions in the list, and splat indices
        // read a segment, unless a full segment of deferred splats is in front of all unread splats
        const bool reads = read < end && deferred_count <= DEFERRED_CAPACITY - SEGMENT
                           && (deferred_count < SEGMENT
                               || deferred[deferred_count - SEGMENT] >= (ulong)rounded_key(splats[lists[read]].nearest) << 32);
        if (reads)
            for (; length < SEGMENT && read < end; length++) positions[length] = read++;
        else
            for (; length < SEGMENT && deferred_count > 0; length++) positions[length] = (uint)deferred[--deferred_count];
        blend_real rest_nearest = read < end ? splats[lists[read]].nearest : INFINITY;
        if (!reads && deferred_count > 0) rest_nearest = fmin(rest_nearest, key_depth((uint)(deferred[deferred_count - 1] >> 32)));
//@@ segment_of_layers_sorted
        for (uint which = 0; which < length; which++) listed[which] = lists[positions[which]];
        // touched[splat]: bit mask of the blocks that it overlaps. keys[splat][block]: its minimum depth in the block, whose low bits
        // are replaced by the splat's index in the segment.
        int touched[SEGMENT] __attribute__((aligned(64))), keys[SEGMENT][BLOCKS] __attribute__((aligned(64)));
        uint behind = 0;
        for (int at = 0; at < SEGMENT; at += LANES) VSTORE((vint)0, touched + at);
        for (uint which = 0; which < length; which++) {
            global const Splat *lookahead = splats + listed[min(which + PREFETCH_SPLATS, length - 1)];
            PREFETCH(lookahead);
            PREFETCH((global const char *)lookahead + 64);
            const Splat s = splats[listed[which]];
            behind += s.z_center >= rest_nearest;
            const vint key = (in_order(VAS_INT((vfloat)s.nearest)) & -SEGMENT) | (int)which;
            for (int first = 0; first < BLOCKS; first += LANES) VSTORE(key, keys[which] + first);
            touched[which] = (int)touched_blocks(&s, x0, y0, s.log_opacity - constants.log_alpha_cutoff, constants.sample_area
//@@ blocks_arguments
                , (int)which, keys[which]);
        }
        // splats behind by their centre: test the minimum depth in this tile
        if (reads && (ordered || behind > DEFER_THRESHOLD)) {
            ulong new_keys[SEGMENT];
            int taken = 0, far = 0;
            for (uint which = 0; which < length; which++) {
                const uint blocks = (uint)touched[which] & alive;
                if (blocks == 0) continue;
                const uint min_depth = min_key(keys[which], blocks);
                far += min_depth >= rounded_key(rest_nearest);
                new_keys[taken++] = (ulong)min_depth << 32 | positions[which];
            }
            if (ordered || far > DEFER_THRESHOLD) {
                ordered = true;
                deferred_count = insert_deferred(deferred, deferred_count, new_keys, taken);
                continue;
            }
        }
        for (uint blocks = alive; blocks != 0; blocks &= blocks - 1) {
            const int block = 31 - clz((int)(blocks & -blocks));
            // the block's splats, sorted by these keys: a rank is the number of smaller keys
            int unsorted[SEGMENT + LANES] __attribute__((aligned(64))), sorted[SEGMENT + 1 + LANES] __attribute__((aligned(64))), count = 0;
            for (int first = 0; first < SEGMENT; first += 64) {
                ulong own = 0;
                for (int at = 0; at < 64; at += LANES)
                    own |= (ulong)VBITS(VMASK((VLOAD(touched + first + at) & (int)(1u << block)) != 0)) << at;
                for (; own != 0; own &= own - 1) unsorted[count++] = keys[first + 63 - (int)clz(own & -own)][block];
            }
            VSTORE((vint)0x7FFFFFFF, unsorted + count);
            for (int first = 0; first < count; first += LANES) {
                const vint some = VLOAD(unsorted + first);
                vint ranks = 0;
                for (int other = 0; other < count; other++) ranks -= VMASK(some > unsorted[other]);
                for (int lane = 0; lane < min(count - first, LANES); lane++) sorted[((int *)&ranks)[lane]] = unsorted[first + lane];
            }
            sorted[count] = 0x7F800000;         // infinity
            blend_real nearest[SEGMENT + LANES];        // nearest[k]: lower bound of the depths of all fragments after splat k
            for (int first = 0; first < count; first += LANES)
                VSTORE(VMIN(VAS_FLOAT(in_order(VLOAD(sorted + first + 1) & -SEGMENT)), (vfloat)rest_nearest), nearest + first);
            vfloat depths[SEGMENT];               // per pixel, for splats before `evaluated`
            Pixel pixel = pixels[block];
            // Lookahead: evaluates depths from `lookahead` back to the splat after `next`, up to the last splat that may be nearer than
            // `farthest`, the bound of fragments that can be pushed out.
            int evaluated = 0, looks_ahead = 0;
            for (int next = 0, lookahead = 0; next < count;) {
                const vfloat next_nearest = next < evaluated ? depths[next] : (vfloat)nearest[next], farthest = pixel.k_buffer.farthest.z;
                looks_ahead |= pixel.k_buffer.queue->count >= LOOKAHEAD_QUEUE;
                if (UNLIKELY(looks_ahead) && lookahead == next && VANY(VMASK(farthest >= next_nearest))) {
                    const int first = max(evaluated, next + 1);
                    int last = first;
                    while (last < count && VANY(VMASK(farthest >= nearest[last - 1]))) last++;
                    if (last > first) {
                        evaluated = min(next + 1 + LOOKAHEAD_FACTOR * (last - next - 1), count);
                        lookahead = evaluated - 1;
                        depths[lookahead] = nearest[lookahead];
                    }
                }
                const int which = sorted[lookahead] & (SEGMENT - 1);
                const Splat s = splats[listed[which]];
                blend_real half_r2 = s.log_opacity - constants.log_alpha_cutoff;
//@ tile_loop_end
                lookahead = ++next;
            }
            pixels[block] = pixel;
        }
    }
//@ blend_functions
// Composites queued fragments nearer than `nearest`, except entries that also hold a farther one.
static inline void k_buffer_flush(Pixel *pixel, vfloat nearest, const BlendConstants *constants) {
    Queue *queue = pixel->k_buffer.queue;
    int left = 0;
    for (; left < queue->count; left++) {
        const Entry *entry = &queue->entries[queue->order[left]];
        vint waits = VMASK(entry->z < EMPTY_Z), ready = waits & VMASK(entry->z < nearest);
        if (VANY(waits & ~ready)) break;
        composite(pixel, &entry->data.attributes, entry->alpha, ready, constants);
    }
    if (left == 0) return;
    uchar free[K_BUFFER_SIZE];
    for (int k = 0; k < left; k++) free[k] = queue->order[k];
    queue->count -= left;
    for (int k = 0; k < queue->count; k++) queue->order[k] = queue->order[k + left];
    for (int k = 0; k < left; k++) queue->order[queue->count + k] = free[k];
}

static inline void swap_lanes(vfloat *one, vfloat *other, vint mask) {
    vfloat copy = *one;
    *one = VSELECT(copy, *other, mask);
    *other = VSELECT(*other, copy, mask);
}

static inline void swap_entries(Entry *one, Entry *other, vint mask) {
    swap_lanes(&one->z, &other->z, mask);
    swap_lanes(&one->alpha, &other->alpha, mask);
    vint position = one->position;
    one->position = VSELECT(position, other->position, mask);
    other->position = VSELECT(other->position, position, mask);
#pragma unroll
    for (uint field = 0; field < sizeof(Attributes) / sizeof(vfloat); field++)
        swap_lanes(&one->data.fields[field], &other->data.fields[field], mask);
}

// Lanes where one fragment precedes the other: by depth, then by position in the list.
static inline vint entry_before(const Entry *one, const Entry *other) {
    return VMASK(one->z < other->z) | (VMASK(one->z == other->z) & VMASK(one->position < other->position));
}

// Enqueues the fragments pushed out of `farthest`. If the queue is full, each lane evicts its farthest fragment and sets `until`: the
// next pass composites from there on.
static inline void k_buffer_enqueue(KBuffer *k_buffer, Entry *own) {
    Queue *queue = k_buffer->queue;
    own->z = VSELECT(own->z, (vfloat)EMPTY_Z, VMASK(own->z == NO_FRAGMENT));
    for (int k = 0; k < queue->count; k++) {
        Entry *other = &queue->entries[queue->order[k]];
        vint before = entry_before(own, other);
        if (VANY(before)) swap_entries(own, other, before);
        if (!VANY(VMASK(own->z < EMPTY_Z))) return;
    }
    if (queue->count < K_BUFFER_SIZE - 1) {
        queue->entries[queue->order[queue->count++]] = *own;
        return;
    }
    vint dropped = VMASK(own->z < EMPTY_Z);
    queue->until = VSELECT(queue->until, k_buffer->farthest.z, dropped);
    queue->until_position = VSELECT(queue->until_position, k_buffer->farthest.position, dropped);
    queue->bounded = 1;
    swap_entries(own, &k_buffer->farthest, dropped);
}

// Inserts a fragment of the splat at `position` in the list; no later fragment is nearer than `nearest`.
static inline void k_buffer_insert(Pixel *pixel, vfloat nearest, vfloat z, vfloat alpha, const Attributes *attributes,
                                   uint splat, uint position, vint mask, global const Splat *splats,
                                   const BlendConstants *constants) {
    KBuffer *k_buffer = &pixel->k_buffer;
    vint here = (vint)(int)position;
    Queue *queue = k_buffer->queue;
    if (queue->bounded) {
        mask &= VMASK(z < queue->until) | (VMASK(z == queue->until) & VMASK(here < queue->until_position));
        mask &= VMASK(z > queue->from) | (VMASK(z == queue->from) & VMASK(here >= queue->from_position));
        if (!VANY(mask)) return;
    }
    Entry own = {VSELECT((vfloat)NO_FRAGMENT, z, mask), alpha, here};
    own.data.attributes = *attributes;
    swap_entries(&own, &k_buffer->farthest, mask & ~entry_before(&own, &k_buffer->farthest));
    vint leaves = VMASK(own.z > NO_FRAGMENT);
    if (queue->count == 0 && !VANY(VMASK(own.z >= nearest)))
        composite(pixel, &own.data.attributes, own.alpha, leaves, constants);
    else {
        if (VANY(leaves)) k_buffer_enqueue(k_buffer, &own);
        k_buffer_flush(pixel, nearest, constants);
    }
}
//@ k_buffer_finish
    k_buffer_flush(pixel, INFINITY, constants);
    Entry *farthest = &pixel->k_buffer.farthest;
    composite(pixel, &farthest->data.attributes, farthest->alpha, VMASK(farthest->z > NO_FRAGMENT), constants);
    farthest->z = NO_FRAGMENT;
    Queue *queue = pixel->k_buffer.queue;
    queue->from = queue->until;
    queue->from_position = queue->until_position;
    queue->until = INFINITY;
    repeats = VMASK(queue->from < INFINITY);
//@ layer_passed
        queue->from = VSELECT(queue->from, (vfloat)-INFINITY, ready);
//@ skip_fragment
            if (lookahead > next) {
                vfloat z = fragment_attributes(&s, c, INVERSE_D(c)).z;
                depths[lookahead - 1] = VSELECT(depths[lookahead], VMIN(z, depths[lookahead]), mask);
                lookahead--;
                continue;
            }
            if (!VANY(mask)) {
                lookahead = ++next;
                continue;
            }
//@ blend_arguments
                        , splats, listed[which], positions[which], next_nearest
