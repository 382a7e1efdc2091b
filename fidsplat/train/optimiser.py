"""Adam (Kingma and Ba 2015) on the raw parameters of splats, before activation. The kernel version is
kernels/opencl/project_step.cl."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from fidsplat.splats.harmonics import C0
from fidsplat.train.parameters import Arrays, Splats
from fidsplat.train.settings import TrainSettings

HIGHER_SH_RATE = 1 / 20
"""learning rate of SH coefficients above degree 0, relative to degree 0"""


def learning_rates(settings: TrainSettings, iteration: int, extent: float) -> dict[str, float]:
    """Learning rates of an iteration by array; `sh` is the rate of degree 0."""
    return {
        "means": settings.position_rate_at(iteration) * extent,
        "log_scales": settings.scale_rate,
        "quats": settings.rotation_rate,
        "logits": settings.opacity_rate,
        "sh": settings.color_rate,
    }


def parameter_gradients(
    splats: Splats, gradients: Mapping[str, np.ndarray], settings: TrainSettings
) -> Arrays:
    """Gradients with respect to the raw parameters, from gradients with respect to the activated values.

    Args:
        gradients: the result of a gradient pipeline: `means`, `quats`, `scales`, `opacities`, and `colors`
            or `sh`.

    Returns:
        an array for each parameter in `Splats.values`, by its name; `sh` (n, k, 3) contains only the k
        coefficients that were rendered.
    """
    scales, opacities = splats.scales, splats.opacities
    by_scale, by_opacity = gradients["scales"], gradients["opacities"]
    if "thickness" in gradients:
        by_scale = np.column_stack([by_scale, gradients["thickness"]])
    if settings.strategy == "mcmc":
        by_scale = by_scale + np.float32(settings.scale_penalty / scales.size)
        by_opacity = by_opacity + np.float32(settings.opacity_penalty / len(splats))
    quats = splats.values["quats"]
    lengths = np.sqrt((quats * quats).sum(axis=1, keepdims=True))
    units, by_unit = quats / lengths, gradients["quats"]
    if "sh" in gradients:
        by_color = gradients["sh"]
    else:  # degree 0 is rendered as colours, which are clamped at 0
        shade = np.float32(C0) * splats.values["sh"][:, :1] + np.float32(0.5)
        by_color = np.float32(C0) * gradients["colors"][:, None] * (shade > 0)
    return {
        "means": gradients["means"],
        "log_scales": by_scale * scales,
        "quats": (by_unit - units * (units * by_unit).sum(axis=1, keepdims=True)) / lengths,
        "logits": by_opacity * opacities * (1 - opacities),
        "sh": by_color,
    }


def contributing(gradients: Mapping[str, np.ndarray]) -> np.ndarray:
    """Mask (n,) of the splats that contribute to a frame, which have a gradient."""
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
    """One Adam step of the splats `rows` (n,) bool; the others keep their values and moments."""
    part = splats.select(rows)
    adam_step(part, {name: array[rows] for name, array in gradients.items()}, rate, settings, step)
    for name in gradients:
        splats.values[name][rows] = part.values[name]
        splats.first[name][rows] = part.first[name]
        splats.second[name][rows] = part.second[name]


def adam_step(
    splats: Splats, gradients: Arrays, rate: Mapping[str, float], settings: TrainSettings, step: int
) -> None:
    """One Adam step of all values, including those with a gradient of 0, as in 2DGS.

    Args:
        gradients: result of `parameter_gradients`.
        rate: result of `learning_rates`.
        step: number of the step, from 1.
    """
    for name, gradient in gradients.items():
        value, first, second = (group[name] for group in (splats.values, splats.first, splats.second))
        if name != "sh":
            _adam(value, first, second, gradient, rate[name], settings, step)
            continue
        _adam(value[:, :1], first[:, :1], second[:, :1], gradient[:, :1], rate[name], settings, step)
        rest = slice(1, gradient.shape[1])  # coefficients above the current degree stay 0
        higher = (value[:, rest], first[:, rest], second[:, rest], gradient[:, rest])
        _adam(*higher, rate[name] * HIGHER_SH_RATE, settings, step)


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
    sqrt_correction2 = math.sqrt(1 - settings.beta2**step)
    value -= size * first / (np.sqrt(second) / sqrt_correction2 + settings.epsilon)
