"""A cloud without splats that has only the traits by which features are selected."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Traits:
    """In place of a SplatCloud, for `select`."""

    sh_degree: int = -1
    has_coplanar_groups: bool = False
    footprint: str = "gaussian"
    ellipsoids: str = "none"
