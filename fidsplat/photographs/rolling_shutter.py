"""Rolling-shutter detection: tests whether camera motion during the readout explains the features'
reprojection errors."""

from __future__ import annotations

import numpy as np

from fidsplat.photographs.mapping import Model
from fidsplat.vision.fisher_information import pose_jacobian

MIN_FEATURES = 30
"""features of a photograph for an estimate"""
MIN_FRACTION, MIN_DISPLACEMENT = 0.008, 0.15
"""minimum fraction of the squared errors, and displacement in pixels, to report a rolling shutter"""


def readout_motion(model: Model) -> tuple[float, float]:
    """Estimate a constant motion of each camera during the readout. Returns the fraction of the squared
    reprojection errors that it explains beyond chance by three standard deviations, and its displacement
    between the first and the last row [px], the median over the photographs.

    A motion that is equal in all photographs is part of COLMAP's model, and is not detected.
    """
    before = after = by_chance = variance = 0.0
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
        energy = wanted @ wanted / len(wanted)
        by_chance, variance = by_chance + 6 * energy, variance + 12 * energy**2
        moved = by_pose @ motion
        displacements.append(float(np.median(np.linalg.norm(moved, axis=1))))
    if not displacements or before == 0:
        return 0.0, 0.0
    explained = float(before - after - by_chance) - 3 * float(variance) ** 0.5
    return max(0.0, explained / float(before)), float(np.median(displacements))
