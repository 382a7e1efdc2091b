"""Splat files: PLY of the 2DGS and 3DGS layouts, and SuperSplat's compressed PLY (read only)."""

from fidsplat.formats.collect import Progress
from fidsplat.formats.ply import load_ply
from fidsplat.formats.ply_write import save_ply

__all__ = ["Progress", "load_ply", "save_ply"]
