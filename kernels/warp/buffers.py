"""Sample buffers, written by blending and read by resolving, and output images: structs of arrays with the
fields that the outputs of a frame declare.
"""

from functools import cache

import warp as wp

from . import output
from .common import struct_of


def sample_fields(outputs: tuple[str, ...]) -> dict[str, type]:
    """Type of an element of each sample buffer; color: r, g, b, transmittance."""
    return {"color": wp.vec4} | output.fields(outputs, "samples")


def averaged_of(outputs: tuple[str, ...]) -> frozenset[str]:
    """Names of sample buffers that are averaged over the poses of a shutter."""
    return frozenset({"color"} | output.fields(output.having(outputs, "averaged"), "samples").keys())


@cache
def make_samples(fields: tuple[tuple[str, type], ...]):
    """Struct of sample buffers with these fields, each (rows columns) of the padded grid."""
    arrays = {name: wp.array(dtype=dtype) for name, dtype in fields}
    return struct_of("Samples", "Results of blending for each sample.", arrays)


@cache
def make_images(images: tuple[tuple[str, type], ...], outputs: tuple[str, ...]):
    """Struct of output images, each (h w channels) of its type, and of the arrays that the outputs read."""
    fields = {
        **dict(images),
        **output.fields(outputs, "cloud_arrays"),
        **output.fields(outputs, "view_arrays"),
    }
    arrays = {name: wp.array(dtype=dtype) for name, dtype in fields.items()}
    return struct_of("Images", "Results of resolving for each pixel.", arrays)
