"""Every knob that trades accuracy for time, and the named presets.

A `Quality` says what is computed, never where: the same object works on every backend.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from numbers import Real
from typing import Any

import numpy as np

from fidsplat.util.arguments import as_float, whole_number
from fidsplat.util.errors import InputError, unknown

LOWPASS = ("screen", "pixel", "none")
STOP_RULES = ("inclusive", "exclusive")
ELLIPSOID = ("exact", "ewa", "ewa_antialiased")
ORDERS = ("auto", "pixel", "centre")
SETUP_PRECISIONS = ("float64", "float32")
ARITHMETIC = ("precise", "fast")
BLEND_PRECISIONS = ("float32", "float64")
MAX_SAMPLES = 8
MIXTURES = ("exact", "fitted", "paper", "facets")
BY_FORMULA = LADDER, NESTED = 121, 562
TEMPLATE_SIZES = (1, 5, 9, 13, 25, 41, *BY_FORMULA)
"""Gaussians of a rectangle in the templates that are shipped (fidsplat/markers/templates.json), and in those
by a formula (fidsplat/markers/nested.py)"""
MAX_LEVELS, MAX_DENSITY = 8, 100


def _one_of(what: str, value: Any, known: tuple) -> None:
    if not isinstance(value, (str, int, type(None))) or isinstance(value, bool) or value not in known:
        raise InputError(f"{what} is {value!r}; known: {', '.join(map(str, known))}")


@dataclass(frozen=True)
class MarkerQuality:
    """Knobs of making a marker of splats: how its rectangles become Gaussians.

    More Gaussians follow sharp edges better and cost time in every picture. `fs.marker` takes these that it
    is not given, and so do the markers of scene files and `fidsplat marker`.

    Raises:
        InputError: a value lies outside its range; the message names the range.
    """

    mixture: str = "exact"
    """`exact`: one box per rectangle, with edges that the pixel filters; opaque and clean at any distance.
    `fitted`: Gaussians by templates optimised for whole markers, which files hold and other renderers draw.
    `facets`: Gaussians in planes that cross along the edges of modules; opaque and sharp, but only where the
    order is by depth at each pixel. `paper`: Gaussians by the construction of the paper's section 3.2."""

    levels: int = 4
    """Of `paper`: L, 1 to 8; 2^(L+2) - 7 Gaussians a rectangle at density 1, edges blurred over 2^-L half
    widths."""

    density: int = 3
    """Of `paper`: copies of all levels but the last, 1 to 100: opaque insides against more to blend."""

    growth: float | None = None
    """Modules, 0 to 1, by which a rectangle reaches into its own colour across shared sides (a long one
    further along its axis): closes seams, and rounds what lies behind. None: what the mixture was made with
    (0.4 for fitted, 0 for paper)."""

    template: int = 25
    """Of `fitted`, and of the Gaussians that stand for `exact` in files: Gaussians of a rectangle up to an
    aspect ratio of 6, one of `TEMPLATE_SIZES`: 1, 5, 9, 13, 25, 41, 121 or 562. Fewer are drawn faster and
    leave edges blurred and corners round; 562 are opaque and clean, under a low-pass from 24 px a module on;
    121 are to be refined (`fs.train.refine`)."""

    def __post_init__(self) -> None:
        _one_of("marker quality: mixture", self.mixture, MIXTURES)
        whole_number("marker quality: levels", self.levels, 1, MAX_LEVELS)
        whole_number("marker quality: density", self.density, 1, MAX_DENSITY)
        _one_of("marker quality: template", self.template, TEMPLATE_SIZES)
        growth = self.growth
        if growth is not None and not (isinstance(growth, Real) and 0 <= growth <= 1):
            raise InputError(f"marker quality: growth is {growth!r}; it must lie from 0 to 1 module")


