"""The OpenCL backend: every stage in kernels (kernels/opencl), on any CPU or GPU that has a driver."""

from fidsplat.backends.opencl.backend import devices, open_device

__all__ = ["devices", "open_device"]
