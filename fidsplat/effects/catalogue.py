"""Every effect: its kernel file and what it adds to the records, buffers and outputs.

A slot is filled by exactly one effect of its kind (camera, color, lowpass, stop, compose, footprint,
background, arithmetic); taps are extra planes and posts steps after blending, any number of them; parts are
what several of them share. The sections of an effect's kernel file say where its text goes
(kernels/README.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Output:
    """A plane of the finished frame: shape (h, w) if channels is 1, else (h, w, channels)."""

    name: str
    channels: int
    dtype: str
    public: bool = True
    """False: for measuring only; users cannot ask for it."""


@dataclass(frozen=True)
class Effect:
    """One effect as data."""

    name: str
    file: str
    """Path below kernels/<dialect>/."""
    record_lanes: int = 0
    """32-bit words that it adds to the record of a visible splat."""
    record_whole: bool = False
    """Whether these are integers: other words are wider where fragments are computed in double."""
    bounds_lanes: int = 0
    """32-bit words that it adds to the bounds of a visible splat."""
    inputs: tuple[str, ...] = ()
    """Arrays of the cloud, and those made from it for each view, that the projection reads for it, in the
    order of its kernel arguments."""
    planes: tuple[int, ...] = ()
    """Sample planes in each buffer between blending and resolving, in the order of its kernel arguments."""
    output: Output | None = None
    parts: tuple[str, ...] = ()
    """Names of the effects that it needs: parts, or taps whose planes it reads."""
    view_inputs: tuple[str, ...] = ()
    """Which of `inputs` belong to the view, not to the cloud."""
    blend_inputs: tuple[str, ...] = ()
    """Arrays of the view that blending reads for it, in the order of its kernel arguments."""
    blend_uniforms: tuple[str, ...] = ()
    """Numbers of the view (`View.uniform`) that blending needs for it; they stand before its planes."""
    resolve_uniforms: tuple[str, ...] = ()
    """The same for resolving; they stand before its arrays."""
    resolve_arrays: tuple[str, ...] = ()
    """Arrays of the view (`View.array`) that resolving needs for it; they stand before its planes."""
    resolve_inputs: tuple[str, ...] = ()
    """The same of those that are on the device already."""
    backdrop_uniforms: tuple[str, ...] = ()
    """As `resolve_uniforms`, for what is seen behind everything (slot/world_ray.cl); then its arrays."""
    backdrop_arrays: tuple[str, ...] = ()
    backdrop_inputs: tuple[str, ...] = ()
    averaged: bool = False
    """Whether its planes are light: the mean of what several shots leave, not one shot's."""
    behind: Mapping[str, str] = field(default_factory=dict, hash=False)
    """By the name of a camera slot: the part that takes this part's place there."""


