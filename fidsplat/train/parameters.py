"""Raw parameters of splats in training, with the moments of Adam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import C0
from fidsplat.train.dataset import Dataset
from fidsplat.train.neighbours import mean_square_distances
from fidsplat.train.random_numbers import RandomStream, uniform
from fidsplat.train.settings import TrainSettings
from fidsplat.util.errors import FidsplatError, InputError

SHAPES = ("means", "log_scales", "quats", "logits")
NAMES = (*SHAPES, "sh")
"""the arrays of a `Splats`"""
_MIN_SQUARE_DISTANCE = 1e-7
"""lower limit of the mean squared distance to neighbours, for initial scales [m^2]"""

_FLATNESS = np.float32(1e-3)
"""initial thickness of a disk that is trained as a 3D Gaussian, relative to its smaller scale"""
_OPACITY_MARGIN = 1e-6
"""minimum distance of initial opacities from 0 and 1, where gradients vanish"""

Arrays = dict[str, np.ndarray]


class TrainingError(FidsplatError):
    """A training run that cannot continue. Exit status 1."""


@dataclass
class Splats:
    """n splats in training, all arrays float32."""

    values: Arrays
    """means (n, 3) metres relative to the origin, log_scales (n, 2) of disks or (n, 3) of 3D Gaussians, quats
    (n, 4) of any length, logits (n,) of the opacities, sh (n, k, 3)"""
    first: Arrays
    """Adam's first moments, with the shapes of `values`"""
    second: Arrays
    """Adam's second moments"""
    gradient_sums: np.ndarray
    """(n,) sums of screen-space gradients since the last densification"""
    visible_counts: np.ndarray
    """(n,) number of frames since then in which the splat was visible"""

    @classmethod
    def of(cls, values: Arrays) -> Splats:
        """Splats with moments and statistics of 0."""
        values = {name: np.array(values[name], np.float32, order="C") for name in NAMES}
        count = len(values["means"])
        zero = np.zeros(count, np.float32)
        return cls(values, _zeros(values), _zeros(values), zero, zero.copy())

    def __len__(self) -> int:
        return len(self.values["means"])

    @property
    def opacities(self) -> np.ndarray:
        """(n,) float32 in (0, 1)."""
        return sigmoid(self.values["logits"])

    @property
    def scales(self) -> np.ndarray:
        """(n, 2) or (n, 3) float32, metres."""
        with np.errstate(over="ignore"):  # the cloud drops splats whose scales overflow
            return np.exp(self.values["log_scales"])

    def select(self, rows: np.ndarray) -> Splats:
        """Some of the splats, by index or mask, with their moments and statistics."""
        values, first, second = (
            {name: array[rows] for name, array in group.items()} for group in self._groups
        )
        return Splats(values, first, second, self.gradient_sums[rows], self.visible_counts[rows])

    def append(self, values: Arrays) -> Splats:
        """These splats followed by new ones."""
        more = Splats.of(values)
        values, first, second = (
            {name: np.concatenate([a[name], b[name]]) for name in NAMES}
            for a, b in zip(self._groups, more._groups, strict=True)
        )
        gradient_sums = np.concatenate([self.gradient_sums, more.gradient_sums])
        visible_counts = np.concatenate([self.visible_counts, more.visible_counts])
        return Splats(values, first, second, gradient_sums, visible_counts)

    def check(self, when: str) -> None:
        """Raise TrainingError if a value is not finite."""
        moments = {f"Adam's mean of {n}": a for n, a in self.first.items()}
        moments |= {f"Adam's mean square of {n}": a for n, a in self.second.items()}
        moments |= {"gradients": self.gradient_sums}
        for name, array in (self.values | moments).items():
            if not np.isfinite(array).all():
                rows = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(1))
                raise TrainingError(
                    f"{name} of {len(rows)} splats (the first is {rows[0]}) are not finite {when}"
                )

    def cloud(self, degree: int, origin: np.ndarray, shared: bool = False) -> SplatCloud:
        """The activated splats, with SH of `degree` or of a lower degree that they have.

        shared: the cloud may share the memory of these splats and change with them.
        """
        values, coefficients = self.values, slice((degree + 1) ** 2)
        means, sh = values["means"][:], values["sh"][:, coefficients]
        scales = self.scales
        return SplatCloud.from_validated(
            means if shared else means.copy(),
            values["quats"].copy(),  # SplatCloud normalises them in place
            np.ascontiguousarray(scales[:, :2]),
            self.opacities,
            np.ascontiguousarray(sh) if shared else sh.copy(),
            thickness=np.ascontiguousarray(scales[:, 2]) if scales.shape[1] == 3 else None,
            origin=origin,
            dropped={},
        )

    @property
    def _groups(self) -> tuple[Arrays, Arrays, Arrays]:
        return self.values, self.first, self.second


