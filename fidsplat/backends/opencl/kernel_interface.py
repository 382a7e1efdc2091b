"""Structs and kernel arguments, declared once for host and kernels.

The projection computes in the type `real`, blending in `blend_real`: float or double (declare.ScalarTypes).

assemble.py prints them as C into kernels/opencl/, and the host binds arguments by name. Buffers are
(channels, rows, columns) of the padded sample grid, unless a note has another shape. Capitals in notes are
build constants and enums of the kernels.
"""

from __future__ import annotations

from fidsplat.backends.opencl.declare import Argument, Record, SampleBuffer, args, member, uniforms

RAW = SampleBuffer("float", "raw", 4, "r, g, b, transmittance", averaged=True)
"""the sample buffer of every frame"""

VIEW = Record(
    "View",
    (
        member("real rotation[9]", "world to camera, row-major"),
        member("real translation[3]", "camera-space position of the cloud's origin [m]"),
        member("real eye[3]", "camera centre relative to the cloud's origin [m]"),
        member("real focal_x focal_y center_x center_y", "intrinsics of the sample grid [samples]"),
        member("real near far", "[m]"),
        member("real log_alpha_cutoff", "ln(alpha cut-off)"),
        member("real width height", "of the sample grid"),
        member("real sample_area", "area of a sample [pixels^2], for low-pass filters defined in pixels"),
        member("real first_row end_row", "rows of samples to render"),
    ),
)
"""Uniforms of the projection: one record for each view, then one for each view and moving group."""

# intersection of a ray with the splat's plane: (u, v) = (n_u, n_v) / D; n_u, n_v and D are affine in the
# sample position (x, y) relative to the anchor (splat.cl)
SPLAT = Record(
    "Splat",
    (
        member("blend_real nu0 nux nuy", "n_u = nu0 + nux x + nuy y"),
        member("blend_real nv0 nvx nvy"),
        member("blend_real d0 dx dy", "D"),
        member("blend_real d_near", "D at depth `near`: a fragment is beyond the near plane if D <= d_near"),
        member("blend_real log_opacity"),
        member("blend_real r g b"),
        member("float ax ay", "anchor: pixel, an integer, that is the origin of x and y"),
        member("short y0 y1", "rows [y0, y1) that the splat can touch"),
        member("short x0 x1", "columns [x0, x1)"),
    ),
    alignment=16,  # vectors of 16 bytes are read and written
)

BOUNDS = Record(
    "Bounds",
    (
        member("float ex ey", "centre [samples]"),
        member("float hx hy", "half extents of the axis-aligned box"),
        member("float slope", "columns of the ellipse in row Y, relative to the centre:"),
        member("float half_width", "slope * Y +- half_width * sqrt(1 - Y^2 / hy^2)"),
        member("float inverse_hy2", "0 makes it a box"),
        member("float tip", "row, relative to the centre, of the rightmost point of the ellipse"),
    ),
)

RECORD_GRADIENT = Record(
    "RecordGradient",
    (
        member("float nu0 nux nuy", "sums over a tile of the gradient with respect to n_u, times 1, x, y"),
        member("float nv0 nvx nvy"),
        member("float d0 dx dy"),
        member("float log_opacity"),
        member("float r g b"),
    ),
    alignment=16,  # a record spans few cache lines
)
"""Contribution of a tile to the gradient of a splat's record."""

_SIZE = args("int width height  // of the sample grid")
_IMAGE_SIZE = args("int width height  // of the image")
_BIG = args("uint big_capacity", "in Bounds big_bounds")
_DIGIT = args("uint count  // capacity in splats of a view", "in uint counters", "uint first shift")
_BIN_ARGUMENTS = args(
    "uint count  // capacity in splats of a view",
    "in uint order counters",
    "in uint2 windows",
    _BIG,
    _SIZE,
    "out uint table",
)
_ACCUMULATED = args(
    _SIZE,
    "int stride  // samples per row of a sub-frame",
    "uint channel_stride  // samples per channel of a sub-frame",
    *("int frame_stride", "uint frame_channel_stride", "int top channels  // top: row of the frame"),
)
RAY_UNIFORMS = uniforms(
    "ray",
    "float ray_focal_x ray_focal_y ray_center_x ray_center_y",
    note="of the sample grid; infinite where depths are distances",
)

