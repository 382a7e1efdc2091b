"""Code shared by all stages: module options, uniforms, fused multiply-adds, packed loads."""

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
"""minimum coverage of a sample for label, depth, median depth and normal"""


_SIGN = wp.constant(wp.uint32(0x80000000))
_NONE = wp.constant(wp.uint32(0))


@wp.struct
class View:
    """Uniforms of one view. Lengths are in metres, pixels are samples of the grid. Kernels have an array with
    one for each rendered view; the integers are the same in all.
    """

    rotation: wp.mat33d  # world to camera
    translation: wp.vec3d  # position of the cloud's origin in the camera frame
    eye: wp.vec3d  # the camera's centre relative to the cloud's origin, world axes
    focal_x: wp.float64  # samples; of parallel rays samples per metre
    focal_y: wp.float64
    center_x: wp.float64  # samples
    center_y: wp.float64
    near: wp.float64
    far: wp.float64
    per_focal_x: wp.float64  # 1 / focal_x, as those below: to divide takes longer
    per_focal_y: wp.float64
    per_near: wp.float64
    width: int
    height: int
    tile_w: int
    tile_h: int
    tiles_x: int
    tiles_y: int
    samples: int  # per pixel and axis
    per_pixel: float  # (pixels per sample)^2: from squared samples to squared pixels
    log_cut: float
    ceiling: float
    stop: float
    first_light: float  # transmittance that is left behind a first hit
    fog_density: float  # 1 / metres
    slopes: wp.vec4d  # of rays, -x, x, -y, y: EWA takes derivatives there where a centre lies further out
    ray_step: wp.float64  # behind a lens, where there are boxes: from a ray to the next sample's, at most
    splats: int  # of the cloud
    ray: wp.vec4  # a sample's ray is ((column - [2]) / [0], (row - [3]) / [1], 1), or (0, 0, 1) for distances


# Hides from the compiler that the number is the same, so that it reloads uniforms from memory: a view has
# more numbers than a GPU thread has registers.
@wp.func_native("""
    int same = number;
#if defined(__CUDA_ARCH__)
    asm volatile("" : "+r"(same));
#endif
    return same;
""")
def reread(number: int) -> int:
    """The number."""
    ...


@wp.func
def locate_tile(tile: int, views: wp.array(dtype=View)):
    """View of a tile among the tiles of all views, and its column and row of tiles there."""
    view = views[0]
    row = tile / view.tiles_x
    return row / view.tiles_y, tile % view.tiles_x, row % view.tiles_y


@wp.func
def first_sample(number: int, view: View) -> int:
    """Where the samples of a view begin in sample buffers."""
    return number * (view.tiles_x * view.tile_w) * (view.tiles_y * view.tile_h)


def struct_of(name: str, words: str, fields: dict):
    """A struct with these fields, name: type."""
    return wp.struct(type(name, (), {"__annotations__": fields, "__doc__": words, "__module__": __name__}))


@wp.func_native("return fmaf(a, b, c);")
def fma(a: float, b: float, c: float) -> float:
    """a b + c, rounded once."""
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
    const float4 quad = __ldg(reinterpret_cast<const float4*>(lines.data) + at);
    return wp::vec_t<4, wp::float32>(quad.x, quad.y, quad.z, quad.w);
#else
    return lines.data[at];
#endif
""")
def line_of(lines: wp.array(dtype=wp.vec4), at: int) -> wp.vec4:
    """lines[at], which nothing writes during the launch."""
    ...


# One 16-byte store on CUDA: each of four stores would touch all 32 records of a warp.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    reinterpret_cast<float4*>(lines.data)[at] = make_float4(value[0], value[1], value[2], value[3]);
#else
    lines.data[at] = value;
#endif
""")
def store_line(lines: wp.array(dtype=wp.vec4), at: int, value: wp.vec4):
    """lines[at] = value."""
    ...


@wp.func
def sortable(x: float) -> wp.uint32:
    """Bits of a float in an order that unsigned comparison keeps, negative values included. No
    depth is -0: it is a sum with a term of the view's, which is not.
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
    """How many bits are set."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
""")
def lowest(bits: wp.uint32) -> int:
    """Number of the lowest bit that is set; there must be one."""
    ...


@wp.func
def as_bits(low: int, high: int) -> float:
    """Two numbers from 0 to 65535 in the bits of a float."""
    return wp.cast((wp.uint32(high) << wp.uint32(16)) | wp.uint32(low), wp.float32)


@wp.func
def of_bits(bits: float):
    """The two numbers of `as_bits`."""
    both = wp.cast(bits, wp.uint32)
    return int(both & wp.uint32(0xFFFF)), int(both >> wp.uint32(16))


@wp.func
def to_sample(x: float, limit: int) -> int:
    """A sample's coordinate to int; clamped as a float, since conversions of huge values are undefined
    .
    """
    return int(wp.clamp(x, -1.0, float(limit) + 1.0))
