"""Quality settings that trade accuracy for time, and the named presets. They do not depend on the device."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from numbers import Real
from typing import Any

import numpy as np

from fidsplat.util.arguments import as_float, instance, invalid, parse_setting, whole_number
from fidsplat.util.errors import InputError, unknown

LOWPASS = ("screen", "pixel", "none")
STOP_RULES = ("inclusive", "exclusive")
ELLIPSOID = ("exact", "ewa", "ewa_antialiased")
ORDERS = ("auto", "pixel", "centre")
SETUP_PRECISIONS = ("float64", "float32")
ARITHMETIC = ("precise", "fast", "approximate")
BLEND_PRECISIONS = ("float32", "float16", "float64")
MAX_SAMPLES = 8
MIXTURES = ("exact", "fitted", "paper", "facets")
BY_FORMULA = LADDER, NESTED = 121, 562
TEMPLATE_SIZES = (1, 5, 9, 13, 25, 41, *BY_FORMULA)
"""Gaussians per rectangle in the templates of fidsplat/markers/templates.json, and in those computed by
fidsplat/markers/mixture.py"""
MAX_LEVELS, MAX_DENSITY = 8, 100


def _one_of(what: str, value: Any, known: tuple) -> None:
    if not isinstance(value, (str, int, type(None))) or isinstance(value, bool) or value not in known:
        raise invalid(what, f"one of {', '.join(map(str, known))}", value)


@dataclass(frozen=True)
class MarkerQuality:
    """Conversion of the rectangles of a marker to splats.

    More Gaussians reproduce sharp edges better and cost time in every frame. These are the defaults of
    `fs.marker`, of the markers of scene files and of `fidsplat marker`.

    Raises:
        InputError: a value is out of range.
    """

    mixture: str = "exact"
    """`exact`: one box per rectangle, with edges filtered by the pixel; opaque and sharp at any distance.
    `fitted`: Gaussians by templates optimised on complete markers, for splat files and other renderers.
    `facets`: Gaussians in planes that cross along the edges of modules; opaque and sharp, but only with
    `order="pixel"`. `paper`: Gaussians by the construction of the paper's section 3.2."""

    levels: int = 4
    """Levels L of `paper`, 1 to 8: 2^(L+2) - 7 Gaussians per rectangle at density 1, edges blurred over 2^-L
    half widths."""

    density: int = 3
    """Copies of all levels but the last in `paper`, 1 to 100: more are more opaque and slower."""

    growth: float | None = None
    """Modules, 0 to 1, by which a rectangle extends into neighbours of its own colour (a long one further
    along its axis). Closes seams and rounds corners. None: 0.4 for fitted, 0 for paper."""

    template: int = 25
    """Gaussians per rectangle of `fitted`, and of `exact` in splat files, up to an aspect ratio of 6: 1, 5,
    9, 13, 25, 41, 121 or 562. Fewer render faster, with blurred edges and round corners; 562 are opaque and
    sharp, with a low-pass from 24 pixels per module; 121 are a start for `fs.train.refine`."""

    def __post_init__(self) -> None:
        _one_of("marker quality: mixture", self.mixture, MIXTURES)
        whole_number("marker quality: levels", self.levels, 1, MAX_LEVELS)
        whole_number("marker quality: density", self.density, 1, MAX_DENSITY)
        _one_of("marker quality: template", self.template, TEMPLATE_SIZES)
        growth = self.growth
        if growth is not None and not (isinstance(growth, Real) and 0 <= growth <= 1):
            raise invalid("marker quality: growth", "0 to 1 module", growth)


