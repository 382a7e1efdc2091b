"""One sample: its fragments, and what it keeps of them. Front to back, C = sum_k c_k alpha_k prod_{j<k} (1 -
alpha_j).

Fragments may wait for nearer ones (waiting.py), splats of one plane together (layers.py). A picture with
depths of another renderer may be an opaque surface among them: of a fragment at its depth or behind it
nothing is seen, and it is composited itself after the last. What outputs keep stands in their files
(output/).
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from . import output
from .common import LEAST_ALPHA, View, fma, line_of, struct_of
from .crossing import make_crossing
from .layers import make_layer
from .rays import make_rays
from .records import BOXES, Layout
from .splat import make_splat
from .waiting import make_queue, make_waiting


@cache
def make_pixel(effects: tuple[str, ...], outputs: tuple[str, ...], room: int) -> SimpleNamespace:
    """The state of a sample, and what is done with it: Rays, Pixel; start, unfinished, blend, end (None
    without a second pass), cover (None without an opaque surface), finish. room: for fragments that wait.
    """
    Splat, crossing = make_splat(effects, outputs).Splat, make_crossing(effects, outputs)
    Crossing, is_box = crossing.Crossing, crossing.is_box
    opacity_of, depth_of = crossing.opacity_of, crossing.depth_of
    layout = Layout(effects, outputs)
    each = layout.lines
    exclusive, has_depth, waits, layered, bent = (
        name in effects
        for name in ("stop_exclusive", "ray_depth", "compose_pixel", "compose_coplanar", "rays")
    )
    boxes, opaque = any(name in effects for name in BOXES), "external_depth" in effects
    rays = make_rays(bent, "rays_length" in effects, bent and boxes, opaque)
    Rays, length_of = rays.Rays, rays.length_of
    starts, sees, attenuates, composites, covers, clears = (
        output.functions(outputs, part)
        for part in ("start", "see", "attenuate", "composite", "cover", "clear")
    )
    measured = bool(output.having(output.having(outputs, "start"), "length"))
    readers = [make_reader(layout, output.declared(name).record) for name in output.having(outputs, "see")]
    seen = {"rgb": wp.vec3}
    seen |= {"z": wp.float32} if has_depth else {}
    Seen = struct_of("Seen", "What shows where something is drawn.", seen | output.fields(outputs, "seen"))
    layer = make_layer(Seen, effects, outputs) if layered else None
    fields = {"t": wp.float32, "r": wp.float32, "g": wp.float32, "b": wp.float32}
    fields |= {"finished": wp.int32} if exclusive else {}
    fields |= {"opaque_z": wp.float32} if opaque else {}
    fields |= output.fields(outputs, "state")
    fields |= {"queue": make_queue(layer, room)} if waits else {}
    Pixel = struct_of("Pixel", "What a sample keeps.", fields)

    @wp.func
    def pixel_at(x: int, y: int, view: View) -> int:
        """Number of the pixel that a sample belongs to, row by row."""
        return y / view.samples * (view.width / view.samples) + x / view.samples

    @wp.func
    def start(x: int, y: int, rays: Rays, view: View):
        """The state of a sample before anything is drawn."""
        p = Pixel()
        p.t = 1.0
        if wp.static(waits):
            p = waiting.start(p)
        length = float(1.0)
        if wp.static(measured):
            length = length_of(x, y, rays, view)
        if wp.static(opaque):
            p.opaque_z = wp.inf
            # a tile has samples beyond the picture too
            if x < view.width and y < view.height:
                p.opaque_z = rays.external_depth[pixel_at(x, y, view)]
        for k in range(wp.static(len(starts))):
            p = wp.static(starts[k])(p, length, view)
        return p

    @wp.func
    def unfinished(p: Pixel, view: View) -> bool:
        """Whether anything that follows can still be seen."""
        if wp.static(exclusive):
            return p.t > view.stop and p.finished == 0
        elif wp.static(waits):
            return p.t > view.stop and p.queue.after_z < wp.inf
        else:
            return p.t > view.stop

    @wp.func
    def see(color: wp.vec3, z: float, lines: wp.array(dtype=wp.vec4), index: int):
        """What a fragment of a splat shows at depth z."""
        seen = Seen()
        seen.rgb = color
        if wp.static(has_depth):
            seen.z = z
        for k in range(wp.static(len(sees))):
            seen = wp.static(sees[k])(seen, wp.static(readers[k])(lines, index * each), index)
        return seen

    @wp.func
    def composite(pixel: Pixel, seen: Seen, opacity: float, view: View):
        """The pixel with something over all that follows; as it was if it lets no light through."""
        p = pixel
        if not (p.t > view.stop):
            return p
        if wp.static(exclusive):
            # as gsplat and the 2DGS authors: what would close the pixel is dropped (for parity; numerics D1)
            if p.t * (1.0 - opacity) <= view.stop:
                p.finished = 1
                return p
        weight = p.t * opacity
        shown = weight
        for k in range(wp.static(len(attenuates))):
            shown = wp.static(attenuates[k])(p, seen, shown)
        p.r = fma(shown, seen.rgb[0], p.r)
        p.g = fma(shown, seen.rgb[1], p.g)
        p.b = fma(shown, seen.rgb[2], p.b)
        for k in range(wp.static(len(composites))):
            p = wp.static(composites[k])(p, seen, weight, shown, view)
        p.t = p.t - weight
        return p

    @wp.func
    def see_again(lines: wp.array(dtype=wp.vec4), index: int, z: float):
        """What a fragment shows that was seen before."""
        c = line_of(lines, index * each + wp.static(layout.place("r")[0]))
        return see(wp.vec3(c[1], c[2], c[3]), z, lines, index)

    @wp.func
    def nearest_of(lines: wp.array(dtype=wp.vec4), index: int) -> float:
        """Depth before which no fragment of the splat lies."""
        return line_of(lines, index * each + wp.static(layout.place("nearest")[0]))[
            wp.static(layout.place("nearest")[1])
        ]

    waiting = make_waiting(Pixel, composite, see_again, layer, room) if waits else None

    @wp.func
    def blend(
        pixel: Pixel,
        s: Splat,
        c: Crossing,
        place: int,
        lines: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        coplanar_groups: wp.array(dtype=wp.int32),
        view: View,
    ):
        """The pixel after a fragment that is drawn of the splat at `place` in the list, of a pixel that is
        not finished.
        """
        index = lists[place]
        inverse_d = 1.0 / c.d
        opacity = opacity_of(s, c, inverse_d, view)
        z, plane = float(0.0), int(-1)
        if wp.static(layered):
            plane = coplanar_groups[index % view.splats]
        if wp.static(has_depth):
            z = depth_of(lines, index, s, c, inverse_d, plane >= 0)
        if wp.static(opaque):
            nearer = z
            if wp.static(layered):
                nearer = wp.max(z, nearest_of(lines, index))
            if not (nearer < pixel.opaque_z):
                return pixel
        color = wp.vec3(s.c[1], s.c[2], s.c[3])
        if wp.static(layered):
            p = pixel
            if not (opacity > 0.0):
                return p  # of no optical depth: a mean over it would be 0 / 0
            nearest = nearest_of(lines, index)
            if plane != p.queue.open.plane:
                p = waiting.close(p, nearest, lines, lists, view)
                p.queue.open = layer.begun(plane, place, nearest)
            if plane < 0:
                return waiting.take(p, nearest, z, opacity, place, lines, lists, view)
            seen = see(color, wp.max(z, nearest), lines, index)
            if wp.static(boxes):
                if is_box(s):
                    p.queue.open = layer.gather_box(p.queue.open, seen, opacity)
                    return p
            p.queue.open = layer.gather(p.queue.open, seen, opacity)
            return p
        elif wp.static(waits):
            return waiting.take(pixel, nearest_of(lines, index), z, opacity, place, lines, lists, view)
        else:
            return composite(pixel, see(color, z, lines, index), opacity, view)

    @wp.func
    def cover(pixel: Pixel, x: int, y: int, rays: Rays, view: View):
        """The pixel with the opaque surface behind all that is drawn of it: it takes all the light that is
        left, also where that is so little that splats would not be drawn.
        """
        p = pixel
        if p.opaque_z < wp.inf:
            seen = Seen()
            seen.rgb = rays.external_rgb[pixel_at(x, y, view)]
            seen.z = p.opaque_z
            for k in range(wp.static(len(covers))):
                seen = wp.static(covers[k])(seen)
            if wp.static(exclusive):
                p.finished = 0
            unstopped = view
            unstopped.stop = -1.0
            p = composite(p, seen, 1.0, unstopped)
        return p

    @wp.func
    def finish(pixel: Pixel):
        """The pixel after the last fragment."""
        p = pixel
        if 1.0 - p.t < LEAST_ALPHA:
            for k in range(wp.static(len(clears))):
                p = wp.static(clears[k])(p)
        return p

    return SimpleNamespace(
        Rays=Rays,
        Pixel=Pixel,
        start=start,
        unfinished=unfinished,
        blend=blend,
        end=waiting.end if waits else None,
        cover=cover if opaque else None,
        finish=finish,
    )


def make_reader(layout: Layout, names: tuple[str, ...]):
    """The function (lines, at) that reads these numbers of the record at line `at`: a vector; 0 of none."""
    places = [layout.place(name) for name in names]
    vector = wp.types.vector(max(len(names), 1), wp.float32)

    @wp.func
    def nothing(lines: wp.array(dtype=wp.vec4), at: int) -> float:
        return 0.0

    @wp.func
    def read(lines: wp.array(dtype=wp.vec4), at: int):
        numbers = vector()
        for k in range(wp.static(len(places))):
            numbers[k] = line_of(lines, at + wp.static(places[k][0]))[wp.static(places[k][1])]
        return numbers

    return read if names else nothing
