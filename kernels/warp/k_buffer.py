"""K-buffer: the fragments of a sample by their own depth, where the ray meets the splats.

Lists are sorted by the nearest depth that any fragment of a splat can have, as blending rounds it
(`nearest`). So no later fragment is nearer than the current splat, and buffered fragments nearer than that
are composited, by depth, ties in the order of the list. When the buffer is full the furthest fragment is
dropped, with all that is behind it (`until`), and another pass over the list composites what was dropped
(`after`), until nothing is. The image does not depend on the size of the buffer.
"""

from types import SimpleNamespace

import warp as wp

from .common import View, struct_of

_EMPTY = wp.constant(-1)
"""list place of an empty entry"""
_FIRST, _SECOND = wp.constant(-2), wp.constant(-3)
"""list places of buffered layers"""


def make_k_buffer_struct(layer: SimpleNamespace | None, size: int):
    """The struct KBuffer of a sample, with two layers if `layer` is given."""
    fields = {
        # sorted by depth, empty entries first
        "z": wp.types.vector(size, wp.float32),
        "opacity": wp.types.vector(size, wp.float32),
        "place": wp.types.vector(size, wp.int32),
        # range of this pass: depth, and list place of equal depths
        "after_z": wp.float32,
        "after": wp.int32,
        "until_z": wp.float32,
        "until": wp.int32,
    }
    # the open layer, and buffered ones
    fields |= dict.fromkeys(("open", "first", "second"), layer.Layer) if layer else {}
    return struct_of("KBuffer", "Buffered fragments of a sample.", fields)


