"""The output `error`: a certified upper bound of |rgb - ideal| per pixel, for the largest channel.

The ideal is the image with nothing left out: every Gaussian down to zero (no cut-off), no transmittance stop,
no opacity ceiling, in exact arithmetic. Low-pass, order, samples and the near plane define it and stay.

The renderer renders twice: rgb as the quality says, and a second image Q of the ideal without a stop and a
ceiling and with a cut-off e of `UNLISTED` / n, n the number of splats. Then

    |rgb - ideal| <= |rgb - Q| + |Q - ideal|,

where the first term is measured, so that it holds whatever the quality leaves out, and the second is bounded:

1. Compositing is affine in each opacity: d C / d alpha_k = T_k (c_k - B_k), with T_k the transmittance in
   front of fragment k and B_k the colour behind it, a mean of colours and background. Replacing the opacities
   of Q by exact ones, one after the other from the back, moves a colour by at most sum_k T_k |d alpha_k| R,
   with T_k of Q and R the range of the colours.
2. A fragment that Q leaves out has an opacity below e. There are at most n: n e R = `UNLISTED` R. Footprints
   grow only with sqrt(ln(1 / e)), so that Q has about twice the fragments of the default.
3. A fragment of Q has an opacity between those that interval arithmetic over the rounding of its forms gives,
   also where rounding decides whether it is rendered (near plane, horizon, rim). Kernels add up T_k times
   the distance to the further end: the output `rounding` (kernels/opencl/output/rounding.cl).
4. Each product of a transmittance is rounded, which changes the colour behind it, at most 2^-24 T C, and each
   sum of colours, at most 2^-24 (1 - T) C, C the largest absolute colour: 2^-24 C for each fragment, which
   `rounding` counts too. Resolving, and the colours of spherical harmonics, add `resolving` units.

R and C are bounded by the colours of all splats and of the background. Where kernels have no such bound
(`_BOUNDED`), or rgb itself is composited in float64, Q is composited in float64, and its rounding is that of
its float32 image. Not counted are the rounding of the float64 set-up, and, with order="pixel", which of two
fragments comes first where their depths agree to float64's rounding.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fidsplat.backends.interface import Backend, Images, ResidentData
from fidsplat.backends.prepare import prepare
from fidsplat.backends.view import View
from fidsplat.capture.capture import Capture
from fidsplat.capture.environment import Gradient, Panorama
from fidsplat.capture.quality import Quality
from fidsplat.effects import FeatureSet
from fidsplat.util.errors import InputError

UNLISTED = 2.0**-23
"""sum of the opacities, at most, of all fragments that the ideal is rendered without"""
_SLACK = 1.01
"""relative: rounding of the bounds themselves"""
_UNIT = 2.0**-24

_BOUNDED = frozenset(
    (
        *("camera_pinhole", "color_rgb", "color_sh", "lowpass_none", "lowpass_screen", "stop_inclusive"),
        *("compose_ordered", "footprint_gaussian", "background_constant", "motion_groups"),
        *("ellipsoid_ewa", "ellipsoid_ewa_antialiased", "ellipsoids_only"),
        *("arithmetic_precise", "arithmetic_fast"),
    )
)
"""effects whose float32 rounding kernels bound"""

_REQUESTED = {
    "camera": ("a distorted or non-pinhole camera", "a pinhole camera"),
    "ellipsoid_exact": ("3D Gaussians with ellipsoid='exact'", "ellipsoid='ewa'"),
    "lowpass_pixel": ("lowpass='pixel'", "lowpass='screen'"),
    "external_depth": ("an external depth image", "a capture without external_depth"),
    "compose_coplanar": (
        "coplanar groups (markers and other printed planes) in order='pixel'",
        "order='centre'",
    ),
    "compose_pixel": ("order='pixel'", "order='centre'"),
    "footprint": ("boxes (markers with mixture='exact')", "markers with mixture='fitted'"),
    "background": ("a gradient or panorama background", "a background of one color"),
    "shutter": (
        "a shutter with an exposure time or a readout",
        "a shutter with exposure_time=0 and readout=0",
    ),
    "blend_double": ("blend_precision='float64'", "blend_precision='float32'"),
}
"""option that requests an effect, and the supported alternative, by the prefix of the effect's name"""
_SENSOR = {"noise": "full_well", "quantise": "bits", "response": "response"}
"""prefix of a sensor's step: the argument that requests it, where it has another name"""


def cutoff_of(splats: int) -> float:
    """The cut-off at which what is left out of `splats` splats has opacities of `UNLISTED` in all."""
    return UNLISTED / max(splats, 1)


def nothing_left_out(quality: Quality, cutoff: float) -> Quality:
    """The quality of the same image with this cut-off, no stop, no ceiling and its set-up in float64."""
    return quality.with_(
        alpha_cutoff=cutoff,
        detail_error=0.0,
        transmittance_stop=0.0,
        opacity_ceiling=1.0,
        stop_rule="inclusive",
        setup_precision="float64",
    )


