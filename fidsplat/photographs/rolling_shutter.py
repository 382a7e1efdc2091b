"""Detection of a rolling shutter: whether motion of the camera while rows are read out explains the features'
reprojection errors."""

from __future__ import annotations

import numpy as np

from fidsplat.photographs.mapping import Model
from fidsplat.vision.fisher_information import pose_jacobian

MIN_FEATURES = 30
"""features of a photograph for an estimate"""
MIN_SHARE, MIN_DISPLACEMENT = 0.02, 0.15
"""share of the errors' squares, and pixels, from which on a rolling shutter is reported"""


def readout_motion(model: Model) -> tuple[float, float]:
    """Share of the squared reprojection errors, beyond chance, that a constant motion of each camera during
    the readout of its rows explains; and the displacement from the first row to the last that it causes, the
    median over the photographs in pixels.

    A motion that is the same in all photographs is part of COLMAP's model, and is not found.
    """
    before = after = by_chance = 0.0
    displacements = []
    for camera, track, pixels in zip(model.cameras, model.tracks, model.pixels, strict=True):
        points = model.points[track]
        errors = pixels - camera.project(points)
        usable = np.isfinite(errors).all(1)
        if usable.sum() < MIN_FEATURES:
            continue
        errors = errors[usable]
        by_pose = np.nan_to_num(pose_jacobian(camera, points[usable]))
        times = pixels[usable, 1] / camera.height - 0.5
        flat, wanted = (by_pose * times[:, None, None]).reshape(-1, 6), errors.ravel()
        size = np.linalg.norm(flat, axis=0)  # columns of similar size
        motion = np.linalg.lstsq(flat / size, wanted, rcond=1e-6)[0] / size
        left = wanted - flat @ motion
        before, after = before + wanted @ wanted, after + left @ left
        by_chance += 6 / len(wanted) * (wanted @ wanted)
        moved = by_pose @ motion
        displacements.append(float(np.median(np.linalg.norm(moved, axis=1))))
    if not displacements or before == 0:
        return 0.0, 0.0
    return max(0.0, float(before - after - by_chance) / float(before)), float(np.median(displacements))
