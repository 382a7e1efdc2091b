"""What is trained: the splats' values before their activations, and what Adam remembers of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import C0
from fidsplat.train.dataset import Dataset
from fidsplat.train.neighbours import mean_square_distances
from fidsplat.train.random_numbers import Purpose, uniform
from fidsplat.train.settings import TrainSettings
from fidsplat.util.errors import FidsplatError, InputError

SHAPES = ("means", "log_scales", "quats", "logits")
NAMES = (*SHAPES, "sh")
"""the arrays of a `Splats`"""
_LEAST_SQUARE = 1e-7
"""m^2, of the mean squared distance that first scales are made of"""

_SMALLEST = 1e-6
"""opacity, and distance from 1, of splats that training begins with: beyond it nothing would move them"""

Arrays = dict[str, np.ndarray]


class TrainingError(FidsplatError):
    """A run that cannot go on. Exit status 1."""


@dataclass
class Splats:
    """n splats in training, float32 all of them."""

    values: Arrays
    """means (n, 3) metres relative to the origin, log_scales (n, 2), quats (n, 4) of any length, logits (n,)
    of the opacities, sh (n, k, 3)"""
    first: Arrays
    """Adam's running means of the gradients, of the same shapes"""
    second: Arrays
    """Adam's running means of their squares"""
    gradients: np.ndarray
    """(n,) sum of the gradients on the screen since splats were last made"""
    seen: np.ndarray
    """(n,) in how many pictures of those a splat was"""

    @classmethod
    def of(cls, values: Arrays) -> Splats:
        """Splats that nothing is remembered of."""
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
        """(n, 2) float32, metres."""
        return np.exp(self.values["log_scales"])

    def chosen(self, rows: np.ndarray) -> Splats:
        """Some of the splats, by index or mask, with what is remembered of them."""
        values, first, second = (
            {name: array[rows] for name, array in group.items()} for group in self._groups
        )
        return Splats(values, first, second, self.gradients[rows], self.seen[rows])

    def with_more(self, values: Arrays) -> Splats:
        """These splats and behind them new ones."""
        more = Splats.of(values)
        values, first, second = (
            {name: np.concatenate([a[name], b[name]]) for name in NAMES}
            for a, b in zip(self._groups, more._groups, strict=True)
        )
        gradients = np.concatenate([self.gradients, more.gradients])
        return Splats(values, first, second, gradients, np.concatenate([self.seen, more.seen]))

    def check(self, when: str) -> None:
        """Raises TrainingError where a number is not finite."""
        remembered = {f"Adam's mean of {n}": a for n, a in self.first.items()}
        remembered |= {f"Adam's mean square of {n}": a for n, a in self.second.items()}
        remembered |= {"gradients": self.gradients}
        for name, array in (self.values | remembered).items():
            if not np.isfinite(array).all():
                rows = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(1))
                raise TrainingError(
                    f"{name} of {len(rows)} splats (the first is {rows[0]}) are not finite {when}"
                )

    def cloud(self, degree: int, origin: np.ndarray, shared: bool = False) -> SplatCloud:
        """The splats as they are drawn, with SH of a degree that they have at least.

        shared: it may stand on the memory of these splats, and changes as they do.
        """
        values, coefficients = self.values, slice((degree + 1) ** 2)
        means, sh = values["means"][:], values["sh"][:, coefficients]
        return SplatCloud.of_checked(
            means if shared else means.copy(),
            values["quats"].copy(),  # which are made unit where they lie
            self.scales,
            self.opacities,
            np.ascontiguousarray(sh) if shared else sh.copy(),
            origin=origin,
            dropped={},
        )

    @property
    def _groups(self) -> tuple[Arrays, Arrays, Arrays]:
        return self.values, self.first, self.second


def first_splats(dataset: Dataset, settings: TrainSettings) -> Splats:
    """A splat at each of a data set's points: as large as its neighbours are far, turned at random.

    At most `max_splats` points are taken, evenly among them.
    """
    count = min(len(dataset.points), settings.max_splats)
    rows = np.arange(count) * len(dataset.points) // count
    points = dataset.points[rows]
    scale = np.sqrt(np.maximum(mean_square_distances(points), _LEAST_SQUARE))
    if settings.strategy == "mcmc":
        scale *= settings.mcmc_scale
    sh = np.zeros((count, (settings.sh_degree + 1) ** 2, 3))
    sh[:, 0] = (dataset.colors[rows] / 255.0 - 0.5) / C0
    return Splats.of(
        {
            "means": points - dataset.origin,
            "log_scales": np.repeat(np.log(scale)[:, None], 2, axis=1),
            "quats": uniform(settings.seed, Purpose.ROTATIONS, 0, count),
            "logits": np.full(count, logit(settings.first_opacity)),
            "sh": sh,
        }
    )


def splats_from(cloud: SplatCloud, settings: TrainSettings, origin: np.ndarray) -> Splats:
    """The splats of a cloud, with zeros for SH coefficients that it lacks; those beyond `sh_degree` go.

    Raises:
        InputError: a cloud with boxes or 3D Gaussians, which are not trained, or with more than `max_splats`.
    """
    if cloud.boxes is not None or cloud.thickness is not None:
        raise InputError("only disks are trained, and the cloud has boxes or 3D Gaussians; see flattened()")
    if not 0 < len(cloud) <= settings.max_splats:
        raise InputError(
            f"the cloud to start from has {len(cloud)} splats; it must be 1 to max_splats, "
            f"{settings.max_splats}"
        )
    sh = np.zeros((len(cloud), (settings.sh_degree + 1) ** 2, 3))
    if cloud.sh is not None:
        shared = min(sh.shape[1], cloud.sh.shape[1])
        sh[:, :shared] = cloud.sh[:, :shared]
    elif cloud.colors is not None:
        sh[:, 0] = (cloud.colors.astype(np.float64) - 0.5) / C0
    opacities = np.clip(cloud.opacities.astype(np.float64), _SMALLEST, 1 - _SMALLEST)
    return Splats.of(
        {
            "means": cloud.world_means() - origin,
            "log_scales": np.log(cloud.scales),
            "quats": cloud.quats,
            "logits": np.log(opacities) - np.log1p(-opacities),
            "sh": sh,
        }
    )


def sigmoid(x: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-x)), in x's type."""
    return 1 / (1 + np.exp(-x))


def logit(opacity: float) -> float:
    """The number whose sigmoid it is."""
    return float(np.log(opacity) - np.log1p(-opacity))


def _zeros(values: Arrays) -> Arrays:
    return {name: np.zeros_like(array) for name, array in values.items()}
