"""What the projection reads of groups of splats that move by themselves (kernels/warp/motion.py)."""

from __future__ import annotations

from typing import Any

import numpy as np

from fidsplat.backends.base import View
from fidsplat.backends.warp import runtime
from fidsplat.backends.warp.memory import ArrayPool, Resident


def moving(resident: Resident, view: View, pool: ArrayPool) -> Any:
    """The struct `Moving` of a picture; an empty one if nothing moves."""
    import warp as wp

    kernels = runtime.kernels("motion")
    held = kernels.make_motion(bool(view.groups)).Moving()
    if not view.groups:
        return held
    labels = np.array([label for label, _ in view.groups], np.int32)
    poses = np.zeros(len(labels), kernels.Pose.numpy_dtype())
    for pose, (_, own) in zip(poses, view.groups, strict=True):
        pose["rotation"], pose["translation"], pose["eye"] = own.rotation, own.translation, own.eye
    held.labels = resident.arrays["labels"]
    held.groups = pool.exact("groups", len(labels), wp.int32)
    held.poses = pool.exact("poses", len(labels), kernels.Pose)
    wp.copy(held.groups, wp.array(labels, dtype=wp.int32, device="cpu"))
    wp.copy(held.poses, wp.array(poses, dtype=kernels.Pose, device="cpu"))
    return held
