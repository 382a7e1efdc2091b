"""Marker detection, pose estimation, ground truth and error metrics."""

import fidsplat.images  # noqa: F401  sets OpenCV's limits before cv2 is loaded


def __getattr__(name: str):
    if name != "read_back":
        raise AttributeError(f"module 'fidsplat.vision' has no attribute {name!r}")
    from importlib import import_module

    return import_module("fidsplat.vision.readback").read_back
