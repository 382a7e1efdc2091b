"""Reference backend: NumPy in float64, each sample of the frame against each splat, without tiles.

It has the float32 inputs of other backends and makes the same decisions (docs/correctness.md). In addition to
the outputs it returns certificates: upper bounds of the error of each pixel for rendering in float32.
"""

from fidsplat.backends.reference.backend import ReferenceBackend, devices, open_device

__all__ = ["ReferenceBackend", "devices", "open_device"]