_TILES = args("in uint2 windows", "uint big_capacity", "in Bounds big_bounds", _IMAGE_SIZE)
_RESERVED = args(
    *("uint count", "in uint keys", _TILES),
    "out uint gradient_offsets  // (n) first gradient buffer offset of each splat; a splat has one per tile",
    "out uint reserved  // (2) number of reserved gradient buffer offsets, number of tiles that work-items "
    "have started",
)

_BLENDED = args(
    "blend_real log_alpha_cutoff opacity_ceiling transmittance_stop sample_area",
    *("float log_ceiling", "float background_r background_g background_b"),
    *("int stride  // of the padded image", "uint channel_stride", "in float grad_rgb  // (h, w, 3)"),
)

_BLEND = args(
    *("in Splat splats", "in uint lists starts"),
    "uint first_tile  // the first tile of this launch; lists begin with its list",
    *(_SIZE, "blend_real log_alpha_cutoff opacity_ceiling transmittance_stop sample_area"),
    "uint channel_stride  // samples per channel of raw, of all views",
    "out float raw  // 4 channels: r, g, b, transmittance",
)

_EXPOSURES = args("in float exposures  // (views, 6): logarithms of gains, and offsets")
_EXPOSED = args("int exposed  // whether there is an exposure", "uint view_index", _EXPOSURES)
_LOSS_SIZE = args(
    "int width height  // width: values of a row, three per pixel",
    "int stride  // floats of an image's row",
    "uint image_stride  // floats of an image",
)
_MASK = args("int masked", "in uchar mask  // (rows, pixels), where `masked`")
_ALIGNED = args(
    "int width height channels stage",
    "in uint thresholds  // lowest histogram bin to use of each stage; then see `align_thresholds`",
    "in float fit  // gain, then offset of three channels, previous noise or 0, whether converged",
    *("in uchar bins  // histogram bins of gradient magnitudes", "in float image"),
)
_IMAGES = args("out float images")
_SURFACE = args(
    _IMAGE_SIZE,
    "uint view_index",
    "in float lenses  // (views, 4): fx, fy, cx, cy",
)
_RENDERED_SH = args(
    *(
        "uint count",
        "uint rendered_coefficients stored_coefficients  // SH coefficients of a splat and channel",
    ),
    "int as_rgb  // whether to write RGB colours, at degree 0",
)

_ROTATION = "float " + " ".join(f"rotation_{row}{column}" for row in range(3) for column in range(3))

