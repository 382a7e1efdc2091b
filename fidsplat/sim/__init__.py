"""Cameras for simulators: splats, markers and cameras that hang on bodies, in many environments at once.

`fidsplat.sim.mujoco` and `fidsplat.sim.gymnasium` need `pip install 'fidsplat[sim]'`.
"""

from fidsplat.sim.description import Description, read_description
from fidsplat.sim.rig import Pictures, Rig, RigCamera

__all__ = ["Description", "Pictures", "Rig", "RigCamera", "read_description"]
