"""Files of splats, and of trajectories: PLY of the 2DGS and 3DGS layouts, SuperSplat's compressed PLY (read
only); TUM, KITTI, COLMAP and transforms.json."""

from fidsplat.formats.collect import Progress
from fidsplat.formats.ply import load_ply
from fidsplat.formats.ply_write import save_ply
from fidsplat.formats.trajectories import load_trajectory, save_trajectory

__all__ = ["Progress", "load_ply", "load_trajectory", "save_ply", "save_trajectory"]