@dataclass(frozen=True)
class Quality:
    """Knobs of one rendering. What they leave out of an image has no bound that holds for every scene: the
    output `error` bounds it for one frame (docs/accuracy.md).

    Raises:
        InputError: a value lies outside its range; the message names the range.
    """

    alpha_cutoff: float = 1e-5
    """Alpha, in (0, 1), default 1e-5: contributions below it are not drawn. It sets each splat's radius:
    R^2 = 2 ln(opacity / cutoff), the same R in bounds and in the per-pixel test. Lower costs area, higher
    bites rims and haze: at 1/255, as other systems have it, pictures are off by 0.018 where splats overlap,
    and 100 layers of alpha 0.0039 lose 32 % opacity (docs/accuracy.md)."""

    transmittance_stop: float = 1e-4
    """Transmittance, in [0, 1), default 1e-4: a pixel is finished once its own is at or below this, and what
    lies behind changes it by that much at most. Higher saves the splats behind opaque ones; 0 never stops."""

    stop_rule: str = "inclusive"
    """`inclusive`: the fragment that reaches the stop is still drawn. `exclusive` (gsplat, 2DGS authors): it
    is dropped, which leaks up to 1 % of the background through opaque splats; kept for parity only."""

    opacity_ceiling: float = 1.0
    """Alpha, in (0, 1], default 1: upper bound of one fragment's. gsplat and the 2DGS authors use 0.99, which
    keeps their gradients finite and lets 1 % of the background through; it saves no time."""

    lowpass: str = "screen"
    """`screen`: the object-space low-pass of 2DGS (a Gaussian of sigma 0.707 px around the projected centre,
    the larger of the two weights wins); for scenes that were trained with it, as 2DGS scenes are. `pixel`:
    each splat convolved in its plane with a Gaussian of a sample's footprint (sigma 0.5 samples), its opacity
    scaled by the ratio of the areas, so that it conserves energy; for splats far below a pixel. `none`: the
    exact splat; for markers of Gaussians, with several samples per pixel. Boxes filter themselves."""

    ellipsoid: str = "ewa"
    """How 3D Gaussians are drawn. `ewa`: as 3DGS and gsplat draw them, an ellipse around the centre's image,
    widened by 0.3 square pixels, at the centre's depth; captures look as they did to their trainers.
    `ewa_antialiased`: their opacity falls as they are widened (Mip-Splatting), for captures trained so.
    `exact`: the largest value along each ray and the depth where it is, under `lowpass`; true near the camera
    and at wide angles, as 3DGUT and ray tracers have it (docs/primitives.md). Lenses with distortion,
    fisheyes and panoramas have `exact` always."""

    order: str = "auto"
    """By which depth what overlaps is composited. `pixel`: each fragment by its own, where the ray meets its
    splat; splats that are printed on one plane (markers) are one layer, whose colour depends on no order.
    `centre`: every splat by the depth of its centre, as other renderers do and captured scenes were trained;
    large splats swap places as the camera turns. `auto`: `pixel` where splats are printed on planes, `centre`
    elsewhere (docs/correctness.md says why)."""

    samples: int = 1
    """n, 1 to 8, default 1: each pixel is the mean of n x n samples on a regular grid. More smooth edges, and
    cost n^2 times the blending."""

    detail_error: float = 0.0
    """Of stores: largest error of rgb where cells of splats are drawn as one, in [0, 1), on the views that
    were measured with the store, this low-pass and an `alpha_cutoff` of 1e-8. It is not a bound for every
    view: others may exceed it, the more with a larger cut-off (docs/large-scenes.md). 0 is the exact scene.
    Scenes in memory are always exact."""

    first_hit: float = 0.1
    """Opacity at which the outputs depth_first and distance_first see a surface, (0, 1): the first fragment
    or layer behind which the transmittance is at most 1 less this."""

    setup_precision: str = "float64"
    """Arithmetic of the per-splat set-up. `float32` is also what a device without float64 uses; it moves
    small and grazing splats (docs/correctness.md), and saves time on devices whose float64 is slow."""

    arithmetic: str = "fast"
    """Exponentials and logarithms of blending. `fast`: our own polynomials, bit-identical wherever devices
    fuse multiply-adds (images are not: compilers decide on the rest); exponentials within 2.3 units of the
    last place, logarithms within 1.1. `precise`: the library's, of which OpenCL promises 3. Colours
    differ by less than 1e-6, and by the stop at most where a pixel reaches it a splat earlier."""

    blend_precision: str = "float32"
    """Arithmetic of each fragment: crossing, weight and blending. `float64`: a device's truth picture, many
    times slower, whose arithmetic is always precise; needs float64 in the device and in the set-up."""

    marker: MarkerQuality = field(default_factory=MarkerQuality)
    """How markers become splats."""

    def __post_init__(self) -> None:
        for knob in fields(self):
            value = getattr(self, knob.name)
            if isinstance(value, np.generic):  # as `own_scalars`, but a quality loads no other module
                object.__setattr__(self, knob.name, value.item())

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
                raise InputError(
                    f"quality: {name} is {value!r}; it must lie in {left}{low:g}, {high:g}{right}"
                )

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
        if not isinstance(self.marker, MarkerQuality):
            raise InputError(f"quality: marker is {self.marker!r}; it must be an fs.MarkerQuality(...)")
        if self.blend_precision == "float64" and self.setup_precision != "float64":
            raise InputError(
                "quality: blend_precision='float64' means nothing after a set-up in float32; use "
                "setup_precision='float64' with it"
            )
        if self.stop_rule == "exclusive" and self.order != "centre":
            raise InputError(
                f"quality: order is {self.order!r}, but the exclusive stop drops single splats, which a "
                "printed plane has not at a pixel; use order='centre' with it"
            )
        whole_number("quality: samples", self.samples, 1, MAX_SAMPLES)

    @classmethod
    def named(cls, name: str) -> Quality:
        """The preset of that name: standard, fast, reference, gsplat or surfel."""
        if isinstance(name, str) and name in PRESETS:
            return PRESETS[name]
        raise InputError(unknown("quality", name, PRESETS))

    @classmethod
    def of(cls, quality: Quality | str | None) -> Quality:
        """A `Quality` from itself, from text, or the default from None.

        Text is a preset's name, knobs as key=value, or both: "fast", "alpha_cutoff=1e-3",
        "fast,samples=2,marker.template=9". Without a name the knobs are changed in standard.

        Raises:
            InputError: an unknown preset or knob, or a value that it cannot have.
        """
        if quality is None:
            return PRESETS["standard"]
        if isinstance(quality, cls):
            return quality
        if not isinstance(quality, str):
            raise InputError(f"quality is {quality!r}; it must be an fs.Quality or text")
        first, *rest = (part.strip() for part in quality.split(","))
        chosen = PRESETS["standard"] if "=" in first else cls.named(first)
        changes: dict[str, Any] = {}
        for part in [first, *rest] if "=" in first else rest:
            name, equals, value = (piece.strip() for piece in part.partition("="))
            if not equals:
                raise InputError(f"quality: {part!r} must be a knob as key=value, e.g. alpha_cutoff=1e-3")
            if name.startswith("marker."):
                own = name.removeprefix("marker.")
                changes.setdefault("marker", {})[own] = _read(MarkerQuality, own, value)
            else:
                changes[name] = _read(cls, name, value)
        return chosen.with_(**changes)

    def with_(self, **changes) -> Quality:
        """A copy with some knobs changed; an unknown knob is an error that names the known ones.

        marker: a `MarkerQuality`, or a dict of those of its knobs that change.
        """
        for name in changes:
            _check_known(Quality, name)
        marker = changes.get("marker")
        if isinstance(marker, dict):
            for name in marker:
                _check_known(MarkerQuality, name)
            changes["marker"] = replace(self.marker, **marker)
        return replace(self, **changes)


