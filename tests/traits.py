"""A cloud of which nothing is known but what decides the features of its image."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Traits:
    """In place of a SplatCloud, for `select`."""

    sh_degree: int = -1
    has_coplanar_groups: bool = False
    footprint: str = "gaussian"
    ellipsoids: str = "none"
