"""Partial clouds: a subset of a scene's splats, with the kernels of the complete scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from fidsplat.splats.arrays import OPTIONAL
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import rotation_of_coefficients
from fidsplat.splats.properties import CloudLike
from fidsplat.splats.rotations import matrix_to_quaternion, quaternion_multiply


class PartialCloud(SplatCloud):
    """A subset of a scene's splats in its order, rendered by the kernels of the complete scene."""

    _scene: CloudLike

    @classmethod
    def of(
        cls, arrays: Mapping[str, np.ndarray], scene: CloudLike, dropped: Mapping[str, int] | None = None
    ) -> PartialCloud:
        """A cloud of valid arrays, without a copy. dropped: number of omitted splats by the reason."""
        part = object.__new__(cls)
        part._set(**dict.fromkeys(OPTIONAL) | dict(arrays), origin=scene.origin, dropped=dict(dropped or {}))
        object.__setattr__(part, "_scene", scene)
        return part

    def __reduce__(self):
        """Pickle and copy the splats as a plain SplatCloud."""
        return _cloud_of, ({field.name: getattr(self, field.name) for field in fields(self)},)

    @property
    def has_coplanar_groups(self) -> bool:
        """Whether the complete scene has coplanar groups."""
        return self._scene.has_coplanar_groups

    @property
    def footprint(self) -> str:
        """Footprint of the complete scene: `gaussian`, `box` or `mixed`."""
        return self._scene.footprint

    @property
    def ellipsoids(self) -> str:
        """Which splats of the complete scene are 3D Gaussians: `none`, `some` or `all`."""
        return self._scene.ellipsoids


def _cloud_of(values: dict[str, Any]) -> SplatCloud:
    cloud = object.__new__(SplatCloud)
    cloud._set(**values)
    return cloud


def concatenated(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Concatenated arrays of several parts; a single part is not copied."""
    if len(parts) == 1:
        return dict(parts[0])
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def transformed(
    splats: Mapping[str, np.ndarray], rotation: np.ndarray, offset: np.ndarray
) -> dict[str, np.ndarray]:
    """Splats rotated by a matrix (3, 3) and moved by (3,) metres.

    The result of a splat does not depend on the other splats, as that of a matrix product may.
    """
    x, y, z = splats["means"].T.astype(np.float64)
    means = [rotation[i, 0] * x + rotation[i, 1] * y + rotation[i, 2] * z + offset[i] for i in range(3)]
    quats = quaternion_multiply(matrix_to_quaternion(rotation), splats["quats"]).astype(np.float32)
    result = dict(splats) | {"means": np.stack(means, axis=1).astype(np.float32), "quats": quats}
    if "sh" in result and result["sh"].shape[1] > 1:
        degree = int(np.sqrt(result["sh"].shape[1])) - 1
        matrix = rotation_of_coefficients(degree, rotation).astype(np.float32)
        rotated = np.zeros_like(result["sh"])
        for i, j in zip(*np.nonzero(matrix), strict=True):
            rotated[:, i] += matrix[i, j] * result["sh"][:, j]
        result["sh"] = rotated
    return result
