"""Cameras: plain data, float64, OpenCV axes (x right, y down, z forward)."""

from fidsplat.cameras.lenses import BrownConrady, Equirectangular, Fisheye, Lens, Orthographic, RayTable
from fidsplat.cameras.motion import Motion, Shutter
from fidsplat.cameras.pinhole import Camera, fisheye_focal_length, focal_length, look_at_matrix
from fidsplat.cameras.trajectory import Trajectory

__all__ = [
    "BrownConrady",
    "Camera",
    "Equirectangular",
    "Fisheye",
    "Lens",
    "Motion",
    "Orthographic",
    "RayTable",
    "Shutter",
    "Trajectory",
    "fisheye_focal_length",
    "focal_length",
    "look_at_matrix",
]
