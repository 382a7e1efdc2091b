"""Adam (Kingma and Ba 2015) on the splats' values before their activations. The kernels' twin is
kernels/opencl/project_step.cl."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from fidsplat.splats.harmonics import C0
from fidsplat.train.parameters import Arrays, Splats
from fidsplat.train.settings import TrainSettings

REST_SHARE = 1 / 20
"""of the colours' learning rate, for SH coefficients above degree 0"""


def rates(settings: TrainSettings, iteration: int, extent: float) -> dict[str, float]:
    """Learning rates of an iteration by the arrays' names; `sh` is that of degree 0."""
    return {
        "means": settings.position_rate_at(iteration) * extent,
        "log_scales": settings.scale_rate,
        "quats": settings.rotation_rate,
        "logits": settings.opacity_rate,
        "sh": settings.color_rate,
    }


def inner_gradients(splats: Splats, gradients: Mapping[str, np.ndarray], settings: TrainSettings) -> Arrays:
    """Derivatives by the values before their activations, from those by the cloud's.

    Args:
        gradients: `means`, `quats`, `scales`, `opacities`, and `colors` or `sh`, as a
            `DifferentiablePipeline` gives them.

    Returns:
        by the names of a `Splats`; `sh` (n, k, 3) has the coefficients that were drawn.
    """
    scales, opacities = splats.scales, splats.opacities
    by_scale, by_opacity = gradients["scales"], gradients["opacities"]
    if settings.strategy == "mcmc":
        by_scale = by_scale + np.float32(settings.scale_penalty / scales.size)
        by_opacity = by_opacity + np.float32(settings.opacity_penalty / len(splats))
    quats = splats.values["quats"]
    lengths = np.sqrt((quats * quats).sum(axis=1, keepdims=True))
    turns, by_turn = quats / lengths, gradients["quats"]
    if "sh" in gradients:
        by_color = gradients["sh"]
    else:  # of degree 0 the plain colours are drawn, which end at 0
        shade = np.float32(C0) * splats.values["sh"][:, :1] + np.float32(0.5)
        by_color = np.float32(C0) * gradients["colors"][:, None] * (shade > 0)
    return {
        "means": gradients["means"],
        "log_scales": by_scale * scales,
        "quats": (by_turn - turns * (turns * by_turn).sum(axis=1, keepdims=True)) / lengths,
        "logits": by_opacity * opacities * (1 - opacities),
        "sh": by_color,
    }


def moved_by(gradients: Mapping[str, np.ndarray]) -> np.ndarray:
    """Which splats (n,) a picture depends on, by its derivatives as a `DifferentiablePipeline` gives them."""
    color = gradients["sh"][:, 0] if "sh" in gradients else gradients["colors"]
    return (gradients["opacities"] != 0) | gradients["means"].any(axis=1) | color.any(axis=1)


def sparse_adam_step(
    splats: Splats,
    rows: np.ndarray,
    gradients: Arrays,
    rate: Mapping[str, float],
    settings: TrainSettings,
    step: int,
) -> None:
    """As `adam_step`, of the splats `rows` (n,) bool alone: the others rest, with what is remembered of
    them."""
    part = splats.chosen(rows)
    adam_step(part, {name: array[rows] for name, array in gradients.items()}, rate, settings, step)
    for name in gradients:
        splats.values[name][rows] = part.values[name]
        splats.first[name][rows] = part.first[name]
        splats.second[name][rows] = part.second[name]


def adam_step(
    splats: Splats, gradients: Arrays, rate: Mapping[str, float], settings: TrainSettings, step: int
) -> None:
    """One step of all values, those with a gradient of 0 among them, as the authors' trainer has it.

    Args:
        gradients: of `inner_gradients`.
        rate: of `rates`.
        step: which it is, from 1 on.
    """
    for name, gradient in gradients.items():
        value, first, second = (group[name] for group in (splats.values, splats.first, splats.second))
        if name != "sh":
            _adam(value, first, second, gradient, rate[name], settings, step)
            continue
        _adam(value[:, :1], first[:, :1], second[:, :1], gradient[:, :1], rate[name], settings, step)
        rest = slice(1, gradient.shape[1])  # coefficients that were never drawn stay 0
        of_rest = (value[:, rest], first[:, rest], second[:, rest], gradient[:, rest])
        _adam(*of_rest, rate[name] * REST_SHARE, settings, step)


def _adam(
    value: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    gradient: np.ndarray,
    rate: float,
    settings: TrainSettings,
    step: int,
) -> None:
    first *= settings.beta1
    first += (1 - settings.beta1) * gradient
    second *= settings.beta2
    second += (1 - settings.beta2) * gradient * gradient
    size = rate / (1 - settings.beta1**step)
    root = math.sqrt(1 - settings.beta2**step)
    value -= size * first / (np.sqrt(second) / root + settings.epsilon)
