"""Planes of samples, which blending leaves for resolving, and planes of pixels, which resolving leaves for
the user: structs of arrays with the fields of the effects that a picture has.
"""

from functools import cache

import warp as wp

from .common import struct_of

# of a sample: `heaviest` serves labels and splat ids
_SAMPLES = {
    "depth": {"depth": wp.vec2},  # sum w z, sum w
    "depth_median": {"depth_median": wp.float32},
    "depth_first": {"depth_first": wp.float32},
    "normal": {"normal": wp.vec3},
    "heaviest": {"heaviest": wp.int32, "weight": wp.float32},
    "blended": {"blended": wp.int32},
    "fog": {"fogged": wp.float32},
}
LIGHT = frozenset({"color", "fogged"})
"""planes of samples whose mean is what several poses leave together"""


def of_samples(effects: tuple[str, ...]) -> dict[str, type]:
    """Type of an element of each plane of samples; color: r, g, b, transmittance."""
    fields = {"color": wp.vec4}
    for effect, planes in _SAMPLES.items():
        fields |= planes if effect in effects else {}
    return fields


@cache
def make_samples(fields: tuple[tuple[str, type], ...]):
    """The struct of these planes of samples, (rows columns) of the padded grid each."""
    arrays = {name: wp.array(dtype=dtype) for name, dtype in fields}
    return struct_of("Samples", "What blending leaves of each sample.", arrays)


@cache
def make_outputs(names: tuple[str, ...], integers: tuple[str, ...]):
    """The struct of the finished planes, (h w channels) each; with `labels` (n) of the splats where `label`
    is one of them, and `turns` (h), world to camera, where `normal_world` is.
    """
    arrays = {name: wp.array(dtype=wp.int32 if name in integers else wp.float32) for name in names}
    if "label" in names:
        arrays["labels"] = wp.array(dtype=wp.int32)
    if "normal_world" in names:
        arrays["turns"] = wp.array(dtype=wp.mat33)
    return struct_of("Outputs", "What resolving leaves of each pixel.", arrays)
