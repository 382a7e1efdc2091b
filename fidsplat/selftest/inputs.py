"""Self-test group E: broken and extreme inputs, image sizes, integer ranges, unwritten memory."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.effects import select
from fidsplat.render.renderer import Renderer
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.selftest.agreement import ALL_OUTPUTS, CATALOGUED, FrameSpec
from fidsplat.selftest.case import Finding, Found, case
from fidsplat.selftest.clouds import camera, rotation, splats, subset_of
from fidsplat.splats.cloud import SplatCloud

NAN, INF = float("nan"), float("inf")
DENORMAL = 1e-45
CORRUPTED = 7
"""index of the splat whose fields are corrupted"""
VIEW = camera(60, 45, 48.0)

BROKEN = {
    "means": (NAN, -NAN, INF, -INF, 1e38, -1e38),
    "quats": (NAN, INF, -INF),
    "scales": (NAN, INF, -INF, 0.0, -0.0, -1.0, -DENORMAL, 1e38),
    "opacities": (NAN, INF, -INF, -DENORMAL, -0.5, 1.0000001, 2.0, 1e38),
    "colors": (NAN, INF, -INF, 1e38, -1e38),
}
"""field -> values of an invalid splat"""
ODD = {
    "means": (0.0, -0.0, DENORMAL, -1e-39),
    "quats": (0.0, -0.0, DENORMAL, 1e38, -1e38),
    "scales": (DENORMAL, 1e-38, 1e-20, 1e6, 1e12, 1e15),
    "opacities": (0.0, -0.0, DENORMAL, 1e-10, 1.0),
    "colors": (0.0, -0.0, DENORMAL, -DENORMAL, -2.0),
}
"""field -> unusual valid values"""


def crowd() -> SplatCloud:
    """A cloud in which the splat `CORRUPTED` covers the image centre."""
    cloud = random_splats(40, 41, depth=(1.0, 5.0), scale=(0.03, 0.4), across=1.0)
    in_front = splats([[0.05, 0.02, 1.2]], rotation((1, 1, 0), 30), (0.3, 0.2), 0.9, (0.2, 0.9, 0.4))
    before, after = subset_of(cloud, np.arange(CORRUPTED)), subset_of(cloud, np.arange(CORRUPTED, len(cloud)))
    return SplatCloud.concatenate([before, in_front, after])


def corrupted(cloud: SplatCloud, changes: Mapping[str, Any]) -> SplatCloud:
    """A copy of the cloud with changed fields of the splat `CORRUPTED`, which is dropped if it is invalid."""
    arrays = {name: getattr(cloud, name).copy() for name in BROKEN}
    for name, value in changes.items():
        arrays[name][CORRUPTED] = value
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return SplatCloud(**arrays, labels=cloud.labels)


def broken_fields(cloud: SplatCloud) -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and changed fields, for each field, component and broken value."""
    for name, values in BROKEN.items():
        field = getattr(cloud, name)[CORRUPTED]
        for value in values:
            for k in range(max(field.size, 1)):
                changed = np.array(field)
                changed[k if field.ndim else ()] = value
                yield f"{name}[{k}] = {value}", {name: changed}
    yield "quats = 0", {"quats": 0.0}
    yield "quats = denormal", {"quats": DENORMAL}
    zeros = {name: 0.0 for name in ("means", "quats", "colors")}
    yield "an all-zero row of a file", {**zeros, "scales": 1.0, "opacities": 0.5}


