"""The output `error`: a certified upper bound of |rgb - ideal| per pixel, for the largest channel.

The ideal is the image without approximations: no alpha cut-off, no early termination (transmittance stop), no
clamp of alpha (opacity ceiling, gsplat's 0.99), exact arithmetic. It has the low-pass filter, compositing
order, samples per pixel and near plane of the requested quality.

The renderer renders twice: rgb with the requested quality, and a reference image Q, which approximates the
ideal. Q has no stop and no ceiling, and the cut-off e = `MAX_OMITTED` / n, with n the number of splats. Then

    |rgb - ideal| <= |rgb - Q| + |Q - ideal|,

where the first term is measured, for any requested quality, and the second is bounded:

1. Compositing is affine in each opacity: d C / d alpha_k = T_k (c_k - B_k), with T_k the transmittance in
   front of fragment k and B_k the colour behind it, a mean of colours and background. Replace the alphas of Q
   by the exact ones, back to front. Each replacement changes a colour by at most T_k |d alpha_k| R, with T_k
   of Q and R the range of the colours.
2. A fragment that Q omits has an alpha below e. There are at most n per pixel: n e R = `MAX_OMITTED` R. The
   radius of a footprint grows with sqrt(ln(1 / e)), so that Q has about twice the fragments of the default.
3. Each alpha of Q has a rounding error, from the ray-splat intersection. Interval arithmetic computes an
   interval that contains the exact alpha. Rounding can also decide whether a fragment exists: at the near
   plane, where the ray is parallel to the splat's plane, and at the edge of the footprint. The intervals
   include these cases. The kernels compute the distance of alpha from the farther end of its interval, and
   sum T_k times this distance: the internal output `rounding` (kernels/opencl/output/rounding.cl).
4. Compositing has rounding errors too. C is the largest absolute colour, m the number of fragments at a
   pixel.
   - Rounding T changes the colour behind a fragment by at most 2^-24 T C, and rounding the colour sum changes
     the sum by at most 2^-24 (1 - T) C. For m fragments, both together are at most m 2^-24 C.
   - Rounding the products T alpha and T alpha c adds at most 2^-24 C each for all fragments together.
   The total is (m + 2) 2^-24 C. The kernels add 1.5 x 2^-24 C per fragment to `rounding`: 1 and a margin for
   second-order terms. `error_reference` adds 2 x 2^-24 C. It also adds 2^-24 C for each rounding of the sums
   over samples, over sub-frames (the camera poses that a shutter averages) and over spherical harmonics.

R and C are bounded by the colours of all splats and of the background. Q is composited in float64 if an
effect is not in `_BOUNDED` or rgb is composited in float64. Then only the conversion of its image to float32
is rounded. Fog, sensors and a finite `far` have no bound on any device, and gradient and panorama backgrounds
only on the reference device: `error_reference` raises InputError for them. The bound excludes the rounding of
the float64 projection and, with order="pixel", the order of two fragments whose depths differ by less than
float64's rounding.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fidsplat.backends.interface import Backend, DeviceCloud, Images
from fidsplat.backends.prepare import prepare
from fidsplat.backends.view import View
from fidsplat.capture.capture import Capture
from fidsplat.capture.environment import Gradient, Panorama
from fidsplat.capture.quality import Quality
from fidsplat.effects import FeatureSet
from fidsplat.util.errors import InputError

MAX_OMITTED = 2.0**-23
"""maximum sum of the alphas of a pixel's fragments that the reference image omits"""
_SLACK = 1.01
"""factor on the bounds, for their own rounding"""
_UNIT_ROUNDOFF = 2.0**-24
"""unit roundoff of float32"""

_BOUNDED = frozenset(
    (
        *("camera_pinhole", "color_rgb", "color_sh", "lowpass_none", "lowpass_screen", "stop_inclusive"),
        *("order_centre", "footprint_gaussian", "background_constant", "motion_groups"),
        *("ellipsoid_ewa", "ellipsoid_ewa_antialiased", "ellipsoids_only"),
        *("arithmetic_precise", "arithmetic_fast"),
    )
)
"""effects (features of a frame, declared in fidsplat/effects/catalogue.py) whose float32 rounding the kernels
bound; stop_*: whether the fragment that crosses the transmittance stop is composited, order_*: whether
fragments are composited by the depth of their splat's centre or by their own depth"""

