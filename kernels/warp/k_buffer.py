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
        "alpha": wp.types.vector(size, wp.float32),
        "position": wp.types.vector(size, wp.int32),
        # range of this pass: depths, and list positions for equal depths
        "after_z": wp.float32,
        "after": wp.int32,
        "until_z": wp.float32,
        "until": wp.int32,
    }
    return struct_of("KBuffer", "Buffered fragments of a sample.", fields)


def make_k_buffer(Pixel, composite, attributes_of, size: int) -> SimpleNamespace:
    """Make functions of a Pixel with a `k_buffer`: start; insert, for a fragment; end, after the list.

    attributes_of(records, index, z): attributes of a splat's fragment at depth z.
    """
    last = size - 1

    @wp.func
    def start(pixel: Pixel):
        p = pixel
        for k in range(wp.static(size)):
            p.k_buffer.z[k] = -wp.inf
            p.k_buffer.position[k] = _EMPTY
        p.k_buffer.after_z = -wp.inf
        p.k_buffer.until_z = wp.inf
        return p

    @wp.func
    def composite_at(
        pixel: Pixel,
        z: float,
        alpha: float,
        position: int,
        records: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        view: View,
    ):
        """Composite a buffered fragment."""
        p = pixel
        if position != _EMPTY:
            p = composite(p, attributes_of(records, lists[position], z), alpha, view)
        return p

    @wp.func
    def drop_from(pixel: Pixel, z: float, position: int):
        """Drop entries at or behind a depth and list position, for the next pass."""
        p = pixel
        p.k_buffer.until_z = z
        p.k_buffer.until = position
        more = bool(True)
        while more:
            more = p.k_buffer.z[last] > z or (
                p.k_buffer.z[last] == z and p.k_buffer.position[last] >= position
            )
            if more:
                for k in range(wp.static(last)):
                    p.k_buffer.z[last - k] = p.k_buffer.z[last - k - 1]
                    p.k_buffer.alpha[last - k] = p.k_buffer.alpha[last - k - 1]
                    p.k_buffer.position[last - k] = p.k_buffer.position[last - k - 1]
                p.k_buffer.z[0] = -wp.inf
                p.k_buffer.position[0] = _EMPTY
        return p

    @wp.func
    def in_this_pass(p: Pixel, z: float, position: int) -> bool:
        """Whether a fragment belongs to this pass."""
        if z > p.k_buffer.until_z or (z == p.k_buffer.until_z and position >= p.k_buffer.until):
            return False
        return z > p.k_buffer.after_z or (z == p.k_buffer.after_z and position >= p.k_buffer.after)

    @wp.func
    def insert_sorted(
        pixel: Pixel,
        nearest: float,
        z: float,
        alpha: float,
        position: int,
        records: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        view: View,
    ):
        """Insert a fragment if no later fragment is nearer than `nearest`: composite the nearest entry, or
        drop the farthest entry if the nearest is behind `nearest`.
        """
        p = pixel
        if p.k_buffer.z[0] > nearest and z > nearest:
            if p.k_buffer.z[last] <= z:
                return drop_from(p, z, position)
            p = drop_from(p, p.k_buffer.z[last], int(p.k_buffer.position[last]))
        first_z, first_alpha = float(p.k_buffer.z[0]), float(p.k_buffer.alpha[0])
        first_position = int(p.k_buffer.position[0])
        if z < first_z:
            return composite_at(p, z, alpha, position, records, lists, view)
        for k in range(wp.static(last)):
            if p.k_buffer.z[k + 1] <= z:
                p.k_buffer.z[k] = p.k_buffer.z[k + 1]
                p.k_buffer.alpha[k] = p.k_buffer.alpha[k + 1]
                p.k_buffer.position[k] = p.k_buffer.position[k + 1]
            elif p.k_buffer.z[k] <= z:
                p.k_buffer.z[k] = z
                p.k_buffer.alpha[k] = alpha
                p.k_buffer.position[k] = position
        if p.k_buffer.z[last] <= z:
            p.k_buffer.z[last] = z
            p.k_buffer.alpha[last] = alpha
            p.k_buffer.position[last] = position
        return composite_at(p, first_z, first_alpha, first_position, records, lists, view)

    @wp.func
    def insert(
        pixel: Pixel,
        nearest: float,
        z: float,
        alpha: float,
        position: int,
        records: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        view: View,
    ):
        """Insert a fragment of the splat at `position` in the list, whose fragments are beyond `nearest`."""
        if in_this_pass(pixel, z, position):
            return insert_sorted(pixel, nearest, z, alpha, position, records, lists, view)
        return pixel

    @wp.func
    def composite_until(
        pixel: Pixel,
        nearest: float,
        records: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        view: View,
    ):
        """Composite all entries up to depth `nearest`."""
        p = pixel
        for k in range(wp.static(size)):
            position = int(p.k_buffer.position[k])
            if p.k_buffer.z[k] <= nearest and position != _EMPTY:
                p = composite_at(p, p.k_buffer.z[k], p.k_buffer.alpha[k], position, records, lists, view)
                p.k_buffer.z[k] = -wp.inf
                p.k_buffer.position[k] = _EMPTY
        return p

    @wp.func
    def end(
        pixel: Pixel,
        records: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        view: View,
    ):
        """Composite all entries after the last splat of the list, and start the next pass."""
        p = composite_until(pixel, float(wp.inf), records, lists, view)
        p.k_buffer.after_z = p.k_buffer.until_z
        p.k_buffer.after = p.k_buffer.until
        p.k_buffer.until_z = wp.inf
        p.k_buffer.until = 0
        return p

    return SimpleNamespace(start=start, insert=insert, end=end)
