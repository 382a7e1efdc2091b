"""Differentiable effects and outputs, and validation of gradient requests."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from fidsplat.effects.select import FeatureSet
from fidsplat.util.errors import InputError

DIFFERENTIABLE = frozenset(
    (
        *("camera_pinhole", "color_rgb", "color_sh", "lowpass_none", "lowpass_screen"),
        *("ellipsoid_exact", "ellipsoid_ewa", "ellipsoid_ewa_antialiased", "ellipsoids_only"),
        *("stop_inclusive", "stop_exclusive", "order_centre", "footprint_gaussian"),
        *("background_constant", "arithmetic_precise", "arithmetic_fast", "arithmetic_approximate"),
    )
)
"""effects with a backward pass"""
GRADIENT_OUTPUTS = ("rgb", "alpha", "depth", "normal", "distortion")
"""outputs with a backward pass; `distortion` is internal (`with_distortion`)"""
_REMEDIES = {
    "camera": "a pinhole camera",
    "lowpass": "lowpass='screen' or 'none'",
    "order": "order='centre'",
    "footprint": "a cloud without boxes",
    "background": "a background of one colour",
    "external": "a capture without an external depth image",
    "termination": "features without termination depths",
    "motion": "a capture in which no group moves",
    "shutter": "a capture of one pose",
    "blend": "blend_precision='float32'",
}


def check_differentiable(features: FeatureSet) -> None:
    """Raise InputError, with a remedy, for the first effect of a frame without a gradient."""
    for name in features.effects:
        if name not in DIFFERENTIABLE:
            remedy = _REMEDIES[name.partition("_")[0]]
            raise InputError(f"effects must be differentiable, got {name}; use {remedy}")
    if features.samples > 1:
        raise InputError(f"samples must be 1 for gradients, got {features.samples}; use samples=1")
    if features.post_steps:
        raise InputError(
            f"a differentiable frame must have no fog or sensor, got {features.post_steps[0]}; use a capture "
            "without them"
        )


def with_distortion(features: FeatureSet) -> FeatureSet:
    """Add the output `distortion` (h, w), the depth distortion loss of 2DGS: the sum over pairs of fragments
    of w_i w_j (m_i - m_j)^2, with m the depth-buffer value."""
    return replace(features, outputs=tuple(sorted({*features.outputs, "distortion"})))


def check_gradients(features: FeatureSet, names: Iterable[str]) -> None:
    """Raise InputError for gradients of outputs that have no backward pass or were not rendered."""
    rendered = [name for name in GRADIENT_OUTPUTS if name == "rgb" or name in features.names]
    for name in names:
        if name not in rendered:
            why = "was not rendered" if name in GRADIENT_OUTPUTS else "has no gradient"
            raise InputError(f"the output {name!r} {why}; give gradients of: {', '.join(rendered)}")
