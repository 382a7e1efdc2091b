"""Backends: implementations of the renderer for a kind of device. `registry` opens a device by its name."""

from fidsplat.backends.registry import devices, open_backend

__all__ = ["devices", "open_backend"]
