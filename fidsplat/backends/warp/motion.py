"""What the projection reads of groups of splats that move by themselves (kernels/warp/motion.py)."""

from __future__ import annotations

from typing import Any

import numpy as np

from fidsplat.backends.view import View
from fidsplat.backends.warp.resident import Resident
from fidsplat.backends.warp.runtime import kernels, load
from fidsplat.backends.warp.workspace import ArrayPool


def moving_of(resident: Resident, view: View, pool: ArrayPool) -> Any:
    """The struct `Moving` of a picture; an empty one if nothing moves."""
    declared = kernels("motion")
    held = declared.make_motion(bool(view.groups)).Moving()
    if view.groups:
        labels = np.array([label for label, _ in view.groups], np.int32)
        poses = [(own.rotation, own.translation, own.eye) for _, own in view.groups]
        held.labels = resident.arrays["labels"]
        held.groups = pool.filled("groups", labels, load().int32)
        held.poses = pool.filled("poses", np.array(poses, declared.Pose.numpy_dtype()), declared.Pose)
    return held
