"""Struct Splat: the fields of a splat's record that samples read, from global or shared memory."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .common import View, load_vec4, of_bits, struct_of
from .ellipsoids import EXACT
from .records import BOXES, RecordLayout


@cache
def make_splat(effects: tuple[str, ...], outputs: tuple[str, ...]) -> SimpleNamespace:
    """Make the struct Splat; make_readers(vec4_of), which makes functions that read records by a function
    that loads 16 bytes of them; and read, for the splat lists[k] in global memory.
    """
    layout = RecordLayout(effects, outputs)
    stride = layout.vec4s
    has_lowpass_disc, has_lens, parallel = (
        name in effects for name in ("lowpass_screen", "rays", "camera_orthographic")
    )
    edged = not has_lens and any(name in effects for name in BOXES)
    flagged = has_lens and "footprint_mixed" in effects
    thick = EXACT in effects
    # u: nu0, nux, nuy, log opacity; v: nv0, nvx, nvy, D at the near plane; d: d0, dx, dy, ax; c: ay, r, g, b
    splat = {"u": wp.vec4, "v": wp.vec4, "d": wp.vec4, "c": wp.vec4, "half_r2": wp.float32}
    splat |= {"lowpass_x": wp.float32, "lowpass_y": wp.float32} if has_lowpass_disc else {}
    splat |= {"edges": wp.vec4} if edged else {}
    splat |= {"boxed": wp.float32} if flagged else {}
    splat |= {"ellipsoid_term": wp.float32} if thick else {}
    # origin: ray of the anchor; w: factors of the ray's Z relative to it in n_u, n_v and D, then origin.x
    splat |= {"w": wp.vec4, "origin": wp.vec3} if has_lens else {}
    # plane_z0, plane_zx, plane_zy, plane_near
    splat |= {"plane": wp.vec4} if parallel else {}
    Splat = struct_of("Splat", "Fields of a record that each sample reads.", splat)
    lowpass_vec4, lowpass_component = layout.position("lowpass_x")
    lowpass_y_component = layout.position("lowpass_y")[1]  # in the same vec4
    edge_vec4 = layout.position("edge_u0")[0]
    boxed_vec4, boxed_component = layout.position("boxed")
    ellipsoid_vec4, ellipsoid_component = layout.position("ellipsoid_term")
    box_vec4, box_component = layout.position("columns")  # and rows
    ray_vec4, plane_vec4 = layout.position("nuz")[0], layout.position("plane_z0")[0]

    def make_readers(vec4_of) -> SimpleNamespace:
        """Make load and box_of, which read the splat lists[first + which] and its box of samples."""

        @wp.func
        def load(
            shared_memory: wp.uint64,
            records: wp.array(dtype=wp.vec4),
            lists: wp.array(dtype=wp.int32),
            first: int,
            which: int,
            view: View,
        ):
            s = Splat()
            s.u = vec4_of(shared_memory, records, lists, first, which, 0)
            s.v = vec4_of(shared_memory, records, lists, first, which, 1)
            s.d = vec4_of(shared_memory, records, lists, first, which, 2)
            s.c = vec4_of(shared_memory, records, lists, first, which, 3)
            if wp.static(has_lowpass_disc):
                disc = vec4_of(shared_memory, records, lists, first, which, lowpass_vec4)
                s.lowpass_x = disc[lowpass_component]
                s.lowpass_y = disc[lowpass_y_component]
            if wp.static(edged):
                s.edges = vec4_of(shared_memory, records, lists, first, which, edge_vec4)
            if wp.static(flagged):
                s.boxed = vec4_of(shared_memory, records, lists, first, which, boxed_vec4)[boxed_component]
            if wp.static(thick):
                s.ellipsoid_term = vec4_of(shared_memory, records, lists, first, which, ellipsoid_vec4)[
                    ellipsoid_component
                ]
            if wp.static(has_lens):
                s.w = vec4_of(shared_memory, records, lists, first, which, ray_vec4)
                rest = vec4_of(shared_memory, records, lists, first, which, ray_vec4 + 1)
                s.origin = wp.vec3(s.w[3], rest[0], rest[1])
            if wp.static(parallel):
                s.plane = vec4_of(shared_memory, records, lists, first, which, plane_vec4)
            s.half_r2 = s.u[3] - view.log_alpha_cutoff
            return s

        @wp.func
        def box_of(
            shared_memory: wp.uint64,
            records: wp.array(dtype=wp.vec4),
            lists: wp.array(dtype=wp.int32),
            first: int,
            which: int,
        ) -> wp.vec4i:
            """Box of samples: columns [first, end), then rows [first, end)."""
            box = vec4_of(shared_memory, records, lists, first, which, box_vec4)
            left, right = of_bits(box[box_component])
            top, bottom = of_bits(box[box_component + 1])
            return wp.vec4i(left, right, top, bottom)

        return SimpleNamespace(load=load, box_of=box_of)

    @wp.func
    def global_vec4(
        shared_memory: wp.uint64,
        records: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        first: int,
        which: int,
        at: int,
    ) -> wp.vec4:
        return load_vec4(records, lists[first + which] * stride + at)

    load_global = make_readers(global_vec4).load

    @wp.func
    def read(records: wp.array(dtype=wp.vec4), lists: wp.array(dtype=wp.int32), k: int, view: View):
        return load_global(wp.uint64(0), records, lists, k, 0, view)

    return SimpleNamespace(Splat=Splat, make_readers=make_readers, read=read)
