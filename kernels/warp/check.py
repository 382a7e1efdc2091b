"""Arithmetic of the device for the self-test (`fidsplat check`): results of the functions of the stages."""

import warp as wp

from .common import STRICT, fma
from .fast import fast_exp, fast_log, make_log

wp.set_module_options(STRICT)
ln = make_log(wp.float64)


@wp.kernel(enable_backward=False)
def arithmetic(
    exponents: wp.array(dtype=wp.float32),
    shares: wp.array(dtype=wp.float32),
    above: wp.array(dtype=wp.float32),
    below: wp.array(dtype=wp.float32),
    out: wp.array(dtype=wp.float32, ndim=2),  # (8, n): exp, log, division, root, fma, fast exp, log, 1 / x
):
    i = wp.tid()
    out[0, i] = wp.exp(exponents[i])
    out[1, i] = wp.log(shares[i])
    out[2, i] = above[i] / below[i]
    out[3, i] = wp.sqrt(below[i])
    out[4, i] = fma(above[i], below[i], above[i])
    out[5, i] = fast_exp(exponents[i])
    out[6, i] = fast_log(shares[i])
    out[7, i] = 1.0 / below[i]


@wp.kernel(enable_backward=False)
def arithmetic_wide(
    above: wp.array(dtype=wp.float64),
    below: wp.array(dtype=wp.float64),
    out: wp.array(dtype=wp.float64, ndim=2),  # (3, n): division, square root, ln
):
    i = wp.tid()
    out[0, i] = above[i] / below[i]
    out[1, i] = wp.sqrt(below[i])
    out[2, i] = ln(below[i])


@wp.kernel(enable_backward=False)
def denormal(given: wp.array(dtype=wp.float32), out: wp.array(dtype=wp.float32)):
    half = given[0] * given[1]
    out[0] = half
    out[1] = half + half


@wp.kernel(enable_backward=False)
def contraction(
    a: wp.array(dtype=wp.float32),
    b: wp.array(dtype=wp.float32),
    c: wp.array(dtype=wp.float32),
    difference: wp.array(dtype=wp.float32),
    total: wp.array(dtype=wp.float32),
    wide: wp.array(dtype=wp.float64),
    fused: wp.array(dtype=wp.float32),
):
    i = wp.tid()
    three = wp.float64(3.0)
    difference[i] = a[i] * b[i] - c[i] * b[i]  # a is c: 0 unless one product is not rounded
    total[i] = a[i] * b[i] + c[i]
    wide[i] = wp.float64(a[i]) / three * (wp.float64(b[i]) / three) - wp.float64(c[i]) / three * (
        wp.float64(b[i]) / three
    )
    product = a[i] * b[i]
    fused[i] = fma(a[i], b[i], -product)


@wp.kernel(enable_backward=False)
def not_a_number(x: wp.array(dtype=wp.float32), out: wp.array(dtype=wp.int32, ndim=2)):
    """Tests of x, (4, n): x != x, isnan, every comparison is false, isinf."""
    i = wp.tid()
    value = x[i]
    if value != value:
        out[0, i] = 1
    if wp.isnan(value):
        out[1, i] = 1
    if not (value > 0.0) and not (value <= 0.0):
        out[2, i] = 1
    if wp.isinf(value):
        out[3, i] = 1
