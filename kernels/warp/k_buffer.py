"""K-buffer: sorts the fragments of a sample by their depth at the ray.

Lists are sorted by a lower bound of the fragment depths of each splat (`nearest`), rounded as in blending. No
later fragment is nearer than `nearest` of the current splat, so that buffered fragments in front of it are
composited by depth, ties in list order. When the buffer is full, the farthest fragment and all fragments
behind it (`until`) are dropped, and another pass over the list composites them (`after`), until no fragment
is dropped. The image does not depend on the size of the buffer.
"""

from types import SimpleNamespace

import warp as wp

from .common import View, struct_of

_EMPTY = wp.constant(-1)
"""list position of an empty entry"""


def make_k_buffer_struct(size: int):
    """The struct KBuffer of a sample."""
    fields = {
        # sorted by depth, empty entries first
        "z": wp.types.vector(size, wp.float32),
        "opacity": wp.types.vector(size, wp.float32),
        "place": wp.types.vector(size, wp.int32),
        # range of this pass: depths, and list positions for equal depths
        "after_z": wp.float32,
        "after": wp.int32,
        "until_z": wp.float32,
        "until": wp.int32,
    }
    return struct_of("KBuffer", "Buffered fragments of a sample.", fields)


def make_k_buffer(Pixel, composite, attributes_of, size: int) -> SimpleNamespace:
    """Make functions of a Pixel with a `k_buffer`: start; take, for a fragment; end, for the end of the list.

    attributes_of(lines, index, z): attributes of a splat's fragment at depth z.
    """
    last = size - 1

    @wp.func
    def start(pixel: Pixel):
        p = pixel
        for k in range(wp.static(size)):
            p.k_buffer.z[k] = -wp.inf
            p.k_buffer.place[k] = _EMPTY
        p.k_buffer.after_z = -wp.inf
        p.k_buffer.until_z = wp.inf
        return p

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
        """Composite a buffered fragment."""
        p = pixel
        if place != _EMPTY:
            p = composite(p, attributes_of(lines, lists[place], z), opacity, view)
        return p

    @wp.func
    def drop_from(pixel: Pixel, z: float, place: int):
        """Drop entries at or behind a depth and list position, for the next pass."""
        p = pixel
        p.k_buffer.until_z = z
        p.k_buffer.until = place
        more = bool(True)
        while more:
            more = p.k_buffer.z[last] > z or (p.k_buffer.z[last] == z and p.k_buffer.place[last] >= place)
            if more:
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
        """Insert a fragment if no later fragment is nearer than `nearest`: composite the nearest entry, or
        drop the farthest entry if the nearest is behind `nearest`.
        """
        p = pixel
        if p.k_buffer.z[0] > nearest and z > nearest:
            if p.k_buffer.z[last] <= z:
                return drop_from(p, z, place)
            p = drop_from(p, p.k_buffer.z[last], int(p.k_buffer.place[last]))
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
    def end(
        pixel: Pixel,
        lines: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        view: View,
    ):
        """Composite all entries after the last splat of the list, and start the next pass."""
        p = composite_until(pixel, float(wp.inf), lines, lists, view)
        p.k_buffer.after_z = p.k_buffer.until_z
        p.k_buffer.after = p.k_buffer.until
        p.k_buffer.until_z = wp.inf
        p.k_buffer.until = 0
        return p

    return SimpleNamespace(start=start, take=take, end=end)
