"""Training settings: plain numbers, each with its source."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from fidsplat.capture.quality import Quality
from fidsplat.splats.harmonics import MAX_DEGREE
from fidsplat.util.arguments import as_float, whole_number
from fidsplat.util.errors import InputError

STRATEGIES = ("default", "mcmc")
PRIMITIVES = ("2d", "3d")
MAX_ITERATIONS = 10_000_000

_COUNTS = {
    "iterations": (1, MAX_ITERATIONS),
    "seed": (0, 2**63 - 1),
    "max_splats": (1, 2**31 - 1),
    "sh_degree": (0, MAX_DEGREE),
    "sh_every": (1, MAX_ITERATIONS),
    "distortion_from": (0, MAX_ITERATIONS),
    "normal_from": (0, MAX_ITERATIONS),
    "position_steps": (1, MAX_ITERATIONS),
    "densify_from": (0, MAX_ITERATIONS),
    "densify_until": (0, MAX_ITERATIONS),
    "densify_every": (1, MAX_ITERATIONS),
    "reset_every": (1, MAX_ITERATIONS),
    "relocate_until": (0, MAX_ITERATIONS),
}
"""range of each setting that is an integer"""


@dataclass(frozen=True)
class TrainSettings:
    """Settings of a training run.

    The defaults are the constants of the 2DGS authors' trainer (hbb1, 2d-gaussian-splatting, commit 1920a23),
    and for `mcmc` those of gsplat (`strategy/mcmc.py`, after Kheradmand et al. 2024) except for `mcmc_scale`.

    Raises:
        InputError: a value is outside its range; the message names the range.
    """

    iterations: int = 7000
    """number of steps, one view each; 30,000 in 2DGS"""
    seed: int = 0
    """seed of all random numbers: order of views, initial rotations, means of split splats"""
    primitive: str = "2d"
    """`2d`: disks, as 2DGS; `3d`: 3D Gaussians, as 3DGS, in the projection of `quality`"""
    strategy: str = "default"
    """`default`: clone, split and prune by screen-space gradients, as 2DGS; `mcmc`: relocation of dead
    splats, growth up to `max_splats`, and noise"""
    max_splats: int = 1_000_000
    """maximum number of splats; the default strategy then clones and splits those of the largest gradients"""
    quality: str = "surfel"
    """render quality during training, as text for `fs.Quality`; `surfel` has the constants of 2DGS. Without
    `arithmetic` in the text, CPUs use `arithmetic=fast`, which changes colours by less than 1e-6"""

    sh_degree: int = 3
    """final degree of the spherical harmonics, 0 to 3"""
    sh_every: int = 1000
    """iterations between increments of the degree"""

    dssim_weight: float = 0.2
    """weight of 1 - SSIM in the loss; the rest is the mean absolute difference"""

    distortion_weight: float = 0.0
    """weight of the mean depth distortion after `distortion_from` iterations; 2DGS uses 100 to 1000 for
    bounded scenes"""
    distortion_from: int = 3000
    """iteration after which `distortion_weight` applies"""
    normal_weight: float = 0.05
    """weight of normal consistency (`fidsplat.train.losses.normal_loss`) after `normal_from` iterations"""
    normal_from: int = 7000
    """iteration after which `normal_weight` applies"""

    position_rate: float = 1.6e-4
    """initial learning rate of the means, in units of the scene extent"""
    position_rate_end: float = 1.6e-6
    """learning rate of the means after `position_steps`"""
    position_steps: int = 30_000
    """iterations of the exponential decay, independent of `iterations`"""
    color_rate: float = 2.5e-3
    """learning rate of SH coefficients of degree 0; higher ones have a twentieth"""
    opacity_rate: float = 0.05
    """learning rate of the opacities' logits"""
    scale_rate: float = 0.005
    """learning rate of the scales' logarithms"""
    rotation_rate: float = 0.001
    """learning rate of the quaternions"""
    beta1: float = 0.9
    """decay of Adam's first moments"""
    beta2: float = 0.999
    """decay of Adam's second moments"""
    epsilon: float = 1e-15
    """epsilon of Adam"""
    refine_poses: bool = False
    """refine the camera pose of each training view; held-out views are then localised before they are
    evaluated"""
    refine_intrinsics: bool = False
    """refine fx, fy, cx and cy; all views with equal intrinsics share them. Distortion is not refined"""
    pose_rate: float = 1e-4
    """initial learning rate of poses (radians, and metres per metre of depth) and of intrinsics (pixels per
    pixel of focal length)"""
    pose_rate_end: float = 1e-6
    """learning rate of poses and intrinsics at the last iteration"""
    fit_exposures: bool = False
    """fit a gain and an offset of each channel for each training view: exposure and white balance; those of
    held-out views are fitted before they are evaluated"""
    exposure_rate: float = 0.01
    """initial learning rate of the gains' logarithms and of the offsets"""
    exposure_rate_end: float = 0.001
    """learning rate of exposures at the last iteration"""
    sparse_adam: bool = False
    """update only splats that contribute to the frame; otherwise all splats, as in 2DGS"""

    densify_from: int = 500
    """first iteration of densification"""
    densify_until: int = 15_000
    """last iteration of densification"""
    densify_every: int = 100
    """iterations between densifications"""
    gradient_threshold: float = 2e-4
    """mean screen-space gradient, in half images, above which a splat is cloned or split"""
    dense_fraction: float = 0.01
    """scale, relative to the scene extent, up to which splats are cloned; larger ones are split"""
    prune_opacity: float = 0.05
    """splats of lower opacity are pruned; 3DGS has 0.005"""
    prune_scale: float = 0.1
    """scale, relative to the scene extent, above which splats are pruned after the first opacity reset"""
    reset_every: int = 3000
    """iterations between opacity resets, which limit opacities to `reset_opacity`"""
    reset_opacity: float = 0.01
    """maximum opacity after a reset"""
    initial_opacity: float = 0.1
    """initial opacity; for mcmc it is `mcmc_opacity`"""

    relocate_until: int = 25_000
    """mcmc: last iteration of relocation and growth, which start at `densify_from`"""
    dead_opacity: float = 0.005
    """mcmc: splats of this opacity or less are relocated"""
    growth: float = 1.05
    """mcmc: growth factor of the number of splats every `densify_every` iterations, up to `max_splats`"""
    noise: float = 5e5
    """mcmc: scale of the noise of the means, in units of their learning rate"""
    opacity_penalty: float = 0.01
    """mcmc: weight of the mean opacity in the loss"""
    scale_penalty: float = 0.01
    """mcmc: weight of the mean scale in the loss"""
    mcmc_opacity: float = 0.5
    """mcmc: initial opacity"""
    mcmc_scale: float = 0.5
    """mcmc: initial scales, relative to the default strategy. gsplat has 0.1 for 3D Gaussians with a low-pass
    filter. With that of 2DGS, `screen`, scales far below a pixel have no gradient and do not grow"""

    def __post_init__(self) -> None:
        for name, (minimum, maximum) in _COUNTS.items():
            number = whole_number(f"training: {name}", getattr(self, name), minimum, maximum)
            object.__setattr__(self, name, number)
        for name, known in (("strategy", STRATEGIES), ("primitive", PRIMITIVES)):
            value = getattr(self, name)
            if not isinstance(value, str) or value not in known:
                raise InputError(f"training: {name} must be one of {', '.join(known)}, got {value!r}")
        if not isinstance(self.quality, str):  # checkpoints store it as text
            raise InputError(f"training: quality must be text such as 'surfel', got {self.quality!r}")
        Quality.of(self.quality)
        for name in ("sparse_adam", "refine_poses", "refine_intrinsics", "fit_exposures"):
            if not isinstance(getattr(self, name), bool):
                raise InputError(f"training: {name} must be True or False, got {getattr(self, name)!r}")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type == "float":
                if not 0 <= as_float(value) < math.inf:
                    raise InputError(f"training: {field.name} must be a number of at least 0, got {value!r}")
                object.__setattr__(self, field.name, float(value))
        cameras, exposures = ("refine_poses", "refine_intrinsics"), ("fit_exposures",)
        for switches, rate in ((cameras, "pose_rate"), (exposures, "exposure_rate")):
            for name in (rate, f"{rate}_end"):
                off = not any(getattr(self, switch) for switch in switches)
                if off and getattr(self, name) != getattr(TrainSettings, name):
                    raise InputError(
                        f"training: {name} must be its default {getattr(TrainSettings, name):g} without "
                        f"{' or '.join(switches)}, got {getattr(self, name):g}; add "
                        f"--{switches[0].replace('_', '-')}, or {switches[0]}=True"
                    )
        if not self.dssim_weight <= 1:
            raise InputError(f"training: dssim_weight must be from 0 to 1, got {self.dssim_weight!r}")
        for name in ("beta1", "beta2"):
            if not getattr(self, name) < 1:
                raise InputError(
                    f"training: {name} must be at least 0 and below 1, got {getattr(self, name)!r}"
                )
        for name in ("initial_opacity", "mcmc_opacity", "reset_opacity"):
            if not 0 < getattr(self, name) < 1:  # the logit must be finite
                raise InputError(f"training: {name} must be above 0 and below 1, got {getattr(self, name)!r}")

    def position_rate_at(self, iteration: int) -> float:
        """Learning rate of the means at an iteration, in units of the scene extent: exponential decay."""
        return _decayed(iteration, self.position_rate, self.position_rate_end, self.position_steps)

    def pose_rate_at(self, iteration: int) -> float:
        """Learning rate of poses and intrinsics at an iteration."""
        return _decayed(iteration, self.pose_rate, self.pose_rate_end, self.iterations)

    def exposure_rate_at(self, iteration: int) -> float:
        """Learning rate of exposures at an iteration."""
        return _decayed(iteration, self.exposure_rate, self.exposure_rate_end, self.iterations)

    def degree_at(self, iteration: int) -> int:
        """SH degree at an iteration."""
        iteration = whole_number("iteration", iteration, 0, 2**63 - 1)
        return min(self.sh_degree, iteration // self.sh_every)

    def surface_weights_at(self, iteration: int) -> tuple[float, float]:
        """Weights of normal consistency and depth distortion at an iteration."""
        iteration = whole_number("iteration", iteration, 0, 2**63 - 1)
        normal = self.normal_weight if iteration > self.normal_from else 0.0
        return normal, self.distortion_weight if iteration > self.distortion_from else 0.0

    def densifies_after(self, iteration: int) -> bool:
        """Whether densification follows an iteration."""
        iteration = whole_number("iteration", iteration, 0, 2**63 - 1)
        until = self.relocate_until if self.strategy == "mcmc" else self.densify_until
        return self.densify_from < iteration < until and iteration % self.densify_every == 0

    def adam_steps(self, iteration: int) -> int:
        """Number of Adam steps up to an iteration; the default strategy has none before a densification."""
        iteration = whole_number("iteration", iteration, 0, 2**63 - 1)
        if self.strategy == "mcmc":
            return iteration
        last, every = min(iteration, self.densify_until - 1), self.densify_every
        return iteration - max(0, last // every - self.densify_from // every)

    def changes_after(self, iteration: int) -> int | None:
        """The next iteration that needs other kernels, for a higher SH degree or an additional loss."""
        degree = self.degree_at(iteration) + 1
        every = [degree * self.sh_every] if degree <= self.sh_degree else []
        every += [self.normal_from + 1] if self.normal_weight else []
        every += [self.distortion_from + 1] if self.distortion_weight else []
        return min((change for change in every if iteration < change <= self.iterations), default=None)

    @property
    def refines_cameras(self) -> bool:
        """Whether steps need the gradient of the camera."""
        return self.refine_poses or self.refine_intrinsics

    @property
    def axes(self) -> int:
        """Number of scales of a splat."""
        return 3 if self.primitive == "3d" else 2

    @property
    def start_opacity(self) -> float:
        """Initial opacity of all splats."""
        return self.mcmc_opacity if self.strategy == "mcmc" else self.initial_opacity


def _decayed(iteration: int, first: float, last: float, steps: int) -> float:
    """Exponential decay from `first` to `last` in a number of steps."""
    fraction = min(whole_number("iteration", iteration, 0, 2**63 - 1) / steps, 1.0)
    return first ** (1 - fraction) * last**fraction
