"""Cameras: plain data, float64, OpenCV axes (x right, y down, z forward)."""

from fidsplat.cameras.pinhole import Camera, focal_length, look_at_matrix

__all__ = ["Camera", "focal_length", "look_at_matrix"]