@dataclass(frozen=True)
class Ideal:
    """Features and view of the ideal's rendering, and its error bound."""

    features: FeatureSet
    view: View
    span: float
    """range of all colours, or the largest absolute colour if that is larger"""
    off: float
    """bound per unit of colour, in addition to that of the output `rounding` where it is rendered"""


@dataclass(frozen=True)
class ErrorImage:
    """The output `error` of a frame, computed on first use."""

    rgb: Images
    ideal: Images
    plan: Ideal

    def read(self) -> np.ndarray:
        """(h, w) float32."""
        measured = np.abs(self.rgb.read_float64("rgb", 0) - self.ideal.read_float64("rgb", 0)).max(axis=2)
        off = np.full(measured.shape, self.plan.off)
        if "rounding" in self.plan.features.outputs:
            off += _SLACK * self.ideal.read("rounding", 0)
        return np.nextafter((measured + self.plan.span * off).astype(np.float32), np.float32(np.inf))

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds on the device of the second rendering."""
        return {"error": sum(self.ideal.timings.values())}


def ideal_of(data: Any, capture: Capture, backend: Backend) -> Ideal:
    """The ideal of a capture of an uploaded cloud.

    Raises:
        InputError: there is no bound for one of the capture's effects, or on this device; the message names
            it and the output.
    """
    _refuse_unbounded(capture)
    if not isinstance(data, ResidentData):
        raise InputError(
            "the output 'error' must be of splats in memory, got a store; render store.cloud() where it fits "
            "into memory, or leave out the output 'error'"
        )
    quality = nothing_left_out(capture.quality, cutoff_of(data.count))
    features, view = _prepared(data, capture, quality, backend)
    # float32 sums: of samples, of sub-frames, of harmonics
    resolving = 8 + features.samples**2 + len(view.sub_frames) + (32 if features.sh_degree else 0)
    low, high = data.color_range()
    for color in _colors_behind(view):
        low, high = min(low, float(np.min(color))), max(high, float(np.max(color)))
    span = max(high - low, abs(low), abs(high))
    return Ideal(features, view, span, _SLACK * (_UNIT * resolving + UNLISTED))


def _prepared(data: Any, capture: Capture, quality: Quality, backend: Backend) -> tuple[FeatureSet, View]:
    """Features and view of the ideal: in float32 with the output `rounding` if kernels bound it, else in
    float64."""
    plain = capture.with_(outputs=("rgb",), quality=quality)
    info = backend.info
    if info.always_float64:
        return prepare(data, plain)
    if not info.float64:
        raise InputError(
            f"the output 'error' must have a set-up in float64, which {info.name} has not; use another device"
        )
    features, view = prepare(data, replace(plain, quality=quality.with_(blend_precision="float32")))
    unbounded = sorted({*features.slots} - _BOUNDED)
    if not unbounded and quality.blend_precision == "float32":
        return replace(features, outputs=("rounding",)), view
    try:
        if any(name.startswith("background_") for name in unbounded):
            raise InputError("its rays are stored in float32")
        double = prepare(data, replace(plain, quality=quality.with_(blend_precision="float64")))
        if why := backend.unsupported(double[0]):
            raise InputError(why)
    except InputError as error:
        requested = dict(_requested(name) for name in unbounded or ["blend_double"])
        got, instead = (" and ".join(words) for words in (requested, requested.values()))
        raise InputError(
            f"the output 'error' must be of effects whose rounding {info.name} bounds, got {got}; "
            f"render with {instead}, leave out the output 'error', or use device='reference'"
        ) from error
    return double


def _requested(effect: str) -> tuple[str, str]:
    """The option that requests an effect, and the supported alternative."""
    return next(
        (words for prefix, words in _REQUESTED.items() if effect.startswith(prefix)), (effect, "less")
    )


def _refuse_unbounded(capture: Capture) -> None:
    """Raises InputError where an effect of the capture has no bound on any device."""
    camera = capture.camera
    if capture.foggy:
        effect, remedy = "fog", "without fog"
    elif capture.sensor.steps:
        step = capture.sensor.steps[0]
        name = next((name for prefix, name in _SENSOR.items() if step.startswith(prefix)), step)
        effect, remedy = f"a sensor with {name}={getattr(capture.sensor, name)!r}", "with fs.Sensor()"
    elif camera is not None and math.isfinite(camera.far):
        # splats are culled at `far` by the radius of the cut-off
        effect, remedy = f"a camera whose far is {camera.far:g} m", "with a camera whose far is infinite"
    else:
        return
    raise InputError(
        f"the output 'error' must be of effects that have a bound, got {effect}; leave out the output, or "
        f"render {remedy}"
    )


def _colors_behind(view: View) -> list[Any]:
    """Colours of the background and of an external depth image."""
    match view.surroundings:
        case Gradient(top=top, bottom=bottom):
            behind = [top, bottom]
        case Panorama(image=image):
            behind = [image]
        case _:
            behind = []
    return [view.background, *behind, *([] if view.external_depth is None else [view.external_depth.rgb])]
