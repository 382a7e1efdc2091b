"""Reference backend: NumPy in float64, each sample of the frame against each splat, without tiles.

It reads the same float32 inputs as the other backends and applies the same thresholds (docs/correctness.md).
In addition to the outputs it returns error bounds: upper bounds of the error of each pixel for rendering in
float32.
"""

from fidsplat.backends.reference.backend import ReferenceBackend, devices, open_device

__all__ = ["ReferenceBackend", "devices", "open_device"]
