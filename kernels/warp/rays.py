"""What a sample reads of its place in the picture: its ray, which follows from the view, or which a lens
gives each sample, and what a layer of another renderer has there."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .common import View, struct_of

SLOPES = wp.types.matrix((2, 3), wp.float32)
"""a ray's derivatives by the sample's column, and by its row"""


@cache
def struct_of_rays(bent: bool, sloped: bool = False, opaque: bool = False):
    """The struct of what a sample reads: nothing, if all rays follow from the view; with their derivatives,
    if `sloped`; with a layer, if `opaque`.
    """
    fields = {}
    if bent:  # X, Y, Z along the rows of samples; NaN where nothing is seen
        fields |= {"rays": wp.array(dtype=wp.vec3)}
        fields |= {"slopes": wp.array(dtype=SLOPES)} if sloped else {}
    if opaque:  # of each pixel, row by row; a depth that is infinite where there is none
        fields |= {"external_depth": wp.array(dtype=wp.float32), "external_rgb": wp.array(dtype=wp.vec3)}
    return struct_of("Rays", "The samples' rays, and a layer.", fields)


@cache
def make_rays(
    bent: bool, stretched: bool = False, sloped: bool = False, opaque: bool = False
) -> SimpleNamespace:
    """Rays; ray_of(column, row, rays, view), NaN where nothing is seen; length_of(column, row, rays, view),
    what turns depths there into distances, 1 where nothing is seen.

    bent: rays are a lens's own. stretched: so are their lengths; else they follow from the view. sloped: Rays
    has the rays' derivatives too. opaque: and a layer.
    """
    Rays = struct_of_rays(bent, sloped, opaque)

    @wp.func
    def ray_in(column: int, row: int, view: View) -> wp.vec3:
        """Of a length of 1 along z; straight ahead where all are parallel, or depths are distances."""
        ray = view.ray
        return wp.vec3((float(column) + 0.5 - ray[2]) * ray[0], (float(row) + 0.5 - ray[3]) * ray[1], 1.0)

    @wp.func
    def ray_of(column: int, row: int, rays: Rays, view: View) -> wp.vec3:
        if wp.static(bent):
            return rays.rays[row * view.width + column]
        else:
            return ray_in(column, row, view)

    @wp.func
    def length_of(column: int, row: int, rays: Rays, view: View) -> float:
        if wp.static(stretched):
            length = float(1.0)
            # a tile has samples beyond the picture too
            if column < view.width and row < view.height:
                own = wp.length(ray_of(column, row, rays, view))
                if own == own:
                    length = own
            return length
        else:
            return wp.length(ray_in(column, row, view))

    return SimpleNamespace(Rays=Rays, ray_of=ray_of, length_of=length_of)
