"""Self-test group F: device arithmetic in ulp over the ranges that rendering uses; barriers, sorting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fidsplat.backends.prepare import prepare
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.render.renderer import Renderer
from fidsplat.scenes.random_clouds import log_uniform, random_splats
from fidsplat.selftest.agreement import ALL_OUTPUTS, CULLED, FrameSpec, out_of_order
from fidsplat.selftest.case import Finding, Found, case
from fidsplat.selftest.clouds import camera, splats
from fidsplat.splats.cloud import SplatCloud

_COUNT = 1 << 18
# error bounds in ulp: those of OpenCL C 1.2 (section 7.4) with correctly rounded reciprocals; for the fast
# functions the maximum over all arguments, with and without fused multiply-add (tools/fast_bounds.py)
BOUNDS = {
    "exp": 3.0,
    "log": 3.0,
    "division": 2.5,
    "sqrt": 3.0,
    "fma": 0.5,
    "division64": 0.5,
    "sqrt64": 0.5,
    "log64": 3.0,
    "fast_exp": 2.3,
    "fast_log": 1.1,
    "reciprocal": 0.5,
}
VIEW = camera(60, 45, 48.0)
UNSAFE = ("fast", "unsafe", "finite", "denorms", "mad-enable", "signed-zeros")
"""parts of build options that violate IEEE arithmetic"""


@dataclass(frozen=True)
class Arithmetic:
    """Measured arithmetic of a device."""

    float64: bool
    """whether the device has float64, for the per-splat projection"""
    denormals: bool
    """whether float32 numbers below 1.2e-38 are not flushed to 0"""
    ulp: dict[str, float]
    """largest error of each available function of `BOUNDS`"""

    @property
    def findings(self) -> list[Finding]:
        """Error of each function with its bound, including a margin for the rounding of the exact value."""
        return [Finding(f"{name} [ulp]", ulp, BOUNDS[name] * 1.001) for name, ulp in self.ulp.items()]


def measure(renderer: Renderer, seed: int = 0) -> Arithmetic | None:
    """Measure a device on a quarter of a million arguments of each function; None for a backend without
    kernels, such as the reference.

    Arguments: exp from -14 (1e-6, the smallest cut-off of a preset) to 0; log from 2^-24 to 1
    (transmittances); quotients and roots from 1e-9 to 1e9.

    Raises:
        DeviceError: the device cannot compile or run the kernels.
    """
    backend = renderer.backend
    if not backend.has("probe"):
        return None
    generator = np.random.default_rng(seed)
    exponents = generator.uniform(-14, 0, _COUNT).astype(np.float32).astype(float)
    fractions = log_uniform(generator, 2.0**-24, 1.0, _COUNT).astype(np.float32).astype(float)
    above, below = (
        log_uniform(generator, 1e-9, 1e9, _COUNT).astype(np.float32).astype(float) for _ in range(2)
    )
    got = backend.probe().arithmetic(exponents, fractions, above, below)
    wide_above, wide_below = above.astype(np.longdouble), below.astype(np.longdouble)
    exact = {
        "exp": np.exp(exponents),
        "log": np.log(fractions),
        "division": above / below,
        "sqrt": np.sqrt(below),
        "fma": above * below + above,
        "division64": wide_above / wide_below,
        "sqrt64": np.sqrt(wide_below),
        "log64": np.log(wide_below),
        "fast_exp": np.exp(exponents),
        "fast_log": np.log(fractions),
        "reciprocal": 1 / below,
    }
    ulp = {name: worst(got[name], exact[name]) for name in exact if name in got}
    denormals = bool(got["denormal"][0] > 0 and got["denormal"][1] == np.finfo(np.float32).tiny)
    return Arithmetic(renderer.device.float64, denormals, ulp)


def worst(got: np.ndarray, exact: np.ndarray) -> float:
    """Largest error of `got` in ulp of its type, both (n,); infinite if a value is not finite."""
    spacing = np.spacing(np.abs(exact).astype(got.dtype))
    # np.max alone would not report infinity for a NaN
    errors = np.abs(got - exact) / spacing
    return float(errors.max()) if np.isfinite(errors).all() else float("inf")


@case(
    "F1",
    "products are rounded before they are subtracted",
    "a b - a b in float32 and in the projection's precision; FMA where requested",
)
def f1(renderer: Renderer) -> Found:
    # products are rounded before subtraction, and FMA fuses if the device declares it
    if not renderer.backend.has("probe"):
        return
    probe = renderer.backend.probe()
    generator = np.random.default_rng(61)
    a, b = generator.uniform(0.5, 2.0, (2, 4096)).astype(np.float32)
    difference, total, wide, fused = probe.contraction(a, b)
    yield Finding("a b - a b that is not 0", int(np.count_nonzero(difference)), 0)
    yield Finding("the same in the projection's precision", int(np.count_nonzero(wide)), 0)
    yield Finding("a b + c that is not rounded twice", int(np.count_nonzero(total != a * b + a)), 0)
    product = a.astype(float) * b.astype(float)  # exact, and so is its rounding error
    expected = (product - (a * b)) if probe.fuses else np.zeros(len(a))
    yield Finding("FMA(a, b, c) with wrong rounding", int(np.count_nonzero(fused != expected)), 0)


@case(
    "F2",
    "precision of exp, log, division and square root",
    "a quarter of a million arguments each: exp of -14 to 0, quotients and roots of 1e-9 to 1e9",
)
def f2(renderer: Renderer) -> Found:
    # exp, log, division and square root against float64, by the bounds of OpenCL
    measured = measure(renderer)
    yield from measured.findings if measured else ()


@case("F3", "NaN and infinity are detected", "quiet, negative and signalling NaN; the build options")
def f3(renderer: Renderer) -> Found:
    # neither a build option nor the compiler assumes that there is no NaN
    if not renderer.backend.has("probe"):
        return
    probe = renderer.backend.probe()
    unsafe = [option for option in probe.options() if any(word in option for word in UNSAFE)]
    yield Finding("build options that violate IEEE arithmetic", len(unsafe), 0)
    quiet, signalling = [0x7FC00000, 0xFFC00000], [0x7F800001]
    bits = [*quiet, *signalling, 0x7F800000, 0xFF800000, 0, 0x80000000, 0x3F800000, 0xBF800000, 1]
    x = np.array(bits, np.uint32).view(np.float32)
    unequal, named, survives, infinite = probe.not_a_number(x)
    is_nan = np.isnan(x)
    for name, found in (("x != x", unequal), ("isnan(x)", named), ("a comparison that fails", survives)):
        yield Finding(f"NaN misjudged by {name}", int((found.astype(bool) != is_nan).sum()), 0)
    yield Finding("misjudged infinities", int((infinite.astype(bool) != np.isinf(x)).sum()), 0)


@case("F4", "denormals", "opacities, scales, colours and backgrounds of 1e-45 to 1e-30")
def f4(renderer: Renderer) -> Found:
    # weights, scales and colours at and below the smallest normal number
    quality = Quality(alpha_cutoff=1e-30, transmittance_stop=0.0)
    means = [[0.1 * k - 0.4, 0.05 * k - 0.2, 1.0 + 0.2 * k] for k in range(9)]
    opacities = [1e-38, 1e-40, 1e-30, 1e-20, 1e-10, 1e-5, 0.5, 1.0, 0.9]
    faint = splats(means, (1, 0.2, 0.1, 0), (0.2, 0.3), opacities)
    yield FrameSpec(faint, VIEW, quality)
    thin = splats(means, (1, 0.2, 0.1, 0), [[1e-38, 0.3]] * 4 + [[0.3, 1e-42]] * 5, 0.8)
    yield FrameSpec(thin, VIEW, outputs=ALL_OUTPUTS)
    dark = splats(means, (1, 0.2, 0.1, 0), (0.2, 0.3), 0.7, (1e-39, 1e-44, 1e-38))
    yield FrameSpec(dark, VIEW, background=(1e-40, 0.0, 1e-45))
    measured = measure(renderer)
    if measured:
        # flushing denormals is valid: rendered weights are larger (the presets' cut-off is at least 1e-6)
        yield Finding("denormals are flushed to 0 (1) or preserved (0)", float(not measured.denormals), 1)


@case(
    "F5",
    "barriers",
    "tile lists of 0 to 300 splats with 64 staged at a time, pixels that terminate at different times",
)
def f5(renderer: Renderer) -> Found:
    # schedules with and without barriers must agree; on a GPU, different work-group sizes must agree
    backend = renderer.backend
    if not backend.has("probe"):
        return
    # lists of up to several batches of staged splats (128), and pixels that terminate early
    crowded = random_splats(260, 65, depth=(0.8, 1.5), scale=(0.02, 0.25), across=0.25)
    cloud = SplatCloud.concatenate([crowded, random_splats(60, 66, depth=(1.5, 6.0), scale=(0.05, 0.5))])
    features, view = prepare(cloud, Capture(VIEW, ALL_OUTPUTS, background=(0.1, 0.2, 0.3)))
    resident = backend.upload(cloud)
    base = backend.pipeline(features).render_view(resident, view)
    (schedule,) = backend.configs("schedule").values()
    other = backend.pipeline(features, schedule).render_view(resident, view)
    for name in ("rgb", "alpha", "depth"):
        error = np.abs(other.read(name) - base.read(name)).max()
        yield Finding(f"{name}: difference between schedules", float(error), 5e-6)
    labels = (other.read("label") != base.read("label")).mean()
    yield Finding("fraction of pixels with another label", float(labels), 1e-3)


def in_a_row(depths) -> SplatCloud:
    """One splat on the optical axis for each depth."""
    means = np.zeros((len(depths), 3))
    means[:, 2] = depths
    return splats(means, (1, 0, 0, 0), (0.05, 0.05), 0.05)


@case(
    "F6",
    "sorting and prefix sums",
    "1 to 4097 splats around the number of sort blocks; ties, one depth, descending, half of them culled",
)
def f6(renderer: Renderer) -> Found:
    # depth order, tile lists and their starts at awkward lengths, against NumPy's stable sort
    backend = renderer.backend
    if not backend.has("probe"):
        return
    generator = np.random.default_rng(67)
    features, view = prepare(in_a_row([1.0]), Capture(VIEW))
    unsorted = unlisted = tried = 0
    for config in backend.configs("sorting").values():
        pipeline = backend.pipeline(features, config)
        c = config.sort_blocks
        for n in sorted({1, 2, 3, c - 1, c, c + 1, 2 * c + 1, 255, 256, 257, 1000, 4097} - {0}):
            for kind in ("random", "few values", "one value", "descending", "half culled"):
                depths = generator.uniform(1.0, 9.0, n)
                if kind == "few values":
                    depths = np.round(depths)
                elif kind == "one value":
                    depths[:] = 3.0
                elif kind == "descending":
                    depths = np.sort(depths)[::-1]
                elif kind == "half culled":
                    depths[::2] *= -1
                buffers = pipeline.render_intermediates(backend.upload(in_a_row(depths)), view)
                keys = buffers["keys"]
                visible = np.flatnonzero(keys != CULLED)
                expected = visible[np.argsort(keys[visible], kind="stable")]
                unsorted += out_of_order(buffers, expected) > 0
                unsorted += not np.array_equal(visible, np.flatnonzero(depths > 0))
                unlisted += not _lists_are_complete(buffers, len(expected))
                tried += 1
    yield Finding(f"unstable depth orders, of {tried}", unsorted, 0)
    yield Finding("tile lists that lack a splat or have a wrong start", unlisted, 0)


def _lists_are_complete(buffers: dict[str, np.ndarray], visible: int) -> bool:
    starts = buffers["starts"].astype(np.int64)
    complete = starts[0] == 0 and starts[-1] == len(buffers["lists"]) and bool((np.diff(starts) >= 0).all())
    # all splats are on the axis: the tiles around the centre list every one
    return complete and int(np.diff(starts).max()) == visible
