"""What the other backends are compared with: NumPy in float64, every sample of the picture against every
splat, no tiles, no boxes.

It starts from the same float32 inputs and takes the same decisions (docs/correctness.md). Beside the
outputs it gives certificates: how much a pixel may differ because single precision may decide or round
otherwise.
"""

from fidsplat.backends.reference.backend import ReferenceBackend, devices, open_device

__all__ = ["ReferenceBackend", "devices", "open_device"]
