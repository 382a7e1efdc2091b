"""Fragments by their own depth at each sample, where the ray meets their splats.

Lists are sorted by the nearest depth that any fragment of a splat can have, as blending itself rounds it
(`nearest`): so nothing that is still to come lies before the splat at hand, and what waits nearer than that
is composited, by depth, ties in the order of the list. There is room for some fragments at a sample. Of more
the furthest is dropped, with all that lies behind it (`until`), and the list is gone through again for what
was dropped (`after`), until nothing is: the picture does not depend on the room.
"""

from types import SimpleNamespace

import warp as wp

from .common import View, struct_of

_NOTHING = wp.constant(-1)
"""place in the list of nothing that waits; a layer's is less"""
_FIRST, _SECOND = wp.constant(-2), wp.constant(-3)
"""places of the layers that wait"""


def make_queue(layer: SimpleNamespace | None, room: int):
    """The struct Queue of fragments that wait at a sample, and of two layers if `layer` has any."""
    fields = {
        # always so many, sorted by depth: those of nothing are in front
        "z": wp.types.vector(room, wp.float32),
        "opacity": wp.types.vector(room, wp.float32),
        "place": wp.types.vector(room, wp.int32),
        # fragments between these are taken: depth, and of equal depth place in the list
        "after_z": wp.float32,
        "after": wp.int32,
        "until_z": wp.float32,
        "until": wp.int32,
    }
    # of a layer that gathers, and of those that wait
    fields |= dict.fromkeys(("open", "first", "second"), layer.Layer) if layer else {}
    return struct_of("Queue", "Fragments that wait for nearer ones.", fields)


