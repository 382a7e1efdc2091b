"""Moving groups of splats: a label selects the group of a splat, and each group has a pose."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .common import struct_of


@wp.struct
class Pose:
    """Camera pose relative to one group of splats."""

    rotation: wp.mat33d  # group to camera
    translation: wp.vec3d  # position of the cloud's origin in the camera frame [m]
    eye: wp.vec3d  # camera centre relative to the cloud's origin, in the axes of the group [m]


@cache
def make_motion(moves: bool) -> SimpleNamespace:
    """Make the struct Moving, empty without motion, and group_of(moving, i): the group of a splat, -1 for
    none."""
    fields = {
        "labels": wp.array(dtype=wp.int32),  # (n)
        "groups": wp.array(dtype=wp.int32),  # (groups) label of each group
        "poses": wp.array(dtype=Pose),  # (views groups)
    }
    Moving = struct_of("Moving", "Moving groups and their poses.", fields if moves else {})

    @wp.func
    def group_of(moving: Moving, i: int) -> int:
        found = int(-1)
        for group in range(moving.groups.shape[0]):
            if moving.groups[group] == moving.labels[i]:
                found = group
        return found

    return SimpleNamespace(Moving=Moving, group_of=group_of)
