"""The Warp backend: every stage as NVIDIA Warp kernels (kernels/warp), on the CPU and on CUDA GPUs."""

from fidsplat.backends.warp.device import devices, open_device

__all__ = ["devices", "open_device"]