_REMEDIES = {
    "camera": ("a distorted or non-pinhole camera", "a pinhole camera"),
    "ellipsoid_exact": ("3D Gaussians with ellipsoid='exact'", "ellipsoid='ewa'"),
    "lowpass_pixel": ("lowpass='pixel'", "lowpass='screen'"),
    "external_depth": ("an external depth image", "a capture without external_depth"),
    "order_coplanar": (
        "coplanar groups (of markers, or given by coplanar_groups) with order='pixel'",
        "order='centre'",
    ),
    "order_pixel": ("order='pixel'", "order='centre'"),
    "footprint": (
        "box splats (hard-edged rectangles, of markers with mixture='exact')",
        "markers with mixture='fitted'",
    ),
    "background": ("a gradient or panorama background", "a background of one colour"),
    "shutter": (
        "a shutter with an exposure time or a readout",
        "a shutter with exposure_time=0 and readout=0",
    ),
    "blend_double": ("blend_precision='float64'", "blend_precision='float32'"),
}
"""prefix of an effect's name: (option that requests the effect, what to use instead)"""
_SENSOR_ARGUMENTS = {"noise": "full_well", "quantise": "bits", "response": "response"}
"""arguments of `Sensor` whose names differ from the names of their steps, by the prefix of the step"""


def cutoff_of(splats: int) -> float:
    """Alpha cut-off for which the alphas of omitted fragments have a sum of at most `MAX_OMITTED`."""
    return MAX_OMITTED / max(splats, 1)


def ideal_quality(quality: Quality, cutoff: float) -> Quality:
    """The quality of a reference image: the alpha cut-off `cutoff`, no early termination, alphas up to 1, no
    level of detail, and a float64 projection."""
    return quality.with_(
        alpha_cutoff=cutoff,
        detail_error=0.0,
        transmittance_stop=0.0,
        opacity_ceiling=1.0,
        stop_rule="inclusive",
        projection_precision="float64",
    )


@dataclass(frozen=True)
class ErrorReference:
    """Features and view of a reference image, which approximates the ideal image, and its error bound."""

    features: FeatureSet
    view: View
    color_bound: float
    """max(R, C): range and largest absolute value of all colours"""
    relative_bound: float
    """error bound per unit of colour, without the bound of the output `rounding`"""


