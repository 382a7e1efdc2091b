"""Localisation of a camera in a scene: initial pose, and refinement by direct image alignment."""

from fidsplat.localisation.localise import Localisation, localise

__all__ = ["Localisation", "localise"]
