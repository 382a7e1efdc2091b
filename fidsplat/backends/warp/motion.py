"""What the projection reads of groups of splats that move by themselves (kernels/warp/motion.py)."""

from __future__ import annotations

from typing import Any

import numpy as np

from fidsplat.backends.view import View
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
    poses = [(own.rotation, own.translation, own.eye) for _, own in view.groups]
    held.labels = resident.arrays["labels"]
    held.groups = pool.exact("groups", len(labels), wp.int32)
    held.poses = pool.exact("poses", len(labels), kernels.Pose)
    wp.copy(held.groups, wp.array(labels, dtype=wp.int32, device="cpu"))
    wp.copy(
        held.poses, wp.array(np.array(poses, kernels.Pose.numpy_dtype()), dtype=kernels.Pose, device="cpu")
    )
    return held
