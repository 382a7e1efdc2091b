"""The Warp backend: every stage as NVIDIA Warp kernels (kernels/warp), on the CPU and on CUDA GPUs.

Warp is imported when a device is first requested.
"""

from fidsplat.backends.warp.device import devices, open_device

__all__ = ["devices", "open_device"]
