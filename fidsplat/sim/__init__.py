"""Rendering for simulators: splats, markers and cameras attached to bodies, in many environments at once.

`fidsplat.sim.mujoco` and `fidsplat.sim.gymnasium` need `pip install 'fidsplat[sim]'`.
"""

from fidsplat.sim.description import Description, read_description
from fidsplat.sim.rig import Rig, RigCamera, RigImages

__all__ = ["Description", "Rig", "RigCamera", "RigImages", "read_description"]
