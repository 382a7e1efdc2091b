"""Exponentials and logarithms by sums and products, which all devices round equally. Blending uses them for
`arithmetic="fast"`, the projection of splats always.

Polynomials and error bounds are those of kernels/opencl/effect/arithmetic_fast.cl and math.cl; results are
bit-identical.
"""

from functools import cache

import warp as wp

from .common import fma

_LOG2_E, _LN2_HIGH, _LN2_LOW = wp.constant(1.44269504), wp.constant(-0.693359375), wp.constant(2.12194440e-4)
_LN2 = wp.constant(6.93147181e-1)
_ROUNDER = wp.constant(12582912.0)  # 1.5 * 2^23: the last bits of a sum are the integer
_MIN_ARGUMENT = wp.constant(-87.0)
_MANTISSA_BITS = wp.constant(wp.uint32(23))
_MANTISSA = wp.constant(0x7FFFFF)
_ROOT_HALF = wp.constant(0x3F3504F3)  # bits of sqrt(1/2)


@wp.func
def fast_exp(x: float) -> float:
    """e^x for x <= 0, within 2 ulp; e^-87 = 1.6e-38 below -87."""
    y = wp.max(x, _MIN_ARGUMENT)
    sum = fma(y, _LOG2_E, _ROUNDER)
    k = sum - _ROUNDER
    r = fma(k, _LN2_LOW, fma(k, _LN2_HIGH, y))  # ln 2 in two words: the inner one is exact
    p = fma(8.29030946e-3, r, 4.18979935e-2)
    p = fma(p, r, 1.66676372e-1)
    p = fma(p, r, 4.99991477e-1)
    p = fma(p, r, 9.99999702e-1)
    p = fma(p, r, 1.0)
    return wp.cast(wp.cast(p, wp.uint32) + (wp.cast(sum, wp.uint32) << _MANTISSA_BITS), wp.float32)


@wp.func
def fast_log(x: float) -> float:
    """ln x for normal x > 0, within 1 ulp."""
    bits = wp.cast(x, wp.int32) - _ROOT_HALF
    m = wp.cast((bits & _MANTISSA) + _ROOT_HALF, wp.float32) - 1.0
    m2 = m * m
    p = fma(7.0376836292e-2, m, -1.1514610310e-1)
    p = fma(p, m, 1.1676998740e-1)
    p = fma(p, m, -1.2420140846e-1)
    p = fma(p, m, 1.4249322787e-1)
    p = fma(p, m, -1.6668057665e-1)
    p = fma(p, m, 2.0000714765e-1)
    p = fma(p, m, -2.4999993993e-1)
    p = fma(p, m, 3.3333331174e-1)
    p = fma(m2, -0.5, p * m * m2)
    return fma(float(bits >> 23), _LN2, m + p)


@cache
def make_log(real):
    """Make the natural logarithm for the projection, for normal x > 0; finite for every other x."""
    integer, shift = (wp.int64, 52) if real is wp.float64 else (wp.int32, 23)
    root_half = wp.constant(integer(0x3FE6A09E667F3BCD if real is wp.float64 else 0x3F3504F3))
    mantissa, exponent = wp.constant(integer((1 << shift) - 1)), wp.constant(integer(shift))

    @wp.func
    def ln(x: real) -> real:
        bits = wp.cast(x, integer) - root_half
        k = real(bits >> exponent)
        f = wp.cast((bits & mantissa) + root_half, real) - real(1.0)
        s = f / (real(2.0) + f)
        z, half_square = s * s, real(0.5) * f * f
        w = z * z
        even = real(2.222219843214978396e-01) + w * real(1.531383769920937332e-01)
        even = w * (real(3.999999999940941908e-01) + w * even)
        odd = real(1.818357216161805012e-01) + w * real(1.479819860511658591e-01)
        odd = z * (real(6.666666666666735130e-01) + w * (real(2.857142874366239149e-01) + w * odd))
        r = even + odd
        # ln 2 in two words
        low = s * (half_square + r) + k * real(1.90821492927058770002e-10)
        return k * real(6.93147180369123816490e-01) - ((half_square - low) - f)

    return ln
