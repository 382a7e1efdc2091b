"""What the stages of drawing pass on and take, declared once: records, and the arguments of kernels.

The C structs and signatures of kernels/opencl/ are printed from this (assemble.py), and the host binds
arguments by these names (program.py). What effects and outputs add to both stands in
effect_layouts.py. Buffers are (channels, rows, columns) of the padded grid of samples, unless they say
otherwise.
"""

from __future__ import annotations

from fidsplat.backends.opencl.declare import Argument, Record, member, takes, uniforms

VIEW = Record(
    "View",
    (
        member("real rotation[9]", "world to camera, row-major"),
        member("real translation[3]", "camera-space position of the cloud's origin [m]"),
        member("real eye[3]", "camera centre relative to the cloud's origin [m]"),
        member("real focal_x focal_y center_x center_y", "intrinsics of the sample grid [samples]"),
        member("real near far", "[m]"),
        member("real log_cut", "ln(alpha cut-off)"),
        member("real width height", "of the sample grid"),
        member("real filter", "(pixels per sample)^2, for filters that are defined in pixels"),
        member("real band band_end", "rows of samples that are drawn now"),
    ),
)
"""The uniforms of the projection; one for each view, then as many for each group of splats that moves by
itself."""

SPLAT = Record(
    "Splat",
    (
        member("wide nu0 nux nuy", "n_u = nu0 + nux x + nuy y"),
        member("wide nv0 nvx nvy"),
        member("wide d0 dx dy", "D"),
        member("wide d_near", "D at depth `near`: a fragment is in front of the near plane if D <= d_near"),
        member("wide log_opacity"),
        member("wide r g b"),
        member("float ax ay", "anchor pixel, a whole number"),
        member("short y0 y1", "rows [y0, y1) that the splat can touch"),
        member("short x0 x1", "columns [x0, x1)"),
    ),
    alignment=16,  # whole vectors of 16 bytes are read and written
)

BOUNDS = Record(
    "Bounds",
    (
        member("float ex ey", "centre [samples]"),
        member("float hx hy", "half extents of the axis-aligned box"),
        member("float slope", "the chord at height Y around the centre is"),
        member("float half_width", "slope * Y +- half_width * sqrt(1 - Y^2 / hy^2)"),
        member("float inverse_hy2", "0 makes it a box"),
        member("float tip", "height at which the ellipse is widest to the right"),
    ),
)

_SIZE = takes("int width height  // of the sample grid")
_BIG = takes("uint big_capacity", "in Bounds big_bounds")
_DIGIT = takes("uint count  // places for the splats of a view", "in uint tallies", "uint first shift")
_WALK = takes(
    "uint count  // places for the splats of a view",
    "in uint order tallies",
    "in uint2 windows",
    _BIG,
    _SIZE,
    "out uint table",
)
_EXPOSED = takes(
    _SIZE,
    "int stride  // samples per row of a shot",
    "uint channel_stride  // samples per channel of a shot",
    *("int whole_stride", "uint whole_channel_stride", "int top channels"),
)
RAY_UNIFORMS = uniforms(
    "ray",
    "float ray_focal_x ray_focal_y ray_center_x ray_center_y",
    note="of the sample grid; infinite where depths are distances",
)

KERNELS: dict[str, tuple[Argument, ...]] = {
    "project": takes(
        "uint count",
        "in View view",
        "cloud float means  // (n, 3) [m], relative to the cloud's origin",
        "cloud float quats  // (n, 4) w x y z",
        "cloud float scales  // (n, 2) [m]",
        "cloud float opacities  // (n)",
        "out Splat splats  // (views, n)",
        "out uint keys  // (views, n)",
        "out uint2 windows  // (views, n): corner and bits, or a place in `big` and 0",
        "out uint tallies",
        "uint big_capacity",
        "out uint big  // splats that touch more than a window",
        "out Bounds big_bounds",
    ),
    "pack_count": takes("uint count", "in uint keys", "out uint held"),
    "pack_move": takes(
        *("uint count", "in uint places", "in Splat splats", "in uint keys", "in uint2 windows"),
        *("out Splat splats_out", "out uint keys_out", "out uint2 windows_out"),
    ),
    "scan_chunks": takes("uint bins", "out uint table totals"),
    "scan_bins": takes("uint bins", "in uint totals", "out uint starts tallies", "uint slot"),
    "sort_count": takes("in uint keys", _DIGIT, "out uint table"),
    "sort_scatter": takes(
        *("in uint keys indices", _DIGIT),
        *("out uint table", "in uint starts", "out uint keys_out indices_out"),
    ),
    "bin_count": _WALK,
    "bin_emit": takes(
        *(_WALK, "in uint starts", "int band_first band_end", "out uint lists"),
    ),
    "tile_starts": takes("uint tiles capacity clear", "out uint tallies starts cursors counts"),
    "tally_big": takes("uint count", _SIZE, _BIG, "in uint big", "out uint tallies"),
    "emit": takes(
        *(
            "uint count splat_groups first_band",
            _SIZE,
            "int band_first band_end",
            "uint capacity big_capacity",
        ),
        *("in uint2 windows", "in uint keys big", "in Bounds big_bounds", "in uint starts"),
        *("out uint counts cursors", "out uint2 pairs"),
    ),
    "tally_gathered": takes("uint count", _SIZE, "in uint2 windows", "in uint keys", "out uint tallies"),
    "emit_gathered": takes(
        *("uint count first_band", _SIZE, "int band_first band_end", "uint capacity"),
        *("in uint2 windows", "in uint keys starts", "out uint counts cursors", "out uint2 pairs"),
    ),
    "sort_tiles": takes("int band_first", "in uint starts", "out ulong pairs", "out uint lists"),
    "blend": takes(
        *("in Splat splats", "in uint lists starts"),
        "uint band_first  // the first tile of this launch; lists begin with its list",
        *(_SIZE, "wide log_cut ceiling stop filter"),
        "uint channel_stride  // samples per channel of raw, of all views",
        "out float raw  // 4 channels: r, g, b, transmittance",
    ),
    "expose": takes(_EXPOSED, "float weight", "int first", "in float raw", "out float exposed"),
    "expose_middle": takes(_EXPOSED, "in uint raw", "out uint exposed"),
    "backdrop": takes(
        *(_SIZE, "int stride", "uint channel_stride", RAY_UNIFORMS),
        uniforms(
            "rotation",
            "float turn_00 turn_01 turn_02 turn_10 turn_11 turn_12 turn_20 turn_21 turn_22",
            note="world to camera",
        ),
        "out float raw",
    ),
    "resolve": takes(
        "int width height  // of the picture",
        "int stride  // samples per row of raw",
        "uint channel_stride  // samples per channel of raw, of all views",
        "in uint slots  // of each view: its place among the output images",
        *("float background_r background_g background_b", "in float raw"),
    ),
}
"""The arguments of each kernel; those of effects and outputs follow them."""
