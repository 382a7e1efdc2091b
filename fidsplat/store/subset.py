"""Splats of a store as a cloud that is drawn, and splats of a store at another place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, Protocol

import numpy as np

from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import C0, rotation_of_coefficients
from fidsplat.splats.rotations import matrix_to_quaternion


class WholeTraits(Protocol):
    """What the whole has of which a cloud is a part: by it the kernels are chosen, so that a part has the
    bits of the whole."""

    @property
    def sh_degree(self) -> int: ...

    @property
    def has_planes(self) -> bool: ...

    @property
    def footprint(self) -> str: ...

    @property
    def ellipsoids(self) -> str: ...

    @property
    def origin(self) -> np.ndarray: ...


class StorePart(SplatCloud):
    """Some splats of a whole, in its order, drawn as the whole is."""

    _whole: WholeTraits

    @classmethod
    def of(
        cls, arrays: Mapping[str, np.ndarray], whole: WholeTraits, dropped: Mapping[str, int] | None = None
    ) -> StorePart:
        """A cloud of arrays that can all be drawn, without a copy. dropped: what is left out of the whole."""
        made = object.__new__(cls)
        given: dict[str, Any] = {"colors": None, "sh": None, "planes": None, "boxes": None, "thickness": None}
        made._set(**given | dict(arrays), origin=whole.origin, dropped=dict(dropped or {}))
        object.__setattr__(made, "_whole", whole)
        return made

    def __reduce__(self):
        """Pickled and copied as a cloud of its own."""
        return _cloud_of, ({each.name: getattr(self, each.name) for each in fields(self)},)

    @property
    def has_planes(self) -> bool:
        """As the whole."""
        return self._whole.has_planes

    @property
    def footprint(self) -> str:
        """As the whole."""
        return self._whole.footprint

    @property
    def ellipsoids(self) -> str:
        """As the whole."""
        return self._whole.ellipsoids


def _cloud_of(values: dict[str, Any]) -> SplatCloud:
    cloud = object.__new__(SplatCloud)
    cloud._set(**values)
    return cloud


def joined(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of several parts as one; each of one part is taken as it is."""
    if len(parts) == 1:
        return dict(parts[0])
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def colors_of(given: Mapping[str, np.ndarray], sh_degree: int) -> dict[str, np.ndarray]:
    """Of splats with `colors` or `sh` those of one degree: plain colours where it is -1, with the bits of
    `SplatCloud.plain_colors`; else SH, its missing bands 0."""
    if sh_degree < 0:
        if "colors" in given:
            return {"colors": given["colors"]}
        return {"colors": np.maximum(np.float32(C0) * given["sh"][:, 0] + np.float32(0.5), np.float32(0))}
    terms = (sh_degree + 1) ** 2
    if "sh" in given and given["sh"].shape[1] == terms:
        return {"sh": given["sh"]}
    sh = np.zeros((len(given["means"]), terms, 3), np.float32)
    if "sh" in given:
        kept = min(terms, given["sh"].shape[1])
        sh[:, :kept] = given["sh"][:, :kept]
    else:
        sh[:, 0] = (given["colors"].astype(np.float64) - 0.5) / C0
    return {"sh": sh}


def moved(splats: Mapping[str, np.ndarray], pose: np.ndarray, move: np.ndarray) -> dict[str, np.ndarray]:
    """Splats turned by a rigid pose (4, 4) and moved by (3,) metres. Sums in one order, number by number: a
    splat has the same bits whichever splats it is moved with."""
    turn = pose[:3, :3]
    x, y, z = splats["means"].T.astype(np.float64)
    means = [turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z + move[i] for i in range(3)]
    w, a, b, c = splats["quats"].T.astype(np.float64)
    p, q, r, s = matrix_to_quaternion(turn)
    quats = [
        p * w - q * a - r * b - s * c,
        p * a + q * w + r * c - s * b,
        p * b - q * c + r * w + s * a,
        p * c + q * b - r * a + s * w,
    ]
    made = dict(splats) | {
        "means": np.stack(means, axis=1).astype(np.float32),
        "quats": np.stack(quats, axis=1).astype(np.float32),
    }
    if "sh" in made and made["sh"].shape[1] > 1:
        degree = int(np.sqrt(made["sh"].shape[1])) - 1
        matrix = rotation_of_coefficients(degree, turn).astype(np.float32)
        turned = np.zeros_like(made["sh"])
        for i, j in zip(*np.nonzero(matrix), strict=True):
            turned[:, i] += matrix[i, j] * made["sh"][:, j]
        made["sh"] = turned
    return made
