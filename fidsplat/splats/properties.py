"""Interfaces of clouds, resident clouds and stores: the properties that select their kernels."""

from __future__ import annotations

from typing import Protocol

import numpy as np


class CloudProperties(Protocol):
    """Properties of a cloud that select kernels: SH degree, coplanar groups, boxes and 3D Gaussians."""

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics; -1 for RGB colours."""
        ...

    @property
    def has_coplanar_groups(self) -> bool:
        """Whether some splats belong to coplanar groups."""
        ...

    @property
    def footprint(self) -> str:
        """`gaussian`, `box`, or `mixed` for both kinds."""
        ...

    @property
    def ellipsoids(self) -> str:
        """Which splats are 3D Gaussians: `none`, `some` or `all`."""
        ...


class CloudLike(CloudProperties, Protocol):
    """A cloud, a resident cloud or a store: the properties that select its kernels, and its origin."""

    @property
    def origin(self) -> np.ndarray:
        """(3,) float64 metres: world position that means are relative to."""
        ...
