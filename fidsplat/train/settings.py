"""What a training run is asked for: plain numbers, each with its source."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from fidsplat.capture.quality import Quality
from fidsplat.splats.harmonics import MAX_DEGREE
from fidsplat.util.arguments import as_float, instance, whole_number
from fidsplat.util.errors import InputError, unknown

STRATEGIES = ("default", "mcmc")
MOST_ITERATIONS = 10_000_000

_COUNTS = {
    "iterations": (1, MOST_ITERATIONS),
    "seed": (0, 2**63 - 1),
    "max_splats": (1, 2**31 - 1),
    "sh_degree": (0, MAX_DEGREE),
    "sh_every": (1, MOST_ITERATIONS),
    "distortion_from": (0, MOST_ITERATIONS),
    "normal_from": (0, MOST_ITERATIONS),
    "position_steps": (1, MOST_ITERATIONS),
    "densify_from": (0, MOST_ITERATIONS),
    "densify_until": (0, MOST_ITERATIONS),
    "densify_every": (1, MOST_ITERATIONS),
    "reset_every": (1, MOST_ITERATIONS),
    "relocate_until": (0, MOST_ITERATIONS),
}
"""whole numbers, with the least and the largest of each"""


@dataclass(frozen=True)
class TrainSettings:
    """Settings of a training run. Defaults are the constants of the 2DGS authors' trainer (hbb1,
    2d-gaussian-splatting, commit 1920a23), those of `mcmc` gsplat's (`strategy/mcmc.py`, after Kheradmand et
    al. 2024) but for `mcmc_scale`, so that thresholds and rates known from there mean the same here.

    Raises:
        InputError: a value lies outside its range; the message names the range.
    """

    iterations: int = 7000
    """pictures that are looked at, one after another; the authors' trainer takes 30,000 by default"""
    seed: int = 0
    """of all random numbers: the order of views, first rotations, places of split splats"""
    strategy: str = "default"
    """`default`: the authors' rule, splats are cloned or split where the gradient on the screen is large, and
    pruned; `mcmc`: dead splats move to live ones, up to `max_splats`, and all are shaken"""
    max_splats: int = 1_000_000
    """no more are made; where the default rule would, those of the largest gradients go first"""
    quality: str = "surfel"
    """how pictures are drawn while training, as `fs.Quality` takes it; `surfel` is what the authors have.
    Where it names no arithmetic, processors take the fast one: colours differ by less than 1e-6"""

    sh_degree: int = 3
    """of the colours in the end, 0 to 3"""
    sh_every: int = 1000
    """iterations after which the degree grows by one"""

    dssim_weight: float = 0.2
    """share of 1 - SSIM in the loss; the rest is the mean absolute difference"""

    distortion_weight: float = 0.0
    """of the mean depth distortion in the loss, after `distortion_from` iterations; the authors take 100 to
    1000 for bounded scenes"""
    distortion_from: int = 3000
    normal_weight: float = 0.05
    """of the mean difference of normals and surfaces (`fidsplat.train.losses.normal_loss`) in the loss, after
    `normal_from` iterations"""
    normal_from: int = 7000

    position_rate: float = 1.6e-4
    """learning rate of the means at first, in units of the scene's extent"""
    position_rate_end: float = 1.6e-6
    """the same after `position_steps`"""
    position_steps: int = 30_000
    """iterations over which it falls, whatever the run's own length"""
    color_rate: float = 2.5e-3
    """learning rate of the SH coefficients of degree 0; those above have a twentieth"""
    opacity_rate: float = 0.05
    scale_rate: float = 0.005
    rotation_rate: float = 0.001
    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-15
    """of Adam's denominator"""
    sparse_adam: bool = False
    """in a step the splats rest that its picture does not depend on; otherwise they move on by what is
    remembered of them, as with the authors"""

    densify_from: int = 500
    """iterations before this are left to the splats that there are"""
    densify_until: int = 15_000
    densify_every: int = 100
    gradient_threshold: float = 2e-4
    """mean gradient of a splat's place on the screen, in half pictures, above which it is cloned or split"""
    dense_share: float = 0.01
    """of the extent: splats up to this large are cloned, larger ones split"""
    prune_opacity: float = 0.05
    """splats below it go when others are made; 3DGS has 0.005"""
    prune_scale: float = 0.1
    """of the extent: larger splats go, after the first reset"""
    reset_every: int = 3000
    """iterations after which opacities fall to `reset_opacity` at most"""
    reset_opacity: float = 0.01
    initial_opacity: float = 0.1

    relocate_until: int = 25_000
    """mcmc: the last iteration at which dead splats move and new ones come; it begins at `densify_from`"""
    dead_opacity: float = 0.005
    """mcmc: splats at or below it move to live ones"""
    growth: float = 1.05
    """mcmc: by which the number of splats grows every `densify_every` iterations, up to `max_splats`"""
    noise: float = 5e5
    """mcmc: of the means' random steps, in units of their learning rate"""
    opacity_penalty: float = 0.01
    """mcmc: weight of the mean opacity in the loss"""
    scale_penalty: float = 0.01
    """mcmc: weight of the mean scale in the loss"""
    mcmc_opacity: float = 0.5
    """mcmc: opacity at first"""
    mcmc_scale: float = 0.5
    """mcmc: scales at first, in units of the default rule's. gsplat's is 0.1, for 3D Gaussians, which the
    low-pass blurs; behind that of 2DGS, `screen`, scales of splats far below a pixel have no gradient, and
    they stay so"""

    def __post_init__(self) -> None:
        for name, (least, most) in _COUNTS.items():
            _put(self, name, whole_number(f"training: {name}", getattr(self, name), least, most))
        if not isinstance(self.strategy, str) or self.strategy not in STRATEGIES:
            raise InputError(f"training: strategy is {self.strategy!r}; known: {', '.join(STRATEGIES)}")
        if not isinstance(self.quality, str):  # checkpoints hold it as text
            raise InputError(f"training: quality is {self.quality!r}; give it as text, e.g. 'surfel'")
        Quality.of(self.quality)
        if not isinstance(self.sparse_adam, bool):
            raise InputError(f"training: sparse_adam is {self.sparse_adam!r}; it must be True or False")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type == "float":
                if not 0 <= as_float(value) < math.inf:
                    raise InputError(
                        f"training: {field.name} is {value!r}; it must be a number of at least 0"
                    )
                _put(self, field.name, float(value))
        if not self.dssim_weight <= 1:
            raise InputError(f"training: dssim_weight is {self.dssim_weight!r}; it must lie from 0 to 1")
        for name in ("beta1", "beta2"):
            if not getattr(self, name) < 1:
                raise InputError(
                    f"training: {name} is {getattr(self, name)!r}; it must be at least 0 and below 1"
                )
        for name in ("initial_opacity", "mcmc_opacity", "reset_opacity"):
            if not 0 < getattr(self, name) < 1:  # whose logit is finite
                raise InputError(
                    f"training: {name} is {getattr(self, name)!r}; it must lie between 0 and 1, without these"
                )

    def position_rate_at(self, iteration: int) -> float:
        """Learning rate of the means, in units of the extent: falls evenly in its logarithm."""
        iteration = whole_number("iteration", iteration, 0, 2**63 - 1)
        share = min(iteration / self.position_steps, 1.0)
        return self.position_rate ** (1 - share) * self.position_rate_end**share

    def degree_at(self, iteration: int) -> int:
        """SH degree that is trained at this iteration."""
        iteration = whole_number("iteration", iteration, 0, 2**63 - 1)
        return min(self.sh_degree, iteration // self.sh_every)

    def surface_weights_at(self, iteration: int) -> tuple[float, float]:
        """Weights of normals and of distortions at this iteration."""
        normal = self.normal_weight if iteration > self.normal_from else 0.0
        return normal, self.distortion_weight if iteration > self.distortion_from else 0.0

    def makes_splats_after(self, iteration: int) -> bool:
        """Whether splats are made and removed after this iteration."""
        until = self.relocate_until if self.strategy == "mcmc" else self.densify_until
        return self.densify_from < iteration < until and iteration % self.densify_every == 0

    def adam_steps(self, iteration: int) -> int:
        """Number of the optimiser's steps up to this iteration. By the default strategy an iteration after
        which splats are made has none."""
        if self.strategy == "mcmc":
            return iteration
        last, every = min(iteration, self.densify_until - 1), self.densify_every
        return iteration - max(0, last // every - self.densify_from // every)

    def changes_after(self, iteration: int) -> int | None:
        """The next iteration of the run of which other kernels draw: the degree grows, or a loss begins."""
        degree = self.degree_at(iteration) + 1
        every = [degree * self.sh_every] if degree <= self.sh_degree else []
        every += [self.normal_from + 1] if self.normal_weight else []
        every += [self.distortion_from + 1] if self.distortion_weight else []
        return min((one for one in every if iteration < one <= self.iterations), default=None)

    @property
    def first_opacity(self) -> float:
        """Opacity of all splats at first."""
        return self.mcmc_opacity if self.strategy == "mcmc" else self.initial_opacity


def _put(settings: TrainSettings, name: str, value: Any) -> None:
    """Sets a field of settings that are being made."""
    object.__setattr__(settings, name, value)


def settings_with(settings: TrainSettings | None, changes: dict[str, Any]) -> TrainSettings:
    """Settings, the defaults if None, with some changed. Raises InputError for one that does not exist."""
    if settings is not None:
        instance("settings", settings, TrainSettings)
    for name in changes:
        if name not in TrainSettings.__dataclass_fields__:
            raise InputError(unknown("training setting", name, TrainSettings.__dataclass_fields__))
    return TrainSettings(**{**({} if settings is None else vars(settings)), **changes})
