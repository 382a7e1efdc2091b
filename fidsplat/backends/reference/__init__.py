"""Reference backend: NumPy in float64, each sample of the frame against each splat, without tiles.

It starts from the same float32 inputs as other backends and makes the same decisions (docs/correctness.md).
In addition to the outputs it returns certificates: upper bounds of the difference that decisions and rounding
in float32 cause in each pixel.
"""

from fidsplat.backends.reference.backend import ReferenceBackend, devices, open_device

__all__ = ["ReferenceBackend", "devices", "open_device"]