KERNELS: dict[str, tuple[Argument, ...]] = {
    "project": args(
        "uint count",
        "in View view",
        "cloud float means  // (n, 3) [m], relative to the cloud's origin",
        "cloud float quats  // (n, 4) w x y z",
        "cloud float scales  // (n, 2) [m]",
        "cloud float opacities  // (n)",
        "out Splat splats  // (views, n)",
        "out uint keys  // (views, n)",
        "out uint2 windows  // (views, n): corner and bits, or an index in `big` and 0",
        "out uint counters",
        "uint big_capacity",
        "out uint big  // splats that touch more than a window",
        "out Bounds big_bounds",
    ),
    "pack_count": args("uint count", "in uint keys", "out uint block_counts"),
    "pack_move": args(
        *("uint count", "in uint block_offsets", "in Splat splats", "in uint keys", "in uint2 windows"),
        *("out Splat splats_out", "out uint keys_out", "out uint2 windows_out"),
    ),
    "scan_blocks": args("uint bins", "out uint table totals"),
    "scan_bins": args("uint bins", "in uint totals", "out uint starts counters", "uint counter"),
    "sort_count": args("in uint keys", _DIGIT, "out uint table"),
    "sort_scatter": args(
        *("in uint keys indices", _DIGIT),
        *("out uint table", "in uint starts", "out uint keys_out indices_out"),
    ),
    "bin_count": _BIN_ARGUMENTS,
    "bin_emit": args(*(_BIN_ARGUMENTS, "in uint starts", "int first_tile end_tile", "out uint lists")),
    "tile_starts": args(
        "uint tiles capacity", "in uint counters", "out uint starts cursors frame_counts tile_order"
    ),
    "count_big": args("uint count", _SIZE, _BIG, "in uint big", "out uint counters"),
    "emit": args(
        *(
            "uint count",
            "uint splat_groups  // work-groups with one work-item per splat, after those of the big splats",
            "uint counts_visible  // whether to add the visible splats to frame_counts",
            _SIZE,
            "int first_tile end_tile",
            "uint capacity big_capacity",
        ),
        *("in uint2 windows", "in uint keys big", "in Bounds big_bounds", "in uint starts"),
        *("out uint frame_counts cursors", "out uint2 pairs"),
    ),
    "count_local": args("uint count", _SIZE, "in uint2 windows", "in uint keys", "out uint counters"),
    "emit_local": args(
        "uint count",
        "uint counts_visible  // whether to add the visible splats to frame_counts",
        *(_SIZE, "int first_tile end_tile", "uint capacity"),
        *("in uint2 windows", "in uint keys starts", "out uint frame_counts cursors", "out uint2 pairs"),
    ),
    "sort_tiles": args(
        "int first_tile",
        "uint clear  // whether to zero the counters for the next frame",
        *("in uint starts", "out ulong pairs", "out uint lists counters"),
    ),
    "blend": _BLEND,
    "accumulate": args(_ACCUMULATED, "float weight", "int first", "in float raw", "out float accumulated"),
    "copy_middle": args(_ACCUMULATED, "in uint raw", "out uint accumulated"),
    "composite_background": args(
        *(_SIZE, "int stride", "uint channel_stride", RAY_UNIFORMS, "in View view", "out float raw"),
    ),
    "resolve": args(
        "int width height  // of the image",
        "int stride  // samples per row of raw",
        "uint channel_stride  // samples per channel of raw, of all views",
        "in uint batch_indices  // index of each view in the output images",
        *("float background_r background_g background_b", "in float raw"),
    ),
    # derivatives
    "reserve_gradients": args(
        *(
            _RESERVED,
            "out uint big_rows  // (rows of tiles, big splats) gradient buffer offset of a tile, relative to "
            "the splat's first one, minus the tile's column",
        )
    ),
    "blend_backward": args(
        *(
            "in Splat splats",
            "in uint lists starts",
            "in uint2 windows",
            "uint big_capacity",
            _IMAGE_SIZE,
            "in uint gradient_offsets big_rows",
        ),
        _BLENDED,
        "out float checkpoints  // by segment of a tile's list: transmittance of each pixel in front of it, "
        "index of its first splat",
        "out float record_gradients  // records RecordGradient by gradient buffer offset",
        "out real background_sums  // (tiles, 3) with respect to the background",
        "out float tapes  // a Tape for each work-item",
        "out uint reserved  // (2) number of reserved gradient buffer offsets, number of tiles that "
        "work-items have started",
    ),
    "project_backward": args(
        *("uint count", "in View view", "cloud float means quats scales opacities"),
        *("in Splat splats", "in uint keys", _TILES, "in uint gradient_offsets", "in float record_gradients"),
        "out float grad_means  // (n, 3)",
        "out float grad_quats  // (n, 4)",
        "out float grad_scales  // (n, 2)",
        "out float grad_opacities  // (n)",
        "out float grad2d  // (n)",
        "out real camera_sums  // (work-groups, 10) with respect to the camera",
    ),
    "project_step": args(
        *("uint count", "in View view", "in Splat splats", "in uint keys", _TILES),
        *("in uint gradient_offsets", "in float record_gradients"),
        "int add_statistics update sparse  // sparse: update only splats that contribute",
        "uint stored_coefficients  // SH coefficients of a splat and channel",
        "float beta1 beta2 one_minus_beta1 one_minus_beta2 sqrt_correction2 epsilon",
        "float lr_means lr_scales lr_quats lr_logits  // learning rates",
        "float lr_sh lr_rest  // of degree 0; of higher degrees",
        "float scale_penalty opacity_penalty",
        "out float gradient_sums visible_counts",
        "out float means first_means second_means",
        "out float log_scales first_log_scales second_log_scales",
        "out float quats first_quats second_quats",
        "out float logits first_logits second_logits",
        "out float sh first_sh second_sh",
        "out float activated_quats activated_scales activated_opacities activated_sh",
    ),
    "refine_view": args(
        "uint groups exposure_groups view_index next_view",
        "int update refine_pose refine_intrinsics refine_exposure",
        "real beta1 beta2 pose_rate exposure_rate  // learning rates with bias corrections",
        "in float depths  // (views) [m] of the points about which the cameras rotate",
        "in uint intrinsics_rows  // (views)",
        "in real camera_sums  // (groups, 10)",
        "in float exposure_sums  // (exposure_groups, 6)",
        "out View views view  // records of all views; of the frame",
        "out real pose_moments exposure_moments  // (views, 2, 6): Adam's moments",
        "out real intrinsics_sums  // (rows, 4)",
        "out float exposures",
    ),
    "refine_intrinsics": args(
        *("uint count  // views", "uint intrinsics_row", "real beta1 beta2 intrinsics_rate"),
        "in uint intrinsics_rows  // (views)",
        "out real intrinsics intrinsics_sums  // (rows, 4): fx, fy, cx, cy",
        "out real intrinsics_moments  // (rows, 2, 4)",
        "out View views",
        "out float lenses  // (views, 4)",
    ),
    "sum_gradients": args(
        *("uint tiles groups", "in real background_sums camera_sums  // (tiles, 3), (groups, 10)"),
        "out float background pose intrinsics",
    ),
    # direct image alignment
    "align_downsample": args(
        *("int width height channels full_width full_height is_uint8", "float ratio_x ratio_y"),
        *("in uchar bytes", "in float image", "out float result"),
    ),
    "align_blur": args(
        "int width height channels vertical radius",
        "in float taps  // (radius + 1)",
        *("in float image", "out float result"),
    ),
    "align_texture": args(
        *("int width height channels stage", _MASK, "in float image", "out uchar bins"),
        "out uint counts  // (stages + 1, BINS)",
    ),
    "align_noise": args("int width height channels stage", "in float image", "out uint counts"),
    "align_thresholds": args(
        *("int stages", "uint max_pixels", "out uint counts"),
        "out uint thresholds  // (2 stages + 1) lowest used bin of each stage, number of pixels of each "
        "stage, median (bits of a float)",
    ),
    "align_errors": args(
        *(_ALIGNED, "int radius", "in float taps rendered", "out float rgb", "out uint counts  // (BINS)")
    ),
    "align_sums": args(
        *(_ALIGNED, "in float rgb", "in uint counts"),
        "int block_size huber has_perturbed axis lens  // has_perturbed: whether `perturbed` is given",
        "int depth_width",
        "float focal_x focal_y center_x center_y noise_factor step ratio_x ratio_y",
        "in float depth rays perturbed",
        "out float result  // (work-groups, SUMS + 1)",
    ),
    "align_start": args(
        "real near", "float damping", "in real before", "out float state", "out real pose", "out View view"
    ),
    "align_step": args(
        *(
            "int groups channels axis row  // axis: of the next motion, or STEP",
            "uint big_capacity pair_capacity",
        ),
        "float focal tolerance difference  // pixels: a smaller motion has converged; size of a motion",
        *("in float result", "in uint frame_counts", "out uint counts", "out float totals  // (rows, SUMS)"),
        *("out float state", "out real pose  // the last accepted", "out View view"),
    ),
    # training
    "loss_load": args(
        *(_LOSS_SIZE, "in float rgb", "in uchar target", _MASK),
        *(_EXPOSED, _IMAGES),
    ),
    "loss_rows": args(_LOSS_SIZE, _IMAGES),
    "loss_columns": args(_LOSS_SIZE, _IMAGES),
    "loss_rows_backward": args(_LOSS_SIZE, _IMAGES),
    "loss_columns_backward": args(
        *(_LOSS_SIZE, "float l1_weight ssim_weight", _MASK, "in float images", _EXPOSED, "out float grad_rgb")
    ),
    "loss_sums": args(
        *(_LOSS_SIZE, "in float images", "out float sums  // (work-groups, 3)"),
        *(_EXPOSED, "in float rgb grad_rgb", "out float exposure_sums  // (work-groups, 6)"),
    ),
    "loss_strips": args(
        *(_LOSS_SIZE, "in float rgb", "in uchar target", _MASK),
        *(_IMAGES, "out float sums  // (work-groups, 3)"),
    ),
    "loss_strips_backward": args(
        *(_LOSS_SIZE, "in float rgb", "in uchar target", _MASK),
        *("float l1_weight ssim_weight", "in float images", "out float grad_rgb"),
    ),
    "apply_exposure": args(
        *("uint pixels view_index", _EXPOSURES, "in float rendered", "out float rgb"),
    ),
    "exposure_backward": args(
        *("uint pixels view_index", _EXPOSURES, "in float rendered", "out float grad_rgb"),
        "out float exposure_sums  // (work-groups, 6)",
    ),
    "centre_exposures": args("uint count  // views", "out float exposures"),
    "surface_normals": args(
        _SURFACE,
        _MASK,
        "float normal_weight  // weight of the loss of each pixel",
        "in float depth normal alpha",
        "out float grad_normal",
        "out float differences  // (rows, columns, 2, 3)",
    ),
    "surface_depths": args(_SURFACE, "in float differences", "out float grad_depth"),
    "activate": args(
        "uint count axes  // number of scales of a splat",
        "in float quats log_scales logits",
        "out float activated_quats activated_scales activated_thickness activated_opacities",
    ),
    "activate_sh": args(_RENDERED_SH, "in float sh", "out float activated_sh"),
    "gather_rows": args(
        *("uint count", "uint row copied  // floats per row, number of copied rows; later rows are zero"),
        *("in uint rows", "in float source", "out float gathered"),
    ),
    "add_position_noise": args(
        *("uint count axes seed_low seed_high iteration", "uint random_stream"),
        "float size  // factor of the steps [1/m]",
        "float slope threshold  // of the opacity above which splats do not move",
        "in float quats log_scales logits",
        "out float means",
    ),
}
"""The arguments of each kernel, before those of effects and outputs."""

