"""Quality settings that trade accuracy for time, and their presets; independent of the device."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from numbers import Real
from typing import Any

from fidsplat.util.arguments import as_float, instance, invalid, parse_setting, python_scalars, whole_number
from fidsplat.util.errors import InputError, unknown

LOWPASS = ("screen", "pixel", "none")
STOP_RULES = ("inclusive", "exclusive")
ELLIPSOID = ("exact", "ewa", "ewa_antialiased")
ORDERS = ("auto", "pixel", "centre")
PROJECTION_PRECISIONS = ("float64", "float32")
ARITHMETIC = ("precise", "fast", "approximate")
BLEND_PRECISIONS = ("float32", "float16", "float64")
MAX_SAMPLES = 8
MIXTURES = ("exact", "fitted", "paper", "facets")
BY_FORMULA = LADDER, NESTED = 121, 562
"""numbers of Gaussians of the two templates that fidsplat/markers/mixture.py computes"""
TEMPLATE_SIZES = (1, 5, 9, 13, 25, 41, *BY_FORMULA)
"""supported numbers of Gaussians per rectangle; the others are in fidsplat/markers/templates.json"""
MAX_LEVELS, MAX_DENSITY = 8, 100


def _one_of(what: str, value: Any, choices: tuple) -> None:
    if not isinstance(value, (str, int, type(None))) or isinstance(value, bool) or value not in choices:
        raise invalid(what, f"one of {', '.join(map(str, choices))}", value)


@dataclass(frozen=True)
class MarkerQuality:
    """Quality settings of the conversion of markers to splats.

    More Gaussians reproduce edges more sharply and increase the time of each frame. The defaults apply to
    `fs.marker`, markers of scene files and `fidsplat marker`.

    Raises:
        InputError: a value is out of range.
    """

    mixture: str = "exact"
    """`exact`: one box splat per rectangle, with antialiased edges; opaque and sharp at any distance.
    `fitted`: Gaussians by templates optimised on complete markers; for splat files and other renderers.
    `facets`: Gaussians in planes that intersect along the edges of modules; opaque and sharp, but only with
    `order="pixel"`. `paper`: Gaussians as in the paper's section 3.2."""

    levels: int = 4
    """Levels L of `paper`, 1 to 8: 2^(L+2) - 7 Gaussians per rectangle at density 1; edges are blurred over
    2^-L of the half width."""

    density: int = 3
    """Copies of each level of `paper` except the last, 1 to 100: more copies are more opaque and slower."""

    growth: float | None = None
    """Modules, 0 to 1, by which a rectangle extends into neighbours of the same colour, more along its longer
    axis. It closes gaps and rounds corners. None: 0.4 for fitted, 0 for paper."""

    template: int = 25
    """Gaussians per rectangle with an aspect ratio up to 6 in `fitted`, and in splat files of `exact`: 1, 5,
    9, 13, 25, 41, 121 or 562. Fewer render faster, with blurred edges and round corners. 562 are opaque and
    sharp, with a low-pass filter from 24 pixels per module; 121 are an initial value for
    `fs.train.refine`."""

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
    """Quality settings of a frame. They do not bound the error in every scene; the output `error` bounds it
    in one frame (docs/accuracy.md).

    Raises:
        InputError: a value is out of range.
    """

    alpha_cutoff: float = 1e-5
    """Minimum alpha of a fragment, in (0, 1), default 1e-5. It determines the radius R of each splat in
    standard deviations, R^2 = 2 ln(opacity / cutoff). Lower values make splats larger and slower; higher
    values remove their faint rims: with 1/255, as in other renderers, images have errors of 0.018 where
    splats overlap, and 100 splats of alpha 0.0039 lose 32 % opacity (docs/accuracy.md)."""

    transmittance_stop: float = 1e-4
    """Transmittance at which a pixel terminates, in [0, 1), default 1e-4: the omitted splats would change the
    pixel by at most this. Higher values omit more occluded splats; 0 omits none."""

    stop_rule: str = "inclusive"
    """`inclusive`: the fragment that reaches the transmittance stop is composited. `exclusive` (gsplat, 2DGS
    authors): it is dropped, which leaks up to 1 % of the background through opaque splats; for parity
    only."""

    opacity_ceiling: float = 1.0
    """Maximum alpha of a fragment, in (0, 1], default 1. gsplat and the 2DGS authors use 0.99 for finite
    gradients, which leaks 1 % of the background and saves no time."""

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
    of captured scenes; large splats pop when the camera rotates. `pixel`: by the depth of each fragment, the
    intersection of ray and splat. `auto`: as `centre`, but coplanar groups (markers) are ordered by their
    depth at each pixel. In `pixel` and `auto` a coplanar group is one layer without an order
    (docs/correctness.md)."""

    samples: int = 1
    """Samples per pixel side, 1 to 8, default 1: a pixel is the mean of n x n samples on a regular grid.
    Blending takes n^2 times as long."""

    detail_error: float = 0.0
    """Error of rgb allowed for levels of detail of stores, in [0, 1), as measured on sample views of the
    store with this low-pass filter and an `alpha_cutoff` of 1e-8. Other views and larger cut-offs may exceed
    it (docs/large-scenes.md). 0 renders all splats. Scenes in memory have no levels of detail."""

    first_hit: float = 0.1
    """Accumulated opacity of the surface in depth_first and distance_first, in (0, 1): the first fragment or
    layer after which the transmittance is at most 1 - first_hit."""

    projection_precision: str = "float64"
    """Arithmetic of the per-splat projection. `float32` shifts small and grazing splats
    (docs/correctness.md) and saves time on devices with slow float64. Devices without float64 always use
    it."""

    arithmetic: str = "fast"
    """Exponentials and logarithms of blending. `fast`: polynomials, within 2.3 ulp for exponentials and 1.1
    for logarithms, bit-identical on devices with fused multiply-adds. `precise`: the device library's, 3 ulp
    in OpenCL. Colours differ by less than 1e-6, or by the transmittance stop if a pixel terminates one splat
    earlier. `approximate`: as `fast`, but exponentials by NVIDIA's GPUs through OpenCL, within 1e-6; images
    are no longer bit-identical to those of other devices."""

    blend_precision: str = "float32"
    """Arithmetic of fragments. `float16` sums colours and transmittance in half precision, always with
    approximate arithmetic: faster on NVIDIA's GPUs, slower on others; n fragments with colours up to 1 change
    a pixel by at most (n + 3) / 2048. `float64` computes intersection, weight and blending in float64, for
    reference images: many times slower, always with precise arithmetic; requires OpenCL with float64 or
    the device `reference`, `projection_precision="float64"`, and a pinhole or orthographic camera. Fog
    requires `float32`."""

    marker: MarkerQuality = field(default_factory=MarkerQuality)
    """Conversion of markers to splats."""

    def __post_init__(self) -> None:
        python_scalars(self)
        for name, interval in (
            ("alpha_cutoff", "(0, 1)"),
            ("transmittance_stop", "[0, 1)"),
            ("opacity_ceiling", "(0, 1]"),
            ("first_hit", "(0, 1)"),
            ("detail_error", "[0, 1)"),
        ):
            value = as_float(getattr(self, name))
            excluded = (value == 0 and interval[0] == "(") or (value == 1 and interval[-1] == ")")
            if excluded or not 0 <= value <= 1:
                raise InputError(f"quality: {name} must be in {interval}, got {getattr(self, name)!r}")
        for name, choices in (
            ("stop_rule", STOP_RULES),
            ("lowpass", LOWPASS),
            ("ellipsoid", ELLIPSOID),
            ("order", ORDERS),
            ("projection_precision", PROJECTION_PRECISIONS),
            ("arithmetic", ARITHMETIC),
            ("blend_precision", BLEND_PRECISIONS),
        ):
            _one_of(f"quality: {name}", getattr(self, name), choices)
        instance("quality: marker", self.marker, MarkerQuality, "an fs.MarkerQuality")
        if self.blend_precision == "float64" and self.projection_precision != "float64":
            raise InputError(
                "quality: projection_precision must be 'float64' with blend_precision='float64', got "
                "'float32'; leave it out"
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
        "fast,samples=2,marker.template=9". Settings without a name change the preset standard.

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
        base = PRESETS["standard"] if "=" in first else cls.named(first)
        changes: dict[str, Any] = {}
        for part in [first, *rest] if "=" in first else rest:
            name, equals, value = (piece.strip() for piece in part.partition("="))
            if not equals:
                raise InputError(
                    f"quality must be settings as key=value, e.g. alpha_cutoff=1e-3, got {part!r}"
                )
            if name.startswith("marker."):
                setting = name.removeprefix("marker.")
                changes.setdefault("marker", {})[setting] = _read(MarkerQuality, setting, value)
            else:
                changes[name] = _read(cls, name, value)
        return base.with_(**changes)

    def with_(self, **changes) -> Quality:
        """A copy with some settings changed. marker: a `MarkerQuality`, or a dict of changed settings."""
        for name in changes:
            _check_known(Quality, name)
        marker = changes.get("marker")
        if isinstance(marker, dict):
            for name in marker:
                _check_known(MarkerQuality, name)
            changes["marker"] = replace(self.marker, **marker)
        return replace(self, **changes)


def setting_types(kind: type[Quality] | type[MarkerQuality]) -> dict[str, str]:
    """Annotated type of each scalar setting by name, such as `float` or `int | None`."""
    return {setting.name: str(setting.type) for setting in fields(kind) if setting.name != "marker"}


def _check_known(kind: type[Quality] | type[MarkerQuality], name: str) -> None:
    names = [setting.name for setting in fields(kind)]
    if name not in names:
        whose = "marker quality" if kind is MarkerQuality else "quality"
        raise InputError(unknown(f"setting of {whose}", name, names))


def _read(kind: type[Quality] | type[MarkerQuality], name: str, text: str) -> Any:
    """Parse the value of a setting."""
    if name == "marker":
        raise InputError(
            f"quality: marker must be given by its settings, e.g. marker.template=9, got marker={text}"
        )
    _check_known(kind, name)
    return parse_setting("quality", kind, name, text)


# gsplat: `rasterization_2dgs` of gsplat 1.5 and 1.6; surfel: diff-surfel-rasterization of the 2DGS authors.
# Both clamp alpha at 0.99, cut at 1/255 and drop the fragment whose transmittance would be below 1e-4. Their
# defects in bounding boxes, low-pass centre and near plane are not reproduced (devlog/hard-cases.md).
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
    "fast": Quality(alpha_cutoff=2.0 / 255.0, transmittance_stop=1.0 / 256.0, projection_precision="float32"),
    "reference": Quality(alpha_cutoff=1e-6, transmittance_stop=0.0, arithmetic="precise"),
    "gsplat": _PARITY,
    "surfel": _PARITY,
}