def knobs(kind: type[Quality] | type[MarkerQuality]) -> dict[str, str]:
    """Type of every knob that is a single value, as it is written: `float`, `int | None` ..."""
    return {knob.name: str(knob.type) for knob in fields(kind) if knob.name != "marker"}


def _check_known(kind: type[Quality] | type[MarkerQuality], name: str) -> None:
    known = [knob.name for knob in fields(kind)]
    if name not in known:
        whose = "marker quality" if kind is MarkerQuality else "quality"
        raise InputError(unknown(f"knob of {whose}", name, known))


def _read(kind: type[Quality] | type[MarkerQuality], name: str, text: str) -> Any:
    """A knob's value from text."""
    if name == "marker":
        raise InputError("quality: marker has knobs of its own; write e.g. marker.template=9")
    _check_known(kind, name)
    wanted = knobs(kind)[name]
    if wanted.endswith("| None") and text.lower() == "none":
        return None
    convert = {"float": float, "int": int, "str": str}[wanted.split()[0]]
    try:
        return convert(text)
    except ValueError:
        what = "a whole number" if convert is int else "a number"
        raise InputError(f"quality: {name} is {text!r}; it must be {what}") from None


# gsplat: gsplat 1.5/1.6 `rasterization_2dgs`; surfel: the 2DGS authors' diff-surfel-rasterization.
# Both clamp alpha at 0.99, cut at 1/255 and drop the fragment that would take T below 1e-4. What differs
# between them (bounding boxes, low-pass centre, near plane) is a defect of theirs, not a constant: see
# docs/conventions.md.
_PARITY = Quality(
    alpha_cutoff=1.0 / 255.0,
    transmittance_stop=1e-4,
    opacity_ceiling=0.99,
    stop_rule="exclusive",
    order="centre",
    arithmetic="precise",
)

# standard: of the qualities that docs/accuracy.md measures the cheapest whose largest error is at most 1/512
# on every scene, the hard cases included; in fast arithmetic, which is cheaper on CPUs and at most 1 % slower
# on GPUs
PRESETS: dict[str, Quality] = {
    "standard": Quality(),
    "fast": Quality(alpha_cutoff=2.0 / 255.0, transmittance_stop=1.0 / 256.0, setup_precision="float32"),
    "reference": Quality(alpha_cutoff=1e-6, transmittance_stop=0.0, arithmetic="precise"),
    "gsplat": _PARITY,
    "surfel": _PARITY,
}
