"""Code shared by all stages: module options, uniforms, fused multiply-adds, packed loads."""

import re

import warp as wp

# Order and culling must not depend on the compiler: contraction is off, and fused operations are written as
# `fma`. Fast maths is off: comparisons with NaN must be false.
# Loops over the functions of outputs are always unrolled.
STRICT = {
    **{"fuse_fp": False, "fast_math": False, "enable_backward": False, "default_grid_stride": False},
    "max_unroll": 64,
}

CULLED = wp.constant(wp.uint32(0xFFFFFFFF))
"""key of a culled splat"""
MIN_ALPHA = wp.constant(wp.float32(1.0 / 255.0))
"""minimum alpha of a sample with a label, depth, median depth or normal"""


_SIGN = wp.constant(wp.uint32(0x80000000))
_NONE = wp.constant(wp.uint32(0))


@wp.struct
class View:
    """Uniforms of one view, in metres and samples. Kernels read an array with one struct per rendered view;
    integer fields are equal in all views.
    """

    rotation: wp.mat33d  # world to camera
    translation: wp.vec3d  # position of the cloud's origin in the camera frame
    eye: wp.vec3d  # the camera's centre relative to the cloud's origin, world axes
    focal_x: wp.float64  # samples; samples per metre for parallel rays
    focal_y: wp.float64
    center_x: wp.float64  # samples
    center_y: wp.float64
    near: wp.float64
    far: wp.float64
    per_focal_x: wp.float64  # 1 / focal_x and so on: a product is faster than a division
    per_focal_y: wp.float64
    per_near: wp.float64
    width: int
    height: int
    tile_w: int
    tile_h: int
    tiles_x: int
    tiles_y: int
    samples: int  # per pixel and axis
    sample_area: float  # (pixels per sample)^2: converts squared samples to squared pixels
    log_alpha_cutoff: float
    opacity_ceiling: float
    transmittance_stop: float
    first_hit_transmittance: float  # maximum transmittance behind a first hit
    fog_density: float  # 1 / metres
    # limits of -x, x, -y, y at z = 1, to which EWA clamps the centre of a splat before it linearises
    ewa_clamp: wp.vec4d
    max_ray_derivative: (
        wp.float64
    )  # maximum distance of the rays of neighbouring samples, for boxes behind a lens
    splats: int  # number of splats of the cloud
    ray: wp.vec4  # a sample's ray is ((column - [2]) / [0], (row - [3]) / [1], 1), or (0, 0, 1) for distances


# An identity that the compiler cannot remove, so that uniforms are loaded from memory again: a view has
# more numbers than a GPU thread has registers.
@wp.func_native("""
    int same = number;
#if defined(__CUDA_ARCH__)
    asm volatile("" : "+r"(same));
#endif
    return same;
""")
def reread(number: int) -> int:
    """`number`, opaque to the compiler."""
    ...


@wp.func
def locate_tile(tile: int, views: wp.array(dtype=View)):
    """View of a tile, numbered over all views, and the tile's column and row in the view."""
    view = views[0]
    row = tile / view.tiles_x
    return row / view.tiles_y, tile % view.tiles_x, row % view.tiles_y


@wp.func
def first_sample(number: int, view: View) -> int:
    """Index of a view's first sample in sample buffers."""
    return number * (view.tiles_x * view.tile_w) * (view.tiles_y * view.tile_h)


def struct_of(name: str, doc: str, fields: dict):
    """Make a struct with a docstring and `fields` (name: type)."""
    return wp.struct(type(name, (), {"__annotations__": fields, "__doc__": doc, "__module__": __name__}))


def with_numbers(text: str, numbers: dict[str, int]) -> str:
    """Replace names by numbers in a text."""
    return re.sub("|".join(numbers), lambda name: str(numbers[name[0]]), text)


@wp.func_native("return fmaf(a, b, c);")
def fma(a: float, b: float, c: float) -> float:
    """a b + c, rounded once."""
    ...


# Instructions of GPUs within 2 ulp, for conservative bounds; other square roots and divisions have a branch
# for denormals.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float y;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return sqrtf(x);
#endif
""")
def fast_sqrt(x: float) -> float:
    """The square root, within 2 ulp."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return 1.0f / x;
#endif
""")
def fast_reciprocal(x: float) -> float:
    """1 / x, within 2 ulp."""
    ...


# Two instructions, correctly rounded for normal x with a normal reciprocal; a division has a branch for all
# others.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return fmaf(fmaf(-x, y, 1.0f), y, y);
#else
    return 1.0f / x;
#endif
""")
def reciprocal(x: float) -> float:
    """1 / x for normal x with a normal reciprocal."""
    ...


@wp.func
def fma3(a: float, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """a b + c, rounded once."""
    return wp.vec3(fma(a, b[0], c[0]), fma(a, b[1], c[1]), fma(a, b[2], c[2]))


@wp.func
def fma_dot(a: wp.vec3, b: wp.vec3) -> float:
    """The scalar product, rounded once for each term."""
    return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]))


# One 16-byte load on CUDA: the compiler does not know that Warp's vectors are aligned, and would use four
# loads.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 quad = __ldg(reinterpret_cast<const float4*>(records.data) + at);
    return wp::vec_t<4, wp::float32>(quad.x, quad.y, quad.z, quad.w);
#else
    return records.data[at];
#endif
""")
def load_vec4(records: wp.array(dtype=wp.vec4), at: int) -> wp.vec4:
    """records[at]; read-only during the launch."""
    ...


# One 16-byte store on CUDA: each of four stores would write to all 32 records of a warp.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    reinterpret_cast<float4*>(records.data)[at] = make_float4(value[0], value[1], value[2], value[3]);
#else
    records.data[at] = value;
#endif
""")
def store_vec4(records: wp.array(dtype=wp.vec4), at: int, value: wp.vec4):
    """records[at] = value."""
    ...


@wp.func
def sortable(x: float) -> wp.uint32:
    """Bits of a float in an order that unsigned comparison preserves, negative values included. No depth is
    -0: depth is a sum with a nonzero term of the view.
    """
    bits = wp.cast(x, wp.uint32)
    if (bits & _SIGN) != _NONE:
        return ~bits
    return bits | _SIGN


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __popc(bits);
#else
    return __builtin_popcount(bits);
#endif
""")
def population(bits: wp.uint32) -> int:
    """Number of set bits."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
""")
def lowest(bits: wp.uint32) -> int:
    """Index of the lowest set bit of a nonzero word."""
    ...


@wp.func
def divide(x: int, size: int) -> int:
    """x / size, for x >= 0 and a power of two; a division takes a GPU 20 instructions."""
    return x >> population(wp.uint32(size - 1))


@wp.func
def as_bits(low: int, high: int) -> float:
    """Pack two numbers from 0 to 65535 into the bits of a float."""
    return wp.cast((wp.uint32(high) << wp.uint32(16)) | wp.uint32(low), wp.float32)


@wp.func
def of_bits(bits: float):
    """Unpack the two numbers of `as_bits`."""
    both = wp.cast(bits, wp.uint32)
    return int(both & wp.uint32(0xFFFF)), int(both >> wp.uint32(16))


@wp.func
def to_sample(x: float, limit: int) -> int:
    """Convert a sample's coordinate to int, clamped as a float, since conversions of huge values are
    undefined .
    """
    return int(wp.clamp(x, -1.0, float(limit) + 1.0))
