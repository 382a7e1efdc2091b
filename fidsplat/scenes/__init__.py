"""Scenes: splats, markers with poses and a camera, and their TOML files."""

from fidsplat.scenes.parts import PlacedMarker
from fidsplat.scenes.scene import Scene

__all__ = ["PlacedMarker", "Scene"]
