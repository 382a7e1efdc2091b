"""Unit normal towards the camera, in the camera frame: the weighted mean of the fragments; 0 without a
visible fragment."""

from typing import Any

import warp as wp

from ..common import View, fma3
from ..pixel_grid import PixelGrid, sample_at
from . import Output


@wp.func
def project(record: Any, at: int, normal: Any, height: Any):
    """Store the normal towards the camera: one sign per splat, as the camera is on one side of the complete
    plane."""
    r = record
    one = type(height)(1.0)
    towards = wp.where(height > type(height)(0.0), -one, one)
    r[at] = float(normal[0] * towards)
    r[at + 1] = float(normal[1] * towards)
    r[at + 2] = float(normal[2] * towards)
    return r


@wp.func
def read_attributes(attributes: Any, numbers: wp.vec3, index: int):
    s = attributes
    s.normal = numbers
    return s


@wp.func
def accumulate(layer: Any, attributes: Any, tau: float, share: float):
    after = layer
    after.mean.normal = fma3(share, attributes.normal - layer.mean.normal, layer.mean.normal)
    return after


@wp.func
def composite(pixel: Any, attributes: Any, weight: float, view: View):
    p = pixel
    p.normal = fma3(weight, attributes.normal, p.normal)
    return p


@wp.func
def clear(pixel: Any):
    p = pixel
    p.normal = wp.vec3()
    return p


@wp.func
def store(pixel: Any, at: int, samples: Any):
    samples.normal[at] = pixel.normal


@wp.func
def sum_of(grid: PixelGrid, samples: Any):
    """Sum of the pixel's normals, and the reciprocal of its length, or 0."""
    sum = wp.vec3()
    for k in range(grid.count):
        sum += samples.normal[sample_at(grid, k)]
    length, scale = wp.length(sum), float(0.0)
    if length > 0.0:
        scale = 1.0 / length
    return sum, scale


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    sum, scale = sum_of(grid, samples)
    for channel in range(3):
        out.normal[3 * grid.pixel + channel] = sum[channel] * scale


OUTPUT = Output(
    record=("nx", "ny", "nz"),
    project=project,
    attributes={"normal": wp.vec3},
    read_attributes=read_attributes,
    accumulate=accumulate,
    state={"normal": wp.vec3},
    composite=composite,
    clear=clear,
    samples={"normal": wp.vec3},
    store=store,
    resolve=resolve,
)
