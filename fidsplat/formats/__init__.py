"""Reading and writing of splat files (PLY, .splat, SPZ, glTF, OpenUSD, SOG) and trajectories (TUM, KITTI,
COLMAP, transforms.json)."""

from fidsplat.formats.files import load_splats, losses, save_splats
from fidsplat.formats.ply import load_ply, save_ply
from fidsplat.formats.trajectories import load_cameras, load_trajectory, save_trajectory
from fidsplat.util.progress import Progress

__all__ = [
    "Progress",
    "load_cameras",
    "load_ply",
    "load_splats",
    "load_trajectory",
    "losses",
    "save_ply",
    "save_splats",
    "save_trajectory",
]
