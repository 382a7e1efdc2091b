"""Struct Splat: the fields of a splat's record that samples read, from global or shared memory."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .common import View, line_of, of_bits, struct_of
from .ellipsoids import EXACT
from .records import BOXES, RecordLayout


@cache
def make_splat(effects: tuple[str, ...], outputs: tuple[str, ...]) -> SimpleNamespace:
    """Make Splat; reading(line), which makes readers from a function that loads lines of records; and read,
    for the splat lists[k] in global memory.
    """
    layout = RecordLayout(effects, outputs)
    each = layout.lines
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
    # w: factors of the ray's Z, then the anchor's X; origin: the anchor's ray
    splat |= {"w": wp.vec4, "origin": wp.vec3} if has_lens else {}
    # plane_z0, plane_zx, plane_zy, plane_near
    splat |= {"plane": wp.vec4} if parallel else {}
    Splat = struct_of("Splat", "Fields of a record that each sample reads.", splat)
    lowpass_line, lowpass_lane = layout.position("lowpass_x")
    lowpass_y_lane = layout.position("lowpass_y")[1]  # on the same line
    edge_line = layout.position("edge_u0")[0]
    boxed_line, boxed_lane = layout.position("boxed")
    ellipsoid_line, ellipsoid_lane = layout.position("ellipsoid_term")
    box_line, box_lane = layout.position("columns")  # and rows
    ray_line, plane_line = layout.position("nuz")[0], layout.position("plane_z0")[0]

    def reading(line) -> SimpleNamespace:
        """Make load, for the splat lists[first + which], and box_of, for its box of samples."""

        @wp.func
        def load(
            shared_memory: wp.uint64,
            lines: wp.array(dtype=wp.vec4),
            lists: wp.array(dtype=wp.int32),
            first: int,
            which: int,
            view: View,
        ):
            s = Splat()
            s.u = line(shared_memory, lines, lists, first, which, 0)
            s.v = line(shared_memory, lines, lists, first, which, 1)
            s.d = line(shared_memory, lines, lists, first, which, 2)
            s.c = line(shared_memory, lines, lists, first, which, 3)
            if wp.static(has_lowpass_disc):
                disc = line(shared_memory, lines, lists, first, which, lowpass_line)
                s.lowpass_x = disc[lowpass_lane]
                s.lowpass_y = disc[lowpass_y_lane]
            if wp.static(edged):
                s.edges = line(shared_memory, lines, lists, first, which, edge_line)
            if wp.static(flagged):
                s.boxed = line(shared_memory, lines, lists, first, which, boxed_line)[boxed_lane]
            if wp.static(thick):
                s.ellipsoid_term = line(shared_memory, lines, lists, first, which, ellipsoid_line)[
                    ellipsoid_lane
                ]
            if wp.static(has_lens):
                s.w = line(shared_memory, lines, lists, first, which, ray_line)
                rest = line(shared_memory, lines, lists, first, which, ray_line + 1)
                s.origin = wp.vec3(s.w[3], rest[0], rest[1])
            if wp.static(parallel):
                s.plane = line(shared_memory, lines, lists, first, which, plane_line)
            s.half_r2 = s.u[3] - view.log_alpha_cutoff
            return s

        @wp.func
        def box_of(
            shared_memory: wp.uint64,
            lines: wp.array(dtype=wp.vec4),
            lists: wp.array(dtype=wp.int32),
            first: int,
            which: int,
        ) -> wp.vec4i:
            """Box of samples: columns [first, end), then rows [first, end)."""
            box = line(shared_memory, lines, lists, first, which, box_line)
            left, right = of_bits(box[box_lane])
            top, bottom = of_bits(box[box_lane + 1])
            return wp.vec4i(left, right, top, bottom)

        return SimpleNamespace(load=load, box_of=box_of)

    @wp.func
    def global_line(
        shared_memory: wp.uint64,
        lines: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        first: int,
        which: int,
        line: int,
    ) -> wp.vec4:
        return line_of(lines, lists[first + which] * each + line)

    load_global = reading(global_line).load

    @wp.func
    def read(lines: wp.array(dtype=wp.vec4), lists: wp.array(dtype=wp.int32), k: int, view: View):
        return load_global(wp.uint64(0), lines, lists, k, 0, view)

    return SimpleNamespace(Splat=Splat, reading=reading, read=read)
