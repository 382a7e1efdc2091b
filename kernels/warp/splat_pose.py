"""Pose, tangents and depth range of a splat in the frame of the camera."""

import math
from functools import cache
from types import SimpleNamespace

import warp as wp

from .common import View
from .motion import make_motion
from .records import BOXES


@cache
def make_splat_pose(effects: tuple[str, ...], real) -> SimpleNamespace:
    """Make pose, tangents, depth_range, and the struct Moving of moving groups."""
    moves, k_buffered, layers = (
        name in effects for name in ("motion_groups", "order_pixel", "order_coplanar")
    )
    has_lowpass_disc = "lowpass_screen" in effects
    boxes_too = any(name in effects for name in BOXES)
    vec3, mat33 = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    half, one, two = real(0.5), real(1.0), real(2.0)
    range_radius, plane_radius = real(math.sqrt(2.0 * math.log(255.0))), real(64.0)
    motion = make_motion(moves)
    Moving = motion.Moving

    @wp.func
    def pose(i: int, number: int, view: View, moving: Moving):
        """Rotation and translation of splat i to the camera, and the camera's centre relative to the cloud's
        origin, in view `number`.
        """
        rotation, translation, eye = mat33(view.rotation), vec3(view.translation), vec3(view.eye)
        if wp.static(moves):
            group = motion.group_of(moving, i)
            if group >= 0:
                own = moving.poses[number * moving.groups.shape[0] + group]
                rotation, translation, eye = mat33(own.rotation), vec3(own.translation), vec3(own.eye)
        return rotation, translation, eye

    @wp.func
    def tangents(rotation: mat33, q: wp.vec4):
        """First two columns of the rotation of a quaternion of any length, multiplied by `rotation`."""
        w, x, y, z = real(q[0]), real(q[1]), real(q[2]), real(q[3])
        s = two / (w * w + x * x + y * y + z * z)
        tangent_u = rotation * vec3(one - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y))
        tangent_v = rotation * vec3(s * (x * y - w * z), one - s * (x * x + z * z), s * (y * z + w * x))
        return tangent_u, tangent_v

    @wp.func
    def depth_range(depth: real, reach: real, radius: real, near: real, coplanar_group: int, boxed: bool):
        """Middle and half of the depth range of a splat's fragments. reach: half of the range within the
        cut-off. coplanar_group: -1 for none."""
        middle, half_range = depth, reach
        if wp.static(has_lowpass_disc):
            # the low-pass disc, which does not depend on the cut-off
            if not boxed:
                half_range = reach * wp.max(one, range_radius / radius)
        if wp.static(k_buffered):
            # depths of fragments below 1/255 of the splat's opacity are clamped, so that the order does not
            # depend on the cut-off
            half_range = reach * (range_radius / radius)
            if wp.static(boxes_too):
                if boxed:
                    half_range = reach
        if wp.static(layers):
            # the plane within a radius larger than every cut-off and low-pass
            if coplanar_group >= 0:
                half_range = reach * (plane_radius / radius)
                if wp.static(boxes_too):
                    if boxed:
                        half_range = reach * plane_radius
        if depth < near:
            # fragments are beyond `near`
            furthest = wp.max(near, depth + half_range)
            middle, half_range = half * (furthest + near), half * (furthest - near)
        return middle, half_range

    return SimpleNamespace(Moving=Moving, pose=pose, tangents=tangents, depth_range=depth_range)
