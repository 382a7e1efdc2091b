"""Rays of samples, computed from the view or read from the buffer of a lens, and the external depth image."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .common import View, fma, struct_of

RAY_DERIVATIVES = wp.types.matrix((2, 3), wp.float32)
"""derivatives of a ray with respect to the sample's column, and to its row"""


@cache
def struct_of_rays(has_lens: bool, has_ray_derivatives: bool = False, has_external_depth: bool = False):
    """Make the struct Rays: with the rays of a lens, their derivatives, and an external depth image, if
    requested.
    """
    fields = {}
    if has_lens:  # X, Y, Z of each sample, row by row; NaN outside of the field of view
        fields |= {"rays": wp.array(dtype=wp.vec3)}
        fields |= {"ray_derivatives": wp.array(dtype=RAY_DERIVATIVES)} if has_ray_derivatives else {}
    if has_external_depth:  # of each pixel, one image or one per view; depth is infinite without a surface
        fields |= {"external_depth": wp.array(dtype=wp.float32), "external_rgb": wp.array(dtype=wp.vec3)}
    return struct_of("Rays", "The samples' rays, and an external depth image.", fields)


@cache
def make_rays(
    has_lens: bool,
    has_ray_lengths: bool = False,
    has_ray_derivatives: bool = False,
    has_external_depth: bool = False,
) -> SimpleNamespace:
    """Make the struct Rays of samples and its functions.

    ray_of(column, row, rays, view): the ray, NaN outside of the field of view. length_of(column, row, rays,
    view): the factor from depths to distances, 1 outside of the field of view.

    has_lens: read rays from the buffer of a lens. has_ray_lengths: read their lengths too; otherwise from
    the view. Others: see `struct_of_rays`.
    """
    Rays = struct_of_rays(has_lens, has_ray_derivatives, has_external_depth)

    @wp.func
    def ray_in(column: int, row: int, view: View) -> wp.vec3:
        """Ray of a sample with length 1 along z; (0, 0, 1) for parallel rays, or if depths are distances."""
        ray = view.ray
        return wp.vec3((float(column) + 0.5 - ray[2]) / ray[0], (float(row) + 0.5 - ray[3]) / ray[1], 1.0)

    @wp.func
    def ray_of(column: int, row: int, rays: Rays, view: View) -> wp.vec3:
        if wp.static(has_lens):
            return rays.rays[row * view.width + column]
        else:
            return ray_in(column, row, view)

    @wp.func
    def per_depth(ray: wp.vec3) -> float:
        """Length of a ray with Z = 1."""
        return wp.sqrt(fma(ray[0], ray[0], fma(ray[1], ray[1], 1.0)))

    @wp.func
    def length_of(column: int, row: int, rays: Rays, view: View) -> float:
        if wp.static(has_ray_lengths):
            length = float(1.0)
            # tiles extend beyond the image
            if column < view.width and row < view.height:
                own = per_depth(ray_of(column, row, rays, view))
                if own == own:
                    length = own
            return length
        else:
            return per_depth(ray_in(column, row, view))

    return SimpleNamespace(Rays=Rays, ray_of=ray_of, length_of=length_of)
