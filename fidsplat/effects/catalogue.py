"""Every effect that a picture may call for, by name; how each backend draws it is the backend's own.

Of some kinds a picture has exactly one (camera, color, lowpass, stop, compose, footprint, background,
arithmetic), of ellipsoids one where there are any; of outputs and of steps after blending any number.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Output:
    """An output image: shape (h, w) if channels is 1, else (h, w, channels)."""

    name: str
    channels: int
    dtype: str
    public: bool = True
    """False: for measuring and training only; captures cannot ask for it."""


@dataclass(frozen=True)
class Effect:
    """One effect as data."""

    name: str
    output: Output | None = None
    needs: tuple[str, ...] = ()
    """other outputs that this one is made from"""


def _image(
    name: str, channels: int = 1, dtype: str = "float32", needs: str = "", public: bool = True
) -> Effect:
    return Effect(name, Output(name, channels, dtype, public), (needs,) if needs else ())


_PLAIN = (
    *("camera_pinhole", "camera_brown_conrady", "camera_fisheye", "camera_equirectangular"),
    *("camera_orthographic", "color_rgb", "color_sh", "lowpass_none", "lowpass_pixel", "lowpass_screen"),
    *("stop_inclusive", "stop_exclusive", "compose_ordered", "compose_pixel", "compose_coplanar"),
    *("footprint_gaussian", "footprint_box", "footprint_mixed"),
    *("ellipsoid_exact", "ellipsoid_ewa", "ellipsoid_ewa_antialiased", "ellipsoids_only"),
    *("background_constant", "background_gradient", "background_panorama"),
    *("arithmetic_precise", "arithmetic_fast"),
    # where a picture needs them
    *(
        "external_depth",
        "motion_groups",
        "shutter_exposure",
        "shutter_rows",
        "blend_double",
        "termination_depths",
    ),
    # steps after blending
    *("fog", "exposure", "vignetting", "noise", "gain"),
    *("response_gamma", "response_srgb", "response_table", "quantise"),
)
_IMAGES = (
    _image("alpha"),
    _image("depth"),
    _image("depth_median"),
    _image("normal", 3),
    _image("label", dtype="int32"),
    _image("overdraw", dtype="int32", public=False),
    _image("depth_first"),
    _image("distance", needs="depth"),
    _image("distance_median", needs="depth_median"),
    _image("distance_first", needs="depth_first"),
    _image("normal_world", 3, needs="normal"),
    _image("splat_id", dtype="int32"),
    _image("blended", dtype="int32"),
    _image("distortion", public=False),
    _image("rounding", public=False),
)

CATALOGUE: dict[str, Effect] = {effect.name: effect for effect in (*map(Effect, _PLAIN), *_IMAGES)}