@case(
    "E1",
    "broken and odd values of every field",
    "NaN, +-inf, +-0, denormals, 1e38 in each component; zero quaternions; opacities outside [0, 1]",
)
def e1(renderer: Renderer) -> Found:
    cloud = crowd()
    for name, values in ODD.items():
        for value in values:
            field = np.array(getattr(cloud, name)[CORRUPTED])
            field[0 if field.ndim else ()] = value
            outputs = ALL_OUTPUTS if name == "scales" else ("rgb", "alpha")
            yield FrameSpec(corrupted(cloud, {name: field}), VIEW, outputs=outputs)
    yield FrameSpec(corrupted(cloud, {"scales": DENORMAL}), VIEW, outputs=ALL_OUTPUTS)
    yield FrameSpec(corrupted(cloud, {"means": (0.0, 0.0, 1e15), "scales": 1e15}), VIEW)
    yield FrameSpec(corrupted(cloud, {"means": (1e15, -1e15, 1e15)}), VIEW)
    cloud = crowd()
    without = subset_of(cloud, np.delete(np.arange(len(cloud)), CORRUPTED))
    expected = renderer.render(without, VIEW, ALL_OUTPUTS)
    different = miscounted = tried = 0
    for _, changes in broken_fields(cloud):
        bad = corrupted(cloud, changes)
        frame = renderer.render(bad, VIEW, ALL_OUTPUTS)
        same = all(np.array_equal(frame[name], expected[name]) for name in ALL_OUTPUTS)
        different += not same
        counted = sum(bad.dropped.values()) == 1 and len(bad) == len(without)
        miscounted += not (counted and frame.stats == expected.stats)
        tried += 1
    yield Finding(f"invalid values that change the image, of {tried}", different, 0)
    yield Finding("invalid values that are not counted as one dropped splat", miscounted, 0)


@case(
    "E2",
    "centres far outside of the image",
    "1e3 to 1e15 pixels outside, with disks that reach into the image and without",
)
def e2(renderer: Renderer) -> Found:
    # disks whose centres project far outside of the image and whose rims reach into it
    generator = np.random.default_rng(42)
    for pixels in (1e3, 1e6, 1e9, 1e12):
        n = 24
        angle = generator.uniform(0, 2 * np.pi, n)
        depth = generator.uniform(1.0, 4.0, n)
        offset = pixels / VIEW.fx * depth
        means = np.column_stack([offset * np.cos(angle), offset * np.sin(angle), depth])
        scales = offset[:, None] / generator.uniform(0.4, 3.4, (n, 2))
        quats = [rotation((0, 0, 1), degrees) for degrees in generator.uniform(0, 180, n)]
        colors = generator.uniform(0, 1, (n, 3))
        yield FrameSpec(splats(means, quats, scales, generator.uniform(0.3, 1.0, n), colors), VIEW)
    # centres that project to 1e6 pixels and more because of a tiny depth
    means = np.column_stack([generator.uniform(-2, 2, (40, 2)), 10 ** generator.uniform(-7, -1, 40)])
    yield FrameSpec(
        splats(means, generator.normal(size=(40, 4)), (0.5, 0.8), 0.8), camera(60, 45, 48.0, near=1e-8)
    )
    # 2 to 1e15 pixels outside: no tile lists them
    pairs = visible = 0
    for pixels in (2.5, 1e2, 1e6, 1e9, 1e12, 1e15):
        for x, y in ((-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, 1)):
            at = [(0.5 + 0.5 * x) * VIEW.width + x * pixels, (0.5 + 0.5 * y) * VIEW.height + y * pixels]
            mean = [[(at[0] - VIEW.cx) / VIEW.fx, (at[1] - VIEW.cy) / VIEW.fy, 1.0]]
            stats = renderer.render(splats(mean, (1, 0, 0, 0), (1e-6, 1e-6)), VIEW, quality=CATALOGUED).stats
            pairs, visible = pairs + stats["pairs"], visible + stats["visible"]
    if not renderer.device.always_float64:  # the reference renderer computes no bounding boxes
        yield Finding("splats outside of the image that are not culled", visible, 0)
    yield Finding("tiles that list them", pairs, 0)