@dataclass(frozen=True)
class ErrorImage:
    """The output `error` of a frame, computed on first use."""

    rgb: Images
    reference_image: Images
    reference: ErrorReference

    def read(self) -> np.ndarray:
        """Compute the error bound, (h, w) float32."""
        rgb, reference = (images.read_float64("rgb", 0) for images in (self.rgb, self.reference_image))
        measured = np.abs(rgb - reference).max(axis=2)
        bound = np.full(measured.shape, self.reference.relative_bound)
        if "rounding" in self.reference.features.outputs:
            bound += _SLACK * self.reference_image.read("rounding", 0)
        error = measured + self.reference.color_bound * bound
        return np.nextafter(error.astype(np.float32), np.float32(np.inf))

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds on the device of the reference image."""
        return {"error": sum(self.reference_image.timings.values())}


def error_reference(data: Any, capture: Capture, backend: Backend) -> ErrorReference:
    """Prepare the reference image of an uploaded cloud: its features, view and error bound. Raises
    InputError for an effect without a bound, a store, or a device without float64."""
    _refuse_unbounded(capture)
    if not isinstance(data, DeviceCloud):
        raise InputError(
            "splats must be in memory for the output 'error', got a store (a scene in chunks on disk); "
            "render store.cloud() if it fits into memory, or leave out the output 'error'"
        )
    quality = ideal_quality(capture.quality, cutoff_of(data.count))
    features, view = _reference_features(data, capture, quality, backend)
    # float32 roundings outside of the blending loop: 8 for the products of step 4, the background and the
    # conversions of the image; then the sums of samples, sub-frames and spherical harmonics
    roundings = 8 + features.samples**2 + len(view.sub_frames) + (32 if features.sh_degree else 0)
    low, high = data.color_range()
    for color in _colors_behind(view):
        low, high = min(low, float(np.min(color))), max(high, float(np.max(color)))
    color_bound = max(high - low, abs(low), abs(high))
    return ErrorReference(features, view, color_bound, _SLACK * (_UNIT_ROUNDOFF * roundings + MAX_OMITTED))


def _reference_features(
    data: Any, capture: Capture, quality: Quality, backend: Backend
) -> tuple[FeatureSet, View]:
    """Features and view of the reference image. It is composited in float32 with the output `rounding` if the
    rounding of all effects is bounded, otherwise in float64. Raises InputError if the device can do
    neither."""
    capture = capture.with_(outputs=("rgb",), quality=quality)
    info = backend.info
    if info.always_float64:
        return prepare(data, capture)
    if not info.float64:
        raise InputError(
            f"the device of the output 'error' must have float64, got {info.name}; use another device"
        )
    in_float32 = quality.with_(blend_precision="float32")
    if in_float32.arithmetic == "approximate":
        in_float32 = in_float32.with_(arithmetic="fast")
    features, view = prepare(data, replace(capture, quality=in_float32))
    unbounded = sorted({*features.effects} - _BOUNDED)
    if not unbounded and quality.blend_precision != "float64":
        return replace(features, outputs=("rounding",)), view
    # gradients and panoramas are evaluated along float32 rays, also with float64 blending
    float32_rays = any(name.startswith("background_") for name in unbounded)
    with suppress(InputError):
        in_float64 = prepare(data, replace(capture, quality=quality.with_(blend_precision="float64")))
        if not float32_rays and not backend.unsupported(in_float64[0]):
            return in_float64
    alternatives = dict(_remedy_of(name) for name in unbounded or ["blend_double"])
    options, remedies = (" and ".join(texts) for texts in (alternatives, alternatives.values()))
    raise InputError(
        f"the output 'error' must be requested with effects whose rounding is bounded on {info.name}, got "
        f"{options}; render with {remedies}, leave out the output 'error', or use device='reference'"
    )


def _remedy_of(effect: str) -> tuple[str, str]:
    """The option that requests an effect, and what to use instead."""
    matches = (remedy for prefix, remedy in _REMEDIES.items() if effect.startswith(prefix))
    return next(matches, (effect, "other settings"))


def _refuse_unbounded(capture: Capture) -> None:
    """Raise InputError if an effect of the capture has no bound on any device."""
    camera = capture.camera
    if capture.has_fog:
        effect, remedy = "fog", "without fog"
    elif capture.sensor.steps:
        step = capture.sensor.steps[0]
        name = next((name for prefix, name in _SENSOR_ARGUMENTS.items() if step.startswith(prefix)), step)
        effect, remedy = f"a sensor with {name}={getattr(capture.sensor, name)!r}", "with fs.Sensor()"
    elif camera is not None and math.isfinite(camera.far):
        # a smaller cut-off enlarges splats: the reference image contains splats that `far` culls in rgb
        effect, remedy = f"a camera whose far is {camera.far:g} m", "with a camera whose far is infinite"
    else:
        return
    raise InputError(
        f"the output 'error' must be requested with effects that have an error bound, got {effect}; leave "
        f"out the output, or render {remedy}"
    )


def _colors_behind(view: View) -> list[Any]:
    """Colours of the background and of the external depth image."""
    match view.environment_map:
        case Gradient(top=top, bottom=bottom):
            behind = [top, bottom]
        case Panorama(image=image):
            behind = [image]
        case _:
            behind = []
    return [view.background, *behind, *([] if view.external_depth is None else [view.external_depth.rgb])]
