"""Scenes: splats, markers with poses, a camera, and the TOML files they are kept in."""

from fidsplat.scenes.scene import PlacedMarker, Scene

__all__ = ["PlacedMarker", "Scene"]
