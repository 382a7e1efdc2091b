"""Properties of a cloud that select kernels, without splats."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CloudProperties:
    """In place of a SplatCloud, for `select`."""

    sh_degree: int = -1
    has_coplanar_groups: bool = False
    footprint: str = "gaussian"
    ellipsoids: str = "none"
