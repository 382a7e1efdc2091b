"""Workarounds for faults of PoCL; README.md says which versions need which."""

import pyopencl as cl


def is_pocl(device: cl.Device) -> bool:
    """Whether PoCL drives a device."""
    return "Portable Computing Language" in device.platform.name