GROUP_KERNELS: dict[str, tuple[Argument, ...]] = {
    "reserve_gradients": _RESERVED,
    "blend": args(
        "uint longest_first  // blend the tiles in the order of tile_order", "in uint tile_order", _BLEND
    ),
    "blend_checkpoints": args(
        *("in Splat splats", "in uint lists starts", _IMAGE_SIZE, _BLENDED),
        "out float checkpoints  // by pixel and segment: T in front of it, and gradient with respect to T "
        "behind it",
        "out uint reached_segments  // (tiles) number of segments before the transmittance stop",
        "out uint segment_tiles  // tile of each segment",
        "out real background_sums  // (tiles, 3) with respect to the background",
    ),
    "blend_backward": args(
        *("in Splat splats", "in uint lists starts", _TILES, "in uint gradient_offsets", _BLENDED),
        *("in float checkpoints", "in uint reached_segments segment_tiles"),
        "out float record_gradients  // records RecordGradient by gradient buffer offset",
    ),
}
"""Kernels with other arguments in the group schedule, where a work-group shares a tile."""

UNCULLED_KERNELS: dict[str, tuple[Argument, ...]] = {
    "project": args(KERNELS["project"], "in uint unculled  // groups of splats that are projected"),
    "cull_groups": args(
        *("uint groups capacity", "in View view", "in float4 spheres", "in float max_scales"),
        "out uint unculled counters",
    ),
    "sort_tiles": args(KERNELS["sort_tiles"], "in uint unculled", "in int splat_ids"),
}
"""Kernels with frustum culling before projection."""
