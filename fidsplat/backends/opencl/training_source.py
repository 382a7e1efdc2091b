"""The program `training`: its kernels' arguments, declared once for host and kernels, and its text."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

from fidsplat.backends.opencl.assemble import Source, Text, kernel_text, with_scalars
from fidsplat.backends.opencl.declare import Argument, Scalars, takes

MARGIN, MARGIN_ROWS = 16, 5
"""zeros around an image, floats of a row and rows"""
PANEL, STRIP = 128, 64
"""values of a row and rows that a work-item takes, on CPUs (kernels/opencl/train/loss_strips.cl)"""
_STEPS = ("surface", "activation_functions", "activate", "gather_rows", "position_noise")

_PICTURE = takes(
    "int width height  // values of a row: three of a pixel; rows",
    "int stride  // floats of an image's row",
    "uint image_stride  // floats of an image",
)
_MASK = takes("int masked", "in uchar mask  // (rows, pixels), where `masked`")
_IMAGES = takes("out float images")
_SURFACE = takes(
    "int width height  // of the picture",
    "float inverse_x inverse_y middle_x middle_y  // 1 / focal lengths, and the principal point [px]",
)
_DRAWN_SH = takes("uint count drawn all", "int plain")

_LOSS: dict[str, tuple[Argument, ...]] = {
    "loss_take": takes(_PICTURE, "in float rgb", "in uchar truth", _MASK, _IMAGES),
    "loss_rows": takes(_PICTURE, _IMAGES),
    "loss_columns": takes(_PICTURE, _IMAGES),
    "loss_rows_backward": takes(_PICTURE, _IMAGES),
    "loss_columns_backward": takes(
        _PICTURE, "float l1_share ssim_share", _MASK, "in float images", "out float by_rgb"
    ),
    "loss_sums": takes("uint image_stride", "in float images", "out float sums  // (work-groups, 3)"),
}
_LOSS_STRIPS: dict[str, tuple[Argument, ...]] = {
    "loss_strips": takes(
        *(_PICTURE, "in float rgb", "in uchar truth", _MASK),
        *(_IMAGES, "out float sums  // (work-groups, 3)"),
    ),
    "loss_strips_backward": takes(
        *(_PICTURE, "in float rgb", "in uchar truth", _MASK),
        *("float l1_share ssim_share", "in float images", "out float by_rgb"),
    ),
}
_KERNELS: dict[str, tuple[Argument, ...]] = {
    "surface_normals": takes(
        _SURFACE,
        _MASK,
        "float normal_share  // of each pixel",
        "in float depth normal alpha",
        "out float by_normal",
        "out float differences  // (rows, columns, 2, 3)",
    ),
    "surface_depths": takes(_SURFACE, "in float differences", "out float by_depth"),
    "activate": takes(
        "uint count",
        "in float quats log_scales logits",
        "out float drawn_quats drawn_scales drawn_opacities",
    ),
    "activate_sh": takes(_DRAWN_SH, "in float sh", "out float drawn_sh"),
    "pick": takes(
        "uint count row kept",
        "in uint rows",
        "in float before",
        "out float picked",
    ),
    "count_seen": takes(
        "uint count",
        "float turn_00 turn_01 turn_02 turn_10 turn_11 turn_12 turn_20 turn_21 turn_22",
        "float move_x move_y move_z  // camera-space position of the means' zero [m]",
        "float focal_x focal_y center_x center_y near width height",
        "in float means drawn_scales",
        "out float seen",
    ),
    "shake": takes(
        "uint count seed_low seed_high iteration purpose",
        "float size  // metres times 1 / m^2 of the steps",
        "float steep clear  // of the opacity beyond which splats stay where they are",
        "in float quats log_scales logits",
        "out float means",
    ),
}


def images_of(lanes: int) -> int:
    """Images that the loss takes."""
    return 11 if lanes == 1 else 3


@cache
def training_source(lanes: int, float64: bool, fast_fma: bool) -> Source:
    """The program for vectors of so many floats; sums are in float64 where the device has it."""
    if lanes == 1:
        steps, kernels = ("loss_values", "loss", *_STEPS), _LOSS | _KERNELS
    else:
        steps, kernels = ("loss_values", "loss_strips", *_STEPS), _LOSS_STRIPS | _KERNELS
    numbers = {"LANES": lanes, "FAST_FMA": int(fast_fma and lanes > 1), "SETUP_FP64": int(float64)}
    head = "".join(f"#define {name} {value}\n" for name, value in numbers.items())
    files = ("prelude.cl", "math.cl", *(f"train/{step}.cl" for step in steps))
    lines = "".join(map(kernel_text, files)).split("\n")
    text = with_scalars(head + "\n".join(_filled(line, kernels) for line in lines))
    scalars = Scalars("double" if float64 else "float", "float")
    return Source({"training": Text(text, text)}, {}, kernels, (), scalars)


def _filled(line: str, kernels: Mapping[str, tuple[Argument, ...]]) -> str:
    """A line, or what stands in place of a hook: a kernel's arguments, or nothing."""
    if not line.startswith("//@@ "):
        return line
    hook, _, subject = line.removeprefix("//@@ ").partition(" ")
    return ",\n".join(f"    {one.text}" for one in kernels[subject]) if hook == "arguments" else ""