def initial_splats(dataset: Dataset, settings: TrainSettings) -> Splats:
    """Initial splats at the points of a data set: scales by the distance to neighbours, random rotations.

    At most `max_splats` points are used, evenly spaced in the order of the data set.
    """
    count = min(len(dataset.points), settings.max_splats)
    rows = np.arange(count) * len(dataset.points) // count
    points = dataset.points[rows]
    scale = np.sqrt(np.maximum(mean_square_distances(points), _MIN_SQUARE_DISTANCE))
    if settings.strategy == "mcmc":
        scale *= settings.mcmc_scale
    sh = np.zeros((count, (settings.sh_degree + 1) ** 2, 3))
    sh[:, 0] = (dataset.colors[rows] / 255.0 - 0.5) / C0
    return Splats.of(
        {
            "means": points - dataset.origin,
            "log_scales": np.repeat(np.log(scale)[:, None], settings.axes, axis=1),
            "quats": uniform(settings.seed, RandomStream.ROTATIONS, 0, count),
            "logits": np.full(count, logit(settings.start_opacity)),
            "sh": sh,
        }
    )


def splats_from_cloud(cloud: SplatCloud, settings: TrainSettings, origin: np.ndarray) -> Splats:
    """The splats of a cloud, with missing SH coefficients 0 and those above `sh_degree` dropped.

    Raises:
        InputError: the cloud has boxes, 3D Gaussians where disks are trained, or more than `max_splats`.
    """
    scales, solid = cloud.scales, settings.primitive == "3d"
    if cloud.boxes is not None or (cloud.thickness is not None and not solid):
        raise InputError(
            "start must be a cloud of disks, got boxes or 3D Gaussians; convert it by flattened(), or "
            "train 3D Gaussians with primitive='3d'"
        )
    if solid:
        thickness = np.zeros(len(cloud), np.float32) if cloud.thickness is None else cloud.thickness
        third = np.where(thickness > 0, thickness, _FLATNESS * scales.min(axis=1))
        scales = np.column_stack([scales, third])
    if not 0 < len(cloud) <= settings.max_splats:
        raise InputError(
            f"start must have 1 to {settings.max_splats} splats (max_splats), got {len(cloud)}; "
            "raise max_splats"
        )
    sh = np.zeros((len(cloud), (settings.sh_degree + 1) ** 2, 3))
    if cloud.sh is not None:
        shared = min(sh.shape[1], cloud.sh.shape[1])
        sh[:, :shared] = cloud.sh[:, :shared]
    elif cloud.colors is not None:
        sh[:, 0] = (cloud.colors.astype(np.float64) - 0.5) / C0
    opacities = np.clip(cloud.opacities.astype(np.float64), _OPACITY_MARGIN, 1 - _OPACITY_MARGIN)
    return Splats.of(
        {
            "means": cloud.world_means() - origin,
            "log_scales": np.log(scales),
            "quats": cloud.quats,
            "logits": np.log(opacities) - np.log1p(-opacities),
            "sh": sh,
        }
    )


def sigmoid(x: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-x)), in the dtype of x."""
    with np.errstate(over="ignore"):  # an overflow correctly yields 0
        return 1 / (1 + np.exp(-x))


def logit(opacity: float) -> float:
    """Inverse of the sigmoid."""
    return float(np.log(opacity) - np.log1p(-opacity))


def _zeros(values: Arrays) -> Arrays:
    return {name: np.zeros_like(array) for name, array in values.items()}
