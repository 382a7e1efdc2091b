"""Reading pictures: image files, tag dictionaries, detectors, poses; alone in importing cv2, zxingcpp."""

import os

# OpenCV takes its limit when it is loaded, and its own of 2^30 lets a file of a megabyte become 12 GB. Twice
# the largest panorama is enough for any camera.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**28))


def __getattr__(name: str):
    if name != "read_back":
        raise AttributeError(f"module 'fidsplat.vision' has no attribute {name!r}")
    from importlib import import_module

    return import_module("fidsplat.vision.readback").read_back