@dataclass(frozen=True)
class Quality:
    """Quality settings of a frame. They do not bound the error for every scene; the output `error` bounds it
    for one frame (docs/accuracy.md).

    Raises:
        InputError: a value is out of range.
    """

    alpha_cutoff: float = 1e-5
    """Minimum alpha of a fragment, in (0, 1), default 1e-5. It sets the radius of each splat, R^2 = 2
    ln(opacity / cutoff), in bounds and in the per-pixel test. Lower values cost area, higher ones remove rims
    and haze: at 1/255, the value of other renderers, images are off by 0.018 where splats overlap, and 100
    splats of alpha 0.0039 lose 32 % opacity (docs/accuracy.md)."""

    transmittance_stop: float = 1e-4
    """Transmittance at which a pixel terminates, in [0, 1), default 1e-4: further splats change the pixel by
    at most this. Higher values skip more occluded splats; 0 never stops."""

    stop_rule: str = "inclusive"
    """`inclusive`: the fragment that reaches the stop is composited. `exclusive` (gsplat, 2DGS authors): it
    is dropped, which leaks up to 1 % of the background through opaque splats; for parity only."""

    opacity_ceiling: float = 1.0
    """Maximum alpha of a fragment, in (0, 1], default 1. gsplat and the 2DGS authors use 0.99, which keeps
    their gradients finite and leaks 1 % of the background; it saves no time."""

    lowpass: str = "screen"
    """Low-pass filter of splats. `screen`: as in 2DGS, the maximum of the splat and a Gaussian of sigma 0.707
    pixels around the projected centre; for scenes trained with it. `pixel`: the splat convolved in its plane
    with a Gaussian of sigma 0.5 samples, at constant energy; for splats much smaller than a pixel. `none`: no
    filter; for markers of Gaussians, with several samples per pixel. Boxes are always filtered exactly."""

    ellipsoid: str = "ewa"
    """Projection of 3D Gaussians. `ewa`: as in 3DGS and gsplat, an image-space ellipse dilated by 0.3 square
    pixels at the depth of the centre. `ewa_antialiased`: with opacity compensation, as in Mip-Splatting.
    `exact`: the maximum along each ray and its depth, under `lowpass`; correct near the camera and at wide
    angles, as in 3DGUT and ray tracers (docs/primitives.md). Distorted, fisheye and panorama cameras always
    use `exact`."""

    order: str = "auto"
    """Compositing order. `centre`: by the depth of splat centres, as in other renderers and in the training
    of captured scenes; large splats pop as the camera turns. `pixel`: by the depth of each fragment, where
    the ray meets the splat. `auto`: as `centre`, with coplanar groups (markers) placed by their depth at each
    pixel. In `pixel` and `auto` a coplanar group is one layer without an order (docs/correctness.md)."""

    samples: int = 1
    """Samples per pixel side, 1 to 8, default 1: a pixel is the mean of n x n samples on a regular grid.
    Blending costs n^2 as much."""

    detail_error: float = 0.0
    """Error of rgb allowed for levels of detail of stores, in [0, 1), as measured on sample views of the
    store with this low-pass and an `alpha_cutoff` of 1e-8. Other views may exceed it, more so with a larger
    cut-off (docs/large-scenes.md). 0 renders all splats. Scenes in memory have no levels of detail."""

    first_hit: float = 0.1
    """Accumulated opacity of the surface in depth_first and distance_first, in (0, 1): the first fragment or
    layer behind which the transmittance is at most 1 - first_hit."""

    setup_precision: str = "float64"
    """Arithmetic of the per-splat set-up. `float32` shifts small and grazing splats (docs/correctness.md) and
    saves time on devices with slow float64; devices without float64 always use it."""

    arithmetic: str = "fast"
    """Exponentials and logarithms of blending. `fast`: polynomials, within 2.3 ulp for exponentials and 1.1
    for logarithms, bit-identical on devices with fused multiply-adds. `precise`: the device library's, 3 ulp
    in OpenCL. Colours differ by less than 1e-6, or by the stop if a pixel reaches it one splat earlier.
    `approximate`: as `fast`, but exponentials by NVIDIA's GPUs through OpenCL, within 1e-6; images are no
    longer bit-identical to those of other devices."""

    blend_precision: str = "float32"
    """Arithmetic of fragments. `float16` sums colours and transmittance in half precision, always with
    approximate arithmetic: faster on NVIDIA's GPUs, slower elsewhere; n fragments with colours up to 1 change
    a pixel by at most (n + 3) / 2048. `float64` computes intersection, weight and blending in float64: a
    reference image of the device, many times slower and always precise; it needs float64 in the device and in
    the set-up."""

    marker: MarkerQuality = field(default_factory=MarkerQuality)
    """Conversion of markers to splats."""

    def __post_init__(self) -> None:
        for setting in fields(self):
            value = getattr(self, setting.name)
            if isinstance(value, np.generic):  # not by `own_scalars`, whose module would be loaded too
                object.__setattr__(self, setting.name, value.item())

        def within(name: str, low: float, high: float, low_open: bool, high_open: bool) -> None:
            value = getattr(self, name)
            found = as_float(value)
            ok = (
                math.isfinite(found)
                and (found > low if low_open else found >= low)
                and (found < high if high_open else found <= high)
            )
            if not ok:
                left, right = "(" if low_open else "[", ")" if high_open else "]"
                raise InputError(f"quality: {name} must be in {left}{low:g}, {high:g}{right}, got {value!r}")

        within("alpha_cutoff", 0.0, 1.0, True, True)
        within("transmittance_stop", 0.0, 1.0, False, True)
        within("opacity_ceiling", 0.0, 1.0, True, False)
        within("first_hit", 0.0, 1.0, True, True)
        within("detail_error", 0.0, 1.0, False, True)
        for name, known in (
            ("stop_rule", STOP_RULES),
            ("lowpass", LOWPASS),
            ("ellipsoid", ELLIPSOID),
            ("order", ORDERS),
            ("setup_precision", SETUP_PRECISIONS),
            ("arithmetic", ARITHMETIC),
            ("blend_precision", BLEND_PRECISIONS),
        ):
            _one_of(f"quality: {name}", getattr(self, name), known)
        instance("quality: marker", self.marker, MarkerQuality, "an fs.MarkerQuality")
        if self.blend_precision == "float64" and self.setup_precision != "float64":
            raise InputError(
                "quality: setup_precision must be 'float64' with blend_precision='float64', got 'float32'"
            )
        if self.stop_rule == "exclusive" and self.order != "centre":
            raise InputError(
                f"quality: order must be 'centre' with stop_rule='exclusive', got {self.order!r}; coplanar "
                "groups are composited as one fragment, of which the exclusive stop cannot drop single splats"
            )
        whole_number("quality: samples", self.samples, 1, MAX_SAMPLES)

    @classmethod
    def named(cls, name: str) -> Quality:
        """A preset by name: standard, fast, reference, gsplat or surfel."""
        if isinstance(name, str) and name in PRESETS:
            return PRESETS[name]
        raise InputError(unknown("quality", name, PRESETS))

    @classmethod
    def of(cls, quality: Quality | str | None) -> Quality:
        """Convert a `Quality`, a text or None (the default) to a `Quality`.

        Text is the name of a preset, settings as key=value, or both: "fast", "alpha_cutoff=1e-3",
        "fast,samples=2,marker.template=9". Without a name the settings change standard.

        Raises:
            InputError: an unknown preset or setting, or a value out of range.
        """
        if quality is None:
            return PRESETS["standard"]
        if isinstance(quality, cls):
            return quality
        if not isinstance(quality, str):
            raise InputError(f"quality must be an fs.Quality or text, got {quality!r}")
        first, *rest = (part.strip() for part in quality.split(","))
        chosen = PRESETS["standard"] if "=" in first else cls.named(first)
        changes: dict[str, Any] = {}
        for part in [first, *rest] if "=" in first else rest:
            name, equals, value = (piece.strip() for piece in part.partition("="))
            if not equals:
                raise InputError(
                    f"quality must be settings as key=value, e.g. alpha_cutoff=1e-3, got {part!r}"
                )
            if name.startswith("marker."):
                own = name.removeprefix("marker.")
                changes.setdefault("marker", {})[own] = _read(MarkerQuality, own, value)
            else:
                changes[name] = _read(cls, name, value)
        return chosen.with_(**changes)

    def with_(self, **changes) -> Quality:
        """A copy with some settings changed. marker: a `MarkerQuality`, or a dict of its settings to
        change."""
        for name in changes:
            _check_known(Quality, name)
        marker = changes.get("marker")
        if isinstance(marker, dict):
            for name in marker:
                _check_known(MarkerQuality, name)
            changes["marker"] = replace(self.marker, **marker)
        return replace(self, **changes)


