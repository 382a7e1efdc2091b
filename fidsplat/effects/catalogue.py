"""Declarations of all effects and output images by name. Backends map the names to kernel code.

A frame has exactly one camera, color, lowpass, stop, order, footprint, background and arithmetic effect, at
most one ellipsoid effect, and any number of outputs and of steps after blending.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

DISPLAYS = ("color", "depth", "normal", "label", "count")


@dataclass(frozen=True)
class Output:
    """An output image: shape (h, w) if channels is 1, else (h, w, channels)."""

    name: str
    channels: int
    dtype: str
    summary: str = ""
    """line for `fidsplat render --help`"""
    display: str = "color"
    """how image files and previews represent it, one of `DISPLAYS`; files contain the array too, except for
    color and normal"""
    tolerance: float = 0.0
    """largest error of a device that tests allow, in addition to the reference's error bound of a pixel
    (`error_bound_NAME`)"""
    relative: bool = False
    """whether the tolerance is relative to the value"""
    discontinuous: bool = False
    """whether rounding can change the value by a jump, e.g. by another order of fragments: pixels that the
    reference marks by `NAME_may_flip` are not compared; others may differ by the tolerance or `NAME_bound`"""
    empty_value: int = 0
    """value of a pixel without splats"""
    public: bool = True
    """whether captures can request it; False for outputs of measurement and training"""

    @property
    def as_array(self) -> bool:
        """Whether files contain the array in addition to a PNG image."""
        return self.display not in ("color", "normal")


@dataclass(frozen=True)
class Effect:
    """Declaration of an effect."""

    name: str
    output: Output | None = None
    needs: tuple[str, ...] = ()
    """outputs from which this output is computed"""


def _image(
    name: str, summary: str = "", *, channels: int = 1, dtype: str = "float32", needs: str = "", **fields: Any
) -> Effect:
    return Effect(name, Output(name, channels, dtype, summary, **fields), (needs,) if needs else ())


_COLOR: dict[str, Any] = {"tolerance": 2e-5}
_NORMAL: dict[str, Any] = {"channels": 3, "display": "normal", "tolerance": 2e-5}
_DEPTH: dict[str, Any] = {"display": "depth", "tolerance": 1e-4, "relative": True}
_FRAGMENT_DEPTH: dict[str, Any] = _DEPTH | {"discontinuous": True}
_ID: dict[str, Any] = {"dtype": "int32", "display": "label", "discontinuous": True, "empty_value": -1}

_WITHOUT_OUTPUT = (
    *("camera_pinhole", "camera_brown_conrady", "camera_fisheye", "camera_equirectangular"),
    *("camera_orthographic", "color_rgb", "color_sh", "lowpass_none", "lowpass_pixel", "lowpass_screen"),
    *("stop_inclusive", "stop_exclusive", "order_centre", "order_pixel", "order_coplanar"),
    "order_coplanar_pixel",
    *("footprint_gaussian", "footprint_box", "footprint_mixed"),
    *("ellipsoid_exact", "ellipsoid_ewa", "ellipsoid_ewa_antialiased", "ellipsoids_only"),
    *("background_constant", "background_gradient", "background_panorama"),
    *("arithmetic_precise", "arithmetic_fast", "arithmetic_approximate"),
    # optional
    *("external_depth", "motion_groups", "shutter_exposure", "sub_frame_culling", "blend_double"),
    "blend_half",
    "termination_depths",
    # steps after blending
    *("fog", "decode_srgb", "veiling_glare", "exposure", "vignetting", "noise", "saturation", "gain"),
    "white_balance",
    *("response_gamma", "response_srgb", "response_table", "quantise"),
)
_IMAGES = (
    _image("alpha", "coverage, 1 - transmittance", **_COLOR),
    _image(
        "depth", "expected depth [m] along z (fisheye, panorama: ray); 0 where alpha is below 1/255", **_DEPTH
    ),
    _image("depth_median", "depth [m] at which transmittance falls to 1/2", **_FRAGMENT_DEPTH),
    _image("depth_first", "depth [m] at which opacity reaches the quality's first_hit", **_FRAGMENT_DEPTH),
    _image("distance", "expected distance along the ray [m]", needs="depth", **_DEPTH),
    _image("distance_median", "distance [m] of depth_median", needs="depth_median", **_FRAGMENT_DEPTH),
    _image("distance_first", "distance [m] of depth_first", needs="depth_first", **_FRAGMENT_DEPTH),
    _image("normal", "unit normal towards the camera, in camera axes", **_NORMAL),
    _image("normal_world", "unit normal towards the camera, in world axes", needs="normal", **_NORMAL),
    _image("label", "label of the splat with the largest weight, or -1", **_ID),
    _image("splat_id", "index of the splat with the largest weight, or -1", **_ID),
    _image("blended", "number of composited splats", dtype="int32", display="count", discontinuous=True),
    _image("overdraw", dtype="int32", display="count", public=False),
    _image("distortion", public=False),
    _image("rounding", public=False),
)

CATALOGUE: dict[str, Effect] = {effect.name: effect for effect in (*map(Effect, _WITHOUT_OUTPUT), *_IMAGES)}

RGB = Output("rgb", 3, "float32", "colour in display space, not clamped above 1", **_COLOR)
IMAGES: dict[str, Output] = {
    "rgb": RGB,
    **{effect.output.name: effect.output for effect in CATALOGUE.values() if effect.output},
}
"""all output images of backends"""
OUTPUTS = {name: output for name, output in IMAGES.items() if output.public}
"""outputs that backends render and captures can request"""
DERIVED_OUTPUTS = {
    "error": Output(
        "error", 1, "float32", "certified upper bound of the error of rgb (docs/accuracy.md)", "count"
    ),
}
"""outputs that the host computes from two rendered images (fidsplat/render/certified_error.py)"""


def declared_output(name: str) -> Output:
    """Declaration of an output, including internal outputs."""
    effect = CATALOGUE.get(name)
    return effect.output if effect is not None and effect.output else {"rgb": RGB, **DERIVED_OUTPUTS}[name]