def make_waiting(Pixel, composite, see_of, layer: SimpleNamespace | None, room: int) -> SimpleNamespace:
    """start, of a Pixel with a `queue`; take, of a fragment; close, of the open layer; end, of the list.

    see_of (lines, index, z): what a fragment of a splat shows at that depth.
    """
    layered = layer is not None
    last = room - 1
    nothing, depth, shown = (layer.nothing, layer.depth, layer.shown) if layer else (None, None, None)

    @wp.func
    def start(pixel: Pixel):
        p = pixel
        for k in range(wp.static(room)):
            p.queue.z[k] = -wp.inf
            p.queue.place[k] = _NOTHING
        p.queue.after_z = -wp.inf
        p.queue.until_z = wp.inf
        if wp.static(layered):
            p.queue.open = nothing()
            p.queue.first = nothing()
            p.queue.second = nothing()
        return p

    @wp.func
    def without(pixel: Pixel, place: int):
        """The pixel without the layer that has this place, if it is one."""
        p = pixel
        if wp.static(layered):
            if place == _FIRST:
                p.queue.first = nothing()
            if place == _SECOND:
                p.queue.second = nothing()
        return p

    @wp.func
    def shown_at(
        p: Pixel, z: float, place: int, lines: wp.array(dtype=wp.vec4), lists: wp.array(dtype=wp.int32)
    ):
        """What waits at this place of the list shows."""
        if wp.static(layered):
            if place == _FIRST:
                return shown(p.queue.first)
            if place == _SECOND:
                return shown(p.queue.second)
        return see_of(lines, lists[place], z)

    @wp.func
    def composite_at(
        pixel: Pixel,
        z: float,
        opacity: float,
        place: int,
        lines: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        view: View,
    ):
        """The pixel with what waited at this place of the list."""
        p = pixel
        if place != _NOTHING:
            p = without(composite(p, shown_at(p, z, place, lines, lists), opacity, view), place)
        return p

    @wp.func
    def list_place(p: Pixel, place: int) -> int:
        """Where in the list it stands; a layer where its first splat does."""
        if wp.static(layered):
            if place == _FIRST:
                return p.queue.first.place
            if place == _SECOND:
                return p.queue.second.place
        return place

    @wp.func
    def drop_from(pixel: Pixel, z: float, place: int):
        """The pixel without what waits at this depth and place in the list, or behind it: the next pass has
        it.
        """
        p = pixel
        p.queue.until_z = z
        p.queue.until = place
        more = bool(True)
        while more:
            at = int(p.queue.place[last])
            more = p.queue.z[last] > z or (p.queue.z[last] == z and list_place(p, at) >= place)
            if more:
                p = without(p, at)
                for k in range(wp.static(last)):
                    p.queue.z[last - k] = p.queue.z[last - k - 1]
                    p.queue.opacity[last - k] = p.queue.opacity[last - k - 1]
                    p.queue.place[last - k] = p.queue.place[last - k - 1]
                p.queue.z[0] = -wp.inf
                p.queue.place[0] = _NOTHING
        return p

    @wp.func
    def is_taken(p: Pixel, z: float, place: int) -> bool:
        """Whether a fragment belongs to this pass."""
        if z > p.queue.until_z or (z == p.queue.until_z and place >= p.queue.until):
            return False
        return z > p.queue.after_z or (z == p.queue.after_z and place >= p.queue.after)

    @wp.func
    def put(
        pixel: Pixel,
        nearest: float,
        z: float,
        opacity: float,
        place: int,
        lines: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        view: View,
    ):
        """The pixel with one fragment more, with nothing to come before `nearest`: the nearest of all is
        composited or, where it may not yet be, the furthest dropped.
        """
        p = pixel
        if p.queue.z[0] > nearest and z > nearest:
            if p.queue.z[last] <= z:
                return without(drop_from(p, z, list_place(p, place)), place)
            p = drop_from(p, p.queue.z[last], list_place(p, p.queue.place[last]))
        first_z, first_opacity = float(p.queue.z[0]), float(p.queue.opacity[0])
        first_place = int(p.queue.place[0])
        if z < first_z:
            return composite_at(p, z, opacity, place, lines, lists, view)
        for k in range(wp.static(last)):
            if p.queue.z[k + 1] <= z:
                p.queue.z[k] = p.queue.z[k + 1]
                p.queue.opacity[k] = p.queue.opacity[k + 1]
                p.queue.place[k] = p.queue.place[k + 1]
            elif p.queue.z[k] <= z:
                p.queue.z[k] = z
                p.queue.opacity[k] = opacity
                p.queue.place[k] = place
        if p.queue.z[last] <= z:
            p.queue.z[last] = z
            p.queue.opacity[last] = opacity
            p.queue.place[last] = place
        return composite_at(p, first_z, first_opacity, first_place, lines, lists, view)

    @wp.func
    def take(
        pixel: Pixel,
        nearest: float,
        z: float,
        opacity: float,
        place: int,
        lines: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        view: View,
    ):
        """The pixel after a fragment of the splat at `place` in the list, of which none is nearer than
        `nearest`.
        """
        if is_taken(pixel, z, place):
            return put(pixel, nearest, z, opacity, place, lines, lists, view)
        return pixel

    @wp.func
    def composite_until(
        pixel: Pixel,
        nearest: float,
        lines: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        view: View,
    ):
        """The pixel with what waits no further than `nearest` composited."""
        p = pixel
        for k in range(wp.static(room)):
            place = int(p.queue.place[k])
            if p.queue.z[k] <= nearest and place != _NOTHING:
                p = composite_at(p, p.queue.z[k], p.queue.opacity[k], place, lines, lists, view)
                p.queue.z[k] = -wp.inf
                p.queue.place[k] = _NOTHING
        return p

    @wp.func
    def full(p: Pixel) -> bool:
        """Whether there is no room for another layer."""
        return p.queue.first.plane >= 0 and p.queue.second.plane >= 0

    @wp.func
    def drop_furthest(pixel: Pixel):
        """The pixel without the further of the layers that wait, and without what is behind it."""
        p = pixel
        far_z, far = depth(p.queue.first), int(p.queue.first.place)
        other_z, other = depth(p.queue.second), int(p.queue.second.place)
        if other_z > far_z or (other_z == far_z and other > far):
            far_z, far = other_z, other
        return drop_from(p, far_z, far)

    @wp.func
    def close(
        pixel: Pixel,
        nearest: float,
        lines: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        view: View,
    ):
        """The pixel whose open layer waits: nothing more comes of its plane."""
        p = pixel
        if p.queue.open.plane < 0:
            return p
        z, opacity, place = depth(p.queue.open), float(p.queue.open.opacity), int(p.queue.open.place)
        if is_taken(p, z, place):
            if full(p):
                p = composite_until(p, wp.min(nearest, z), lines, lists, view)
            if full(p) and z <= nearest:
                p = composite(p, shown(p.queue.open), opacity, view)
            else:
                if full(p):
                    p = drop_furthest(p)
                if is_taken(p, z, place):
                    room_at = int(_FIRST)
                    if p.queue.first.plane < 0:
                        p.queue.first = p.queue.open
                    else:
                        p.queue.second = p.queue.open
                        room_at = _SECOND
                    p = put(p, nearest, z, opacity, room_at, lines, lists, view)
        p.queue.open = nothing()
        return p

    @wp.func
    def end(
        pixel: Pixel,
        lines: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        view: View,
    ):
        """The pixel after the last splat of the list: all that waits is composited, and the next pass takes
        what was dropped, if anything was.
        """
        p = pixel
        if wp.static(layered):
            p = close(p, float(wp.inf), lines, lists, view)
        p = composite_until(p, float(wp.inf), lines, lists, view)
        p.queue.after_z = p.queue.until_z
        p.queue.after = p.queue.until
        p.queue.until_z = wp.inf
        p.queue.until = 0
        return p

    return SimpleNamespace(start=start, take=take, close=close, end=end)