_OWN_RAYS = ("camera_brown_conrady", "camera_fisheye", "camera_equirectangular")
_EFFECTS = (
    Effect("camera_pinhole", "slot/camera_pinhole.cl", parts=("perspective",)),
    Effect("camera_brown_conrady", "slot/camera_brown_conrady.cl", parts=("perspective", "ray_map", "rays")),
    Effect("camera_fisheye", "slot/camera_fisheye.cl", parts=("polygon", "ray_map", "rays")),
    Effect(
        "camera_equirectangular",
        "slot/camera_equirectangular.cl",
        parts=("polygon", "rays"),
    ),
    Effect("camera_orthographic", "slot/camera_orthographic.cl", record_lanes=4),
    Effect("perspective", "slot/perspective.cl"),
    Effect("polygon", "slot/polygon.cl"),
    Effect("ray_map", "slot/ray_map.cl", inputs=("ray_map",), view_inputs=("ray_map",)),
    Effect(
        "rays",
        "slot/rays.cl",
        record_lanes=6,
        inputs=("rays",),
        view_inputs=("rays",),
        blend_inputs=("rays",),
        backdrop_inputs=("rays",),
    ),
    Effect("motion_groups", "slot/motion_groups.cl", inputs=("labels", "moving"), view_inputs=("moving",)),
    Effect("shutter_exposure", "slot/shutter_exposure.cl"),
    Effect("shutter_rows", "slot/shutter_rows.cl"),
    Effect("color_rgb", "slot/color_rgb.cl", inputs=("colors",)),
    Effect("color_sh", "slot/color_sh.cl", inputs=("sh",)),
    Effect("lowpass_none", "slot/lowpass_none.cl"),
    Effect("lowpass_pixel", "slot/lowpass_pixel.cl", parts=("lowpass_none",)),
    Effect("lowpass_screen", "slot/lowpass_screen.cl", record_lanes=2, bounds_lanes=3),
    Effect("stop_inclusive", "slot/stop_inclusive.cl"),
    Effect("stop_exclusive", "slot/stop_exclusive.cl"),
    Effect("compose_ordered", "slot/compose_ordered.cl"),
    Effect(
        "compose_planes",
        "slot/compose_planes.cl",
        record_lanes=1,
        record_whole=True,
        inputs=("planes", "plane_keys"),
        view_inputs=("plane_keys",),
        parts=("ray_depth",),
    ),
    Effect("footprint_gaussian", "slot/footprint_gaussian.cl"),
    Effect("footprint_box", "slot/footprint_box.cl", parts=("box_edges",)),
    Effect(
        "footprint_mixed",
        "slot/footprint_mixed.cl",
        record_lanes=1,
        record_whole=True,
        inputs=("boxes",),
        parts=("box_edges",),
    ),
    Effect("box_cover", "slot/box_cover.cl"),
    Effect(
        "box_edges",
        "slot/box_edges.cl",
        record_lanes=4,
        parts=("box_cover",),
        behind=dict.fromkeys(_OWN_RAYS, "rays_box"),
    ),
    Effect(
        "rays_box",
        "slot/rays_box.cl",
        inputs=("ray_step",),
        view_inputs=("ray_step",),
        blend_inputs=("ray_slopes",),
        parts=("box_cover",),
    ),
    Effect("ray_depth", "slot/ray_depth.cl", record_lanes=3),
    Effect("shown", "slot/shown.cl"),
    Effect("alpha", "tap/alpha.cl", output=Output("alpha", 1, "float32")),
    Effect(
        "depth",
        "tap/depth.cl",
        planes=(2,),
        output=Output("depth", 1, "float32"),
        parts=("ray_depth", "shown"),
    ),
    Effect(
        "depth_median",
        "tap/depth_median.cl",
        planes=(1,),
        output=Output("depth_median", 1, "float32"),
        parts=("ray_depth", "shown"),
    ),
    Effect(
        "normal",
        "tap/normal.cl",
        record_lanes=3,
        planes=(3,),
        output=Output("normal", 3, "float32"),
        parts=("shown",),
    ),
    Effect(
        "label",
        "tap/label.cl",
        record_lanes=1,
        record_whole=True,
        inputs=("labels",),
        planes=(1, 1),
        output=Output("label", 1, "int32"),
        parts=("shown",),
    ),
    Effect(
        "overdraw",
        "tap/overdraw.cl",
        planes=(1,),
        output=Output("overdraw", 1, "int32", public=False),
    ),
    Effect("arithmetic_precise", "slot/arithmetic_precise.cl"),
    Effect("arithmetic_fast", "slot/arithmetic_fast.cl"),
    Effect("blend_double", "slot/blend_double.cl"),
    Effect("background_constant", "slot/background_constant.cl"),
    Effect(
        "background_gradient",
        "slot/background_gradient.cl",
        parts=("world_ray",),
        backdrop_uniforms=("gradient",),
    ),
    Effect(
        "background_panorama",
        "slot/background_panorama.cl",
        parts=("world_ray",),
        backdrop_uniforms=("panorama_size",),
        backdrop_arrays=("panorama",),
    ),
    Effect("ray", "slot/ray.cl", resolve_uniforms=("ray",)),
    Effect("turn", "slot/turn.cl", resolve_arrays=("turns",)),
    # rays of fisheyes and panoramas have a length of 1
    Effect("ray_length", "slot/ray_length.cl", behind={"camera_brown_conrady": "rays_length"}),
    Effect("rays_length", "slot/rays_length.cl"),
    Effect(
        "sample_length",
        "slot/sample_length.cl",
        parts=("ray", "ray_length"),
        behind={"camera_brown_conrady": "rays_sample_length"},
    ),
    Effect(
        "rays_sample_length",
        "slot/rays_sample_length.cl",
        parts=("rays_length",),
        resolve_inputs=("rays",),
    ),
    Effect("world_ray", "slot/world_ray.cl"),
    Effect(
        "fog",
        "tap/fog.cl",
        planes=(1,),
        parts=("ray_depth", "ray_length"),
        blend_uniforms=("fog_density", "ray"),
        averaged=True,
    ),
    Effect("exposure", "post/exposure.cl", resolve_uniforms=("exposure",)),
    Effect("vignetting", "post/vignetting.cl", resolve_uniforms=("vignette_center", "vignetting")),
    Effect("noise", "post/noise.cl", resolve_uniforms=("noise",)),
    Effect("gain", "post/gain.cl", resolve_uniforms=("gain",)),
    Effect("response_gamma", "post/response_gamma.cl", resolve_uniforms=("inverse_gamma",)),
    Effect("response_srgb", "post/response_srgb.cl"),
    Effect(
        "response_table",
        "post/response_table.cl",
        resolve_uniforms=("response_count",),
        resolve_arrays=("response",),
    ),
    Effect("quantise", "post/quantise.cl", resolve_uniforms=("quantise_steps",)),
    Effect(
        "depth_first",
        "tap/depth_first.cl",
        planes=(1,),
        output=Output("depth_first", 1, "float32"),
        parts=("ray_depth",),
        blend_uniforms=("first_light",),
    ),
    *(
        Effect(
            f"distance{kind}",
            f"tap/distance{kind}.cl",
            output=Output(f"distance{kind}", 1, "float32"),
            parts=(f"depth{kind}", "sample_length"),
        )
        for kind in ("", "_median", "_first")
    ),
    Effect(
        "normal_world",
        "tap/normal_world.cl",
        output=Output("normal_world", 3, "float32"),
        parts=("normal", "turn"),
    ),
    Effect(
        "splat_id",
        "tap/splat_id.cl",
        record_lanes=1,
        record_whole=True,
        inputs=("splat_ids",),
        planes=(1, 1),
        output=Output("splat_id", 1, "int32"),
        parts=("shown",),
    ),
    Effect("blended", "tap/blended.cl", planes=(1,), output=Output("blended", 1, "int32")),
)

CATALOGUE: dict[str, Effect] = {effect.name: effect for effect in _EFFECTS}
