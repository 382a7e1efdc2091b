"""Rendering for simulators: splats, markers and cameras on bodies, in batches of environments.

`fidsplat.sim.mujoco` and `fidsplat.sim.gymnasium` need `pip install 'fidsplat[sim]'`.
"""

from fidsplat.sim.description import Description, read_description
from fidsplat.sim.rig import Rig, RigCamera, RigImages

__all__ = ["Description", "Rig", "RigCamera", "RigImages", "read_description"]
