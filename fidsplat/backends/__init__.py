"""Backends: implementations of the renderer for families of devices. `registry` opens a device by name."""

from fidsplat.backends.registry import devices, open_backend

__all__ = ["devices", "open_backend"]
