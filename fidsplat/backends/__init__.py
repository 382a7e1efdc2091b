"""Backends: things that open a device and draw splats on it. `registry` knows them by name."""

from fidsplat.backends.registry import devices, open_backend

__all__ = ["devices", "open_backend"]
