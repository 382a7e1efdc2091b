"""The Warp backend: every stage as NVIDIA Warp kernels (kernels/warp), on the CPU and on CUDA GPUs.

Nothing here imports warp until a device is asked for.
"""

from fidsplat.backends.warp.device import devices, open_device

__all__ = ["devices", "open_device"]
