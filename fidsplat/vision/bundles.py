"""Bundles of markers on a rigid body: one pose from all their detections."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.vision.pose import points_pose, pose_error
from fidsplat.vision.readback import Reading


@dataclass(frozen=True, eq=False)
class BundleReading:
    """True and estimated pose of a bundle of markers. Its frame is the frame of its first marker in the
    scene."""

    name: str
    markers: int
    found: int
    """number of detected markers"""
    truth: np.ndarray
    """(4, 4) true camera_from_bundle"""
    pose: np.ndarray | None = None
    """(4, 4) camera_from_bundle estimated from the corners of all detected markers; None without any"""
    position_error: float | None = None
    """metres"""
    angle_error: float | None = None
    """radians"""

    @property
    def distance(self) -> float:
        """Distance from the camera in metres."""
        return float(np.linalg.norm(self.truth[:3, 3]))

    def as_dict(self) -> dict[str, Any]:
        """Values for JSON, in millimetres and degrees; None without a detection."""
        return {
            "bundle": self.name,
            "markers": self.markers,
            "found": self.found,
            "distance_m": self.distance,
            "position_error_mm": None if self.position_error is None else self.position_error * 1e3,
            "angle_error_deg": None if self.angle_error is None else math.degrees(self.angle_error),
            "camera_from_bundle": None if self.pose is None else self.pose.tolist(),
        }


def read_bundles(readings: Iterable[Reading], camera: Camera) -> list[BundleReading]:
    """Estimate the poses of a scene's bundles (`PlacedMarker.bundle`) from readings of one image.

    camera: intrinsics and lens of the image.
    """
    members: dict[str, list[Reading]] = {}
    for reading in readings:
        if reading.placed.bundle is not None:
            members.setdefault(reading.placed.bundle, []).append(reading)
    return [_read(name, tags, camera) for name, tags in members.items()]


def _read(name: str, readings: list[Reading], camera: Camera) -> BundleReading:
    first = np.linalg.inv(readings[0].placed.pose)
    pairs = [(reading.placed.corners, reading.detection) for reading in readings]
    points = [at @ first[:3, :3].T + first[:3, 3] for at, code in pairs if code is not None]
    corners = [code.corners for _, code in pairs if code is not None]
    facts = name, len(readings), len(corners), readings[0].truth
    pose = points_pose(np.concatenate(points), np.concatenate(corners), camera) if corners else None
    if pose is None or not np.isfinite(pose).all():
        return BundleReading(*facts)
    return BundleReading(*facts, pose, *pose_error(pose, readings[0].truth))