def setting_types(kind: type[Quality] | type[MarkerQuality]) -> dict[str, str]:
    """Annotated type of each scalar setting by name: `float`, `int | None` ..."""
    return {setting.name: str(setting.type) for setting in fields(kind) if setting.name != "marker"}


def _check_known(kind: type[Quality] | type[MarkerQuality], name: str) -> None:
    known = [setting.name for setting in fields(kind)]
    if name not in known:
        whose = "marker quality" if kind is MarkerQuality else "quality"
        raise InputError(unknown(f"setting of {whose}", name, known))


def _read(kind: type[Quality] | type[MarkerQuality], name: str, text: str) -> Any:
    """Parse the value of a setting."""
    if name == "marker":
        raise InputError(
            f"quality: marker must be given by its settings, e.g. marker.template=9, got marker={text}"
        )
    _check_known(kind, name)
    return parse_setting("quality", kind, name, text)


# gsplat: gsplat 1.5/1.6 `rasterization_2dgs`; surfel: the 2DGS authors' diff-surfel-rasterization.
# Both clamp alpha at 0.99, cut at 1/255 and drop the fragment that would take T below 1e-4. Their differences
# (bounding boxes, low-pass centre, near plane) are defects and are not reproduced: see docs/conventions.md.
_PARITY = Quality(
    alpha_cutoff=1.0 / 255.0,
    transmittance_stop=1e-4,
    opacity_ceiling=0.99,
    stop_rule="exclusive",
    order="centre",
    arithmetic="precise",
)

# standard: the fastest quality of docs/accuracy.md with an error of at most 1/512 on every scene, including
# the self-test; fast arithmetic is faster on CPUs and at most 1 % slower on GPUs
PRESETS: dict[str, Quality] = {
    "standard": Quality(),
    "fast": Quality(alpha_cutoff=2.0 / 255.0, transmittance_stop=1.0 / 256.0, setup_precision="float32"),
    "reference": Quality(alpha_cutoff=1e-6, transmittance_stop=0.0, arithmetic="precise"),
    "gsplat": _PARITY,
    "surfel": _PARITY,
}
