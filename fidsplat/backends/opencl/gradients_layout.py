"""What host and kernels both know of derivatives, declared once: as layout.py, for the program `gradients`.

A kernel's argument `by_NAME` holds a loss's derivatives by NAME.
"""

from __future__ import annotations

from dataclasses import dataclass

from fidsplat.backends.opencl.declare import Argument, Member, Record, member, takes

MOMENTS = Record(
    "Moments",
    (
        member("float nu0 nux nuy", "by n_u: its derivatives times 1, x, y, summed over a tile"),
        member("float nv0 nvx nvy"),
        member("float d0 dx dy"),
        member("float log_opacity"),
        member("float r g b"),
    ),
    alignment=16,  # as few lines of a cache as can be
)
"""What a tile adds to the derivatives by a splat's record."""


@dataclass(frozen=True)
class BackwardLayout:
    """How OpenCL lays out an effect's derivatives."""

    file: str = ""
    """below kernels/opencl/; empty: no text of its own"""
    moments: tuple[Member, ...] = ()
    blend_backward: tuple[Argument, ...] = ()
    project_backward: tuple[Argument, ...] = ()


_SIZE = takes("int width height  // of the picture")
_TILES = takes("in uint2 windows", "uint big_capacity", "in Bounds big_bounds", _SIZE)
_RESERVED = takes(
    *("uint count", "in uint keys", _TILES),
    "out uint splat_slots  // (n): the first of a splat's, which has one for each of its tiles",
    "out uint reserved  // how many there are",
)

_BLENDED = takes(
    "wide log_cut ceiling stop filter",
    *("float log_ceiling", "float background_r background_g background_b"),
    *("int stride  // of the padded picture", "uint channel_stride", "in float by_rgb  // (h, w, 3)"),
)

KERNELS: dict[str, tuple[Argument, ...]] = {
    "reserve_slots": takes(
        *(_RESERVED, "out uint big_rows  // (rows of tiles, big splats): tiles above, less the first column"),
    ),
    "blend_backward": takes(
        *(
            "in Splat splats",
            "in uint lists starts",
            "in uint2 windows",
            "uint big_capacity",
            _SIZE,
            "in uint splat_slots big_rows",
        ),
        _BLENDED,
        "out float checkpoints  // tiles' transmittances in front of every CHUNK splats",
        "out float moments  // of the record Moments, by slots",
        "out real tile_sums  // (tiles, 3) by the background",
        "out float tapes  // a Tape for each work-item",
        "out uint reserved  // its second word: tiles that are taken",
    ),
    "project_backward": takes(
        *("uint count", "in View view", "cloud float means quats scales opacities"),
        *("in Splat splats", "in uint keys", _TILES, "in uint splat_slots", "in float moments"),
        "out float by_means  // (n, 3)",
        "out float by_quats  // (n, 4)",
        "out float by_scales  // (n, 2)",
        "out float by_opacities  // (n)",
        "out float screen  // (n)",
        "out real group_sums  // (work-groups, 6) by the pose",
    ),
    "project_step": takes(
        *("uint count", "in View view", "in Splat splats", "in uint keys", _TILES),
        *("in uint splat_slots", "in float moments"),
        "int counted move sparse  // sparse: splats that the picture does not depend on rest",
        "uint all  // coefficients of a splat",
        "float beta1 beta2 rest1 rest2 root epsilon",
        "float size_means size_scales size_quats size_logits  // rates of this step",
        "float size_sh size_rest  // of degree 0 and above",
        "float scale_penalty opacity_penalty",
        "out float gradients",
        "out float means first_means second_means",
        "out float log_scales first_log_scales second_log_scales",
        "out float quats first_quats second_quats",
        "out float logits first_logits second_logits",
        "out float sh first_sh second_sh",
        "out float drawn_quats drawn_scales drawn_opacities drawn_sh",
    ),
    "add_up": takes(
        *("uint tiles groups", "in real tile_sums group_sums  // (tiles, 3), (groups, 6)"),
        "out float background pose",
    ),
}

GROUP_KERNELS: dict[str, tuple[Argument, ...]] = {
    "reserve_slots": _RESERVED,
    "blend_light": takes(
        *("in Splat splats", "in uint lists starts", _SIZE, _BLENDED),
        "out float checkpoints  // of each pixel of CHUNK splats: light in front, its worth behind",
        "out uint reached  // (tiles) chunks that light comes to",
        "out uint chunk_tiles  // the tiles of chunks",
        "out real tile_sums  // (tiles, 3) by the background",
    ),
    "blend_backward": takes(
        *("in Splat splats", "in uint lists starts", _TILES, "in uint splat_slots", _BLENDED),
        *("in float checkpoints", "in uint reached chunk_tiles"),
        "out float moments  // of the record Moments, by slots",
    ),
}
"""Where work-groups share a tile."""

LAYOUTS: dict[str, BackwardLayout] = {
    "camera_pinhole": BackwardLayout(),
    "color_rgb": BackwardLayout(
        "slot/color_rgb_backward.cl", project_backward=takes("out float by_colors  // (n, 3)")
    ),
    "color_sh": BackwardLayout(
        "slot/color_sh_backward.cl",
        project_backward=takes(
            "cloud float sh  // (n, (SH_DEGREE + 1)^2, 3)", "out float by_sh  // the same shape"
        ),
    ),
    "lowpass_none": BackwardLayout("slot/lowpass_none_backward.cl"),
    "lowpass_screen": BackwardLayout(
        "slot/lowpass_screen_backward.cl", moments=(member("float dot_x dot_y", "by the dot's place"),)
    ),
    "stop_exclusive": BackwardLayout("slot/stop_exclusive_backward.cl"),
    "ray_depth": BackwardLayout(
        "part/ray_depth_backward.cl", moments=(member("float z_numerator z_center"),)
    ),
    "alpha": BackwardLayout("output/alpha_backward.cl", blend_backward=takes("in float by_alpha  // (h, w)")),
    "depth": BackwardLayout(
        "output/depth_backward.cl",
        blend_backward=takes("in float depth_raw  // 2 channels", "in float by_depth  // (h, w)"),
    ),
    "distortion": BackwardLayout(
        "output/distortion_backward.cl",
        blend_backward=takes("in float distortion_raw  // 4 channels", "in float by_distortion  // (h, w)"),
    ),
    "normal": BackwardLayout(
        "output/normal_backward.cl",
        moments=(member("float nx ny nz"),),
        blend_backward=takes("in float normal_raw  // 3 channels", "in float by_normal  // (h, w, 3)"),
    ),
}
"""How each effect's derivatives are laid out; those that add nothing are not named."""