@case(
    "E3",
    "more splat-tile pairs than an integer or the memory holds",
    "list lengths that add up to 2^31 - 1 .. 5 * 2^32 + 17; budgets from one pair upwards",
)
def e3(renderer: Renderer) -> Found:
    # sums beyond 32 bits, and a frame that is rendered in ranges of tiles
    backend = renderer.backend
    if not backend.has("probe"):
        return
    cloud = random_splats(200, 43, depth=(0.5, 4.0), scale=(0.05, 1.0))
    pipeline = backend.pipeline(select(cloud, Capture(outputs=("rgb", "alpha"))))
    generator = np.random.default_rng(0)
    wrong = 0
    for total in (2**31 - 1, 2**31, 2**32 - 1, 2**32, 5 * 2**32 + 17):
        for lists in (1, 2, 1000, 4097):
            lengths = (
                generator.multinomial(total, np.full(lists, 1 / lists)) if lists > 1 else np.array([total])
            )
            if lengths.max() >= 2**32:
                continue
            starts, counted = backend.probe().scan(pipeline, lengths.astype(np.uint32))
            expected = np.concatenate([[0], np.cumsum(lengths)]) % 2**32
            wrong += counted != total or not np.array_equal(starts, expected)
    yield Finding("wrong sums of list lengths around 2^31 and 2^32", wrong, 0)

    unbanded = renderer.render(cloud, VIEW, ALL_OUTPUTS)
    budget = backend.pair_budget
    different = 0
    try:
        for backend.pair_budget in (1, 37, unbanded.stats["pairs"] // 2, unbanded.stats["pairs"] - 1):
            banded = renderer.render(cloud, VIEW, ALL_OUTPUTS)
            different += not all(np.array_equal(banded[name], unbanded[name]) for name in ALL_OUTPUTS)
            different += banded.stats != unbanded.stats
    finally:
        backend.pair_budget = budget
    yield Finding("pair budgets from 1 to all but one that change the image", different, 0)


SIZES = (
    *((1, 1), (2, 1), (1, 2), (1, 41), (41, 1)),
    *((15, 17), (16, 16), (17, 33), (31, 15), (16384, 1), (1, 16384)),
)
"""pixels: width, height"""


def sized(width: int, height: int) -> Camera:
    """Camera for images of any size, with the splats of `crowd` in view."""
    focal = 0.8 * max(width, height)
    return Camera.pinhole(width, height, focal, focal, width / 2, height / 2)


@case(
    "E4",
    "empty and degenerate images",
    "0 splats, 0 visible, 1 pair in 80 tiles; 1 x 1 to 16384 x 1 pixels, no multiples of a tile",
)
def e4(renderer: Renderer) -> Found:
    cloud = random_splats(12, 44, depth=(1.0, 4.0), scale=(0.05, 0.6), across=0.8)
    for width, height in SIZES:
        yield FrameSpec(cloud, sized(width, height))
    tiny = splats([[0.0, 0.0, 2.0]], (1, 0, 0, 0), (1e-3, 1e-3))
    yield FrameSpec(tiny, sized(160, 120))  # one pair, many tiles
    yield FrameSpec(tiny, sized(160, 120), outputs=ALL_OUTPUTS)
    nothing = SplatCloud.empty()
    behind = splats([[0.0, 0.0, -3.0]], (1, 0, 0, 0), (0.1, 0.1))
    clear = splats([[0.0, 0.0, 2.0]], (1, 0, 0, 0), (0.1, 0.1), 0.0)
    wrong = counted = 0
    background = (0.25, 0.5, 0.75)
    for cloud in (nothing, behind, clear):
        for width, height in ((1, 1), (60, 45), (3000, 1)):
            # after a crowded frame, so that stale buffers would be visible
            renderer.render(crowd(), sized(width, height), ALL_OUTPUTS)
            frame = renderer.render(cloud, sized(width, height), ALL_OUTPUTS, background=background)
            empty = np.array_equal(frame["rgb"], np.broadcast_to(background, (height, width, 3)))
            empty &= not any(frame[name].any() for name in ("alpha", "depth", "depth_median", "normal"))
            empty &= bool((frame["label"] == -1).all())
            wrong += not empty
            counted += frame.stats["visible"] + frame.stats["pairs"]
    yield Finding("empty frames that differ from the background", wrong, 0)
    if not renderer.device.always_float64:
        yield Finding("splats and pairs counted in them", counted, 0)


@case("E5", "unwritten memory", "all buffers filled with 0xFF before the frame")
def e5(renderer: Renderer) -> Found:
    # buffers full of NaN before the frame: none may survive
    backend = renderer.backend
    if not backend.has("probe"):
        return
    different = 0
    for cloud in (crowd(), crowd().with_coplanar_groups(0), SplatCloud.empty()):
        for width, height in ((60, 45), (33, 1), (1, 1)):
            for quality in (Quality(), Quality(samples=2)):
                clean = renderer.render(cloud, sized(width, height), ALL_OUTPUTS, quality)
                with backend.probe().poisoned():
                    frame = renderer.render(cloud, sized(width, height), ALL_OUTPUTS, quality)
                    poisoned = {name: frame[name] for name in ALL_OUTPUTS}
                different += not all(np.array_equal(poisoned[name], clean[name]) for name in ALL_OUTPUTS)
    yield Finding("frames that change after their buffers contained NaN", different, 0)
