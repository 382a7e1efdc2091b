"""Scenes: splats, markers with poses, a camera, and the TOML files they are kept in."""

from fidsplat.scenes.parts import PlacedMarker
from fidsplat.scenes.scene import Scene

__all__ = ["PlacedMarker", "Scene"]