def make_k_buffer(
    Pixel, composite, attributes_of, layer: SimpleNamespace | None, size: int
) -> SimpleNamespace:
    """start, of a Pixel with a `queue`; take, of a fragment; close, of the open layer; end, of the list.

    attributes_of (lines, index, z): attributes of a splat's fragment at that depth.
    """
    layered = layer is not None
    last = size - 1
    nothing, depth = (layer.nothing, layer.depth) if layer else (None, None)

    @wp.func
    def start(pixel: Pixel):
        p = pixel
        for k in range(wp.static(size)):
            p.k_buffer.z[k] = -wp.inf
            p.k_buffer.place[k] = _EMPTY
        p.k_buffer.after_z = -wp.inf
        p.k_buffer.until_z = wp.inf
        if wp.static(layered):
            p.k_buffer.open = nothing()
            p.k_buffer.first = nothing()
            p.k_buffer.second = nothing()
        return p

    @wp.func
    def without(pixel: Pixel, place: int):
        """Remove the layer of this place, if it is one."""
        p = pixel
        if wp.static(layered):
            if place == _FIRST:
                p.k_buffer.first = nothing()
            if place == _SECOND:
                p.k_buffer.second = nothing()
        return p

    @wp.func
    def attributes_at(
        p: Pixel, z: float, place: int, lines: wp.array(dtype=wp.vec4), lists: wp.array(dtype=wp.int32)
    ):
        """Attributes of a buffered fragment or layer."""
        if wp.static(layered):
            if place == _FIRST:
                return p.k_buffer.first.mean
            if place == _SECOND:
                return p.k_buffer.second.mean
        return attributes_of(lines, lists[place], z)

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
        """Composite a buffered fragment or layer."""
        p = pixel
        if place != _EMPTY:
            p = without(composite(p, attributes_at(p, z, place, lines, lists), opacity, view), place)
        return p

    @wp.func
    def list_place(p: Pixel, place: int) -> int:
        """List place, of a layer that of its first splat."""
        if wp.static(layered):
            if place == _FIRST:
                return p.k_buffer.first.place
            if place == _SECOND:
                return p.k_buffer.second.place
        return place

    @wp.func
    def drop_from(pixel: Pixel, z: float, place: int):
        """Drop entries at or behind this depth and list place, for the next pass."""
        p = pixel
        p.k_buffer.until_z = z
        p.k_buffer.until = place
        more = bool(True)
        while more:
            at = int(p.k_buffer.place[last])
            more = p.k_buffer.z[last] > z or (p.k_buffer.z[last] == z and list_place(p, at) >= place)
            if more:
                p = without(p, at)
                for k in range(wp.static(last)):
                    p.k_buffer.z[last - k] = p.k_buffer.z[last - k - 1]
                    p.k_buffer.opacity[last - k] = p.k_buffer.opacity[last - k - 1]
                    p.k_buffer.place[last - k] = p.k_buffer.place[last - k - 1]
                p.k_buffer.z[0] = -wp.inf
                p.k_buffer.place[0] = _EMPTY
        return p

    @wp.func
    def is_taken(p: Pixel, z: float, place: int) -> bool:
        """Whether a fragment belongs to this pass."""
        if z > p.k_buffer.until_z or (z == p.k_buffer.until_z and place >= p.k_buffer.until):
            return False
        return z > p.k_buffer.after_z or (z == p.k_buffer.after_z and place >= p.k_buffer.after)

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
        """Insert a fragment when none nearer than `nearest` can follow: composite the nearest entry, or if
        that is too early drop the furthest.
        """
        p = pixel
        if p.k_buffer.z[0] > nearest and z > nearest:
            if p.k_buffer.z[last] <= z:
                return without(drop_from(p, z, list_place(p, place)), place)
            p = drop_from(p, p.k_buffer.z[last], list_place(p, p.k_buffer.place[last]))
        first_z, first_opacity = float(p.k_buffer.z[0]), float(p.k_buffer.opacity[0])
        first_place = int(p.k_buffer.place[0])
        if z < first_z:
            return composite_at(p, z, opacity, place, lines, lists, view)
        for k in range(wp.static(last)):
            if p.k_buffer.z[k + 1] <= z:
                p.k_buffer.z[k] = p.k_buffer.z[k + 1]
                p.k_buffer.opacity[k] = p.k_buffer.opacity[k + 1]
                p.k_buffer.place[k] = p.k_buffer.place[k + 1]
            elif p.k_buffer.z[k] <= z:
                p.k_buffer.z[k] = z
                p.k_buffer.opacity[k] = opacity
                p.k_buffer.place[k] = place
        if p.k_buffer.z[last] <= z:
            p.k_buffer.z[last] = z
            p.k_buffer.opacity[last] = opacity
            p.k_buffer.place[last] = place
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
        """Insert a fragment of the splat at `place` in the list, whose fragments are beyond `nearest`."""
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
        """Composite all entries up to depth `nearest`."""
        p = pixel
        for k in range(wp.static(size)):
            place = int(p.k_buffer.place[k])
            if p.k_buffer.z[k] <= nearest and place != _EMPTY:
                p = composite_at(p, p.k_buffer.z[k], p.k_buffer.opacity[k], place, lines, lists, view)
                p.k_buffer.z[k] = -wp.inf
                p.k_buffer.place[k] = _EMPTY
        return p

    @wp.func
    def full(p: Pixel) -> bool:
        """Whether both layer entries are used."""
        return p.k_buffer.first.plane >= 0 and p.k_buffer.second.plane >= 0

    @wp.func
    def drop_furthest(pixel: Pixel):
        """Drop the further of the buffered layers, and all that is behind it."""
        p = pixel
        far_z, far = depth(p.k_buffer.first), int(p.k_buffer.first.place)
        other_z, other = depth(p.k_buffer.second), int(p.k_buffer.second.place)
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
        """Insert the open layer, which is complete."""
        p = pixel
        if p.k_buffer.open.plane < 0:
            return p
        z, opacity, place = depth(p.k_buffer.open), float(p.k_buffer.open.opacity), int(p.k_buffer.open.place)
        if is_taken(p, z, place):
            if full(p):
                p = composite_until(p, wp.min(nearest, z), lines, lists, view)
            if full(p) and z <= nearest:
                p = composite(p, p.k_buffer.open.mean, opacity, view)
            else:
                if full(p):
                    p = drop_furthest(p)
                if is_taken(p, z, place):
                    slot = int(_FIRST)
                    if p.k_buffer.first.plane < 0:
                        p.k_buffer.first = p.k_buffer.open
                    else:
                        p.k_buffer.second = p.k_buffer.open
                        slot = _SECOND
                    p = put(p, nearest, z, opacity, slot, lines, lists, view)
        p.k_buffer.open = nothing()
        return p

    @wp.func
    def end(
        pixel: Pixel,
        lines: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        view: View,
    ):
        """After the last splat of the list: composite all entries, and start the next pass."""
        p = pixel
        if wp.static(layered):
            p = close(p, float(wp.inf), lines, lists, view)
        p = composite_until(p, float(wp.inf), lines, lists, view)
        p.k_buffer.after_z = p.k_buffer.until_z
        p.k_buffer.after = p.k_buffer.until
        p.k_buffer.until_z = wp.inf
        p.k_buffer.until = 0
        return p

    return SimpleNamespace(start=start, take=take, close=close, end=end)
