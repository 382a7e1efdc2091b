"""Self-test group D: opacity, transmittance, depth outputs, colours and background."""

from __future__ import annotations

import numpy as np

from fidsplat.capture.quality import Quality
from fidsplat.render.renderer import Renderer
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.selftest.agreement import ALL_OUTPUTS, FrameSpec
from fidsplat.selftest.case import Finding, Found, case
from fidsplat.selftest.clouds import camera, rotation, splats
from fidsplat.splats.cloud import SplatCloud

CUT = 1.0 / 255.0
FACING = (1.0, 0.0, 0.0, 0.0)
# the ray through the centre of the middle pixel is the optical axis
SMALL = camera(25, 17, 20.0)
MIDDLE = (8, 12)
PARITY = ("gsplat", "surfel")


def stack(opacities, colors=(0.0, 0.0, 0.0), step: float = 0.1, size: float = 5.0) -> SplatCloud:
    """Stack of fronto-parallel layers, each with its opacity on the optical axis."""
    n = len(opacities)
    means = np.zeros((n, 3))
    means[:, 2] = 1.0 + step * np.arange(n)
    return splats(means, FACING, (size, size), opacities, colors)


def near_values(value: float, ulps) -> np.ndarray:
    """Float32 numbers at distances in ulp from a value."""
    bits = np.float32(value).view(np.int32) + np.asarray(ulps, np.int32)
    return bits.astype(np.int32).view(np.float32)


@case(
    "D1",
    "opaque layers occlude the background",
    "1 to 4 layers of opacity 1; opacity 0.99 +- 3 ulp under the exclusive stop at T = 1e-4",
)
def d1(renderer: Renderer) -> Found:
    stripes = [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]
    for n in (1, 2, 4):
        yield FrameSpec(stack([1.0] * n, stripes[:n]), SMALL)
    # the second layer lowers the transmittance to 1e-4 within a few ulps of opacity
    edge = near_values(0.99, [-3, -1, 0, 1, 3])
    for opacity in edge:
        layers = stack([opacity] * 3, stripes[:3])
        yield FrameSpec(layers, SMALL)
        yield FrameSpec(layers, SMALL, Quality.named("gsplat"))
    yield FrameSpec(stack([1.0, 0.999, 0.5], stripes[:3]), SMALL, Quality.named("surfel"))
    # in one coplanar group opaque splats share their pixels
    yield FrameSpec(
        stack([1.0, 1.0, 0.5, 1.0], stripes, step=0.0, size=0.3).with_coplanar_groups(0), camera(61, 45, 48.0)
    )

    def light(n: int, quality) -> float:
        frame = renderer.render(stack([1.0] * n), SMALL, quality=quality, background=(1.0, 1.0, 1.0))
        return float(frame["rgb"][MIDDLE].max())

    for n in (1, 2, 3, 4):
        yield Finding(f"light of the background through {n} opaque layers", light(n, None), 1e-4)
    for preset in PARITY:
        # these presets drop the second opaque layer, as their renderers do: any number transmits 1 %
        worst = max(abs(light(n, preset) - 0.01) for n in (1, 2, 3))
        yield Finding(f"{preset}: difference from the 1 % that its renderer transmits", worst, 1e-5)


@case(
    "D2",
    "the alpha cut-off is the same radius in bounds and pixels",
    "opacity 1/255 +- 7 ulp; 100 to 5000 layers of 0.0039; cut-offs 1e-6, 1e-4 and 0.1",
)
def d2(renderer: Renderer) -> Found:
    grid = np.stack(np.meshgrid(np.arange(2, 23, 5), np.arange(3, 15, 5)), axis=-1).reshape(-1, 2)
    steps = np.linspace(-7, 7, len(grid)).astype(int)
    means = np.column_stack([(grid + 0.5 - (SMALL.cx, SMALL.cy)) / SMALL.fx, np.ones(len(grid))])
    for sizes in ((0.2, 0.2), (1e-4, 1e-4)):
        faint = splats(means, FACING, sizes, near_values(CUT, steps), np.eye(3)[np.arange(len(grid)) % 3])
        yield FrameSpec(faint, SMALL)
    yield FrameSpec(stack([0.0039] * 300, step=0.01), SMALL, Quality.named("reference"))
    contours = random_splats(150, 21, depth=(1.0, 4.0), scale=(0.05, 0.5), across=1.5)
    yield FrameSpec(contours, camera(), Quality(alpha_cutoff=0.1))
    yield FrameSpec(contours, camera(), Quality(alpha_cutoff=1e-4))
    small = camera(3, 3, 20.0)

    def haze(n: int, opacity: float, quality) -> tuple[float, float]:
        frame = renderer.render(stack([opacity] * n, step=1e-3), small, ("alpha",), quality)
        return float(frame["alpha"][1, 1]), 1.0 - (1.0 - float(np.float32(opacity))) ** n

    # the cut-off removes haze by definition; it is a quality setting
    lost = haze(1000, 0.0039, Quality(alpha_cutoff=CUT))[0]
    yield Finding("alpha of 1000 layers of 0.0039 at the cut-off 1/255", lost, 0.0)
    for n in (100, 1000, 5000):
        rendered, expected = haze(n, 0.0039, Quality.named("reference"))
        yield Finding(
            f"error of alpha of {n} layers of 0.0039 without cut-off", abs(rendered - expected), 2e-5
        )
    rendered, expected = haze(1000, 0.004, None)
    yield Finding("error of alpha of 1000 layers of 0.004, above the cut-off", abs(rendered - expected), 2e-5)


@case(
    "D3",
    "transmittance underflow",
    "400 layers of opacity 0.3 to 1 with no stop, ordered and coplanar",
)
def d3(renderer: Renderer) -> Found:
    unending = Quality.named("reference")  # its transmittance stop is 0
    colors = np.resize(np.eye(3), (400, 3))
    for opacity in (0.3, 0.9, 1.0):
        layers = stack([opacity] * 400, colors, step=0.01)
        yield FrameSpec(layers, SMALL, unending)
    yield FrameSpec(
        stack([0.6] * 200, colors[:200], step=0.01).with_coplanar_groups(np.arange(200) // 40),
        SMALL,
        unending,
    )
    # transmittance falls through the denormals to 0, in layers and in coplanar groups
    layers = stack([0.9] * 400, [1.0, 0.5, 0.0], step=0.001)
    for cloud, name in ((layers, "layers"), (layers.with_coplanar_groups(0), "coplanar splats")):
        rgb = renderer.render(cloud, SMALL, quality="reference")["rgb"][MIDDLE]
        error = float(np.abs(rgb - (1.0, 0.5, 0.0)).max())
        yield Finding(f"colour error of 400 {name} whose transmittance underflows", error, 2e-5)


@case(
    "D4",
    "expected and median depth",
    "layers at T = 1, 0.6, 0.36; T = 1/2 +- 2 ulp; the faintest rendered splat; silhouettes",
)
def d4(renderer: Renderer) -> Found:
    tilted = splats(
        [[0.0, 0.0, 2.0], [0.3, -0.1, 2.2], [-0.4, 0.2, 1.5]],
        [rotation((1, 0, 0), 60), rotation((0, 1, 0), 75), rotation((1, 1, 0), 40)],
        (0.5, 0.4),
        [1.0, 0.7, 0.4],
        np.eye(3),
    )
    yield FrameSpec(tilted, camera(), outputs=ALL_OUTPUTS)
    silhouettes = random_splats(120, 5, depth=(0.5, 9.0), scale=(0.02, 0.5))
    yield FrameSpec(silhouettes, camera(), outputs=ALL_OUTPUTS)
    yield FrameSpec(silhouettes, camera(), Quality(alpha_cutoff=1e-3), ALL_OUTPUTS)
    names = ("alpha", "depth", "depth_median")

    def middle(opacities, depths) -> tuple[float, float]:
        means = np.zeros((len(depths), 3))
        means[:, 2] = depths
        cloud = splats(means, FACING, (50.0, 50.0), opacities)
        frame = renderer.render(cloud, SMALL, ALL_OUTPUTS)
        return float(frame["depth"][MIDDLE]), float(frame["depth_median"][MIDDLE])

    # T in front of the layers: 1, 0.6, 0.36; the second is the last with T above 1/2
    expected, median = middle([0.4, 0.4, 1.0], [1.0, 2.0, 4.0])
    yield Finding("expected depth of three layers, relative error", abs(expected / 2.32 - 1), 1e-6)
    yield Finding("median depth of three layers, error [m]", abs(median - 2.0), 0.0)
    expected, median = middle([0.3], [7.0])
    yield Finding("one faint layer: expected depth, relative error", abs(expected / 7 - 1), 1e-6)
    yield Finding("one faint layer: median depth, error [m]", abs(median - 7.0), 1e-6)
    for opacity in near_values(0.5, [-2, 0, 2]):  # T is 1/2 within rounding: both layers are valid medians
        median = middle([opacity, 1.0], [3.0, 5.0])[1]
        yield Finding(
            "T = 1/2: distance of the median from the nearer of its layers [m]",
            min(abs(median - 3), abs(median - 5)),
            1e-6,
        )
    # depth is 0 where alpha is below 1/255; the faintest splat above it has its own depth
    lone = splats([[0.0, 0.0, 3.0]], FACING, (0.05, 0.05), 1.01 / 255)
    frame = renderer.render(lone, SMALL, ALL_OUTPUTS, Quality(alpha_cutoff=1e-5))
    covered = frame["alpha"] >= np.float32(1 / 255)
    yield Finding("missing pixels of the faintest splat", float(not covered[MIDDLE]), 0.0)
    for name in names[1:]:
        depth = frame[name]
        stray = float(np.abs(depth[~covered]).max(initial=0.0))
        yield Finding(f"{name} where alpha is below 1/255 [m]", stray, 0.0)
        error = np.abs(depth[covered] / 3 - 1).max(initial=0.0)
        yield Finding(f"{name} of the faintest splat, relative error", float(error), 1e-6)


@case(
    "D5",
    "colours outside [0, 1] and the background",
    "colours -1 to 4 and 1e15, negative SH, backgrounds -1 to 3",
)
def d5(renderer: Renderer) -> Found:
    generator = np.random.default_rng(31)
    plain = random_splats(100, 31, depth=(1.0, 5.0), scale=(0.03, 0.5))
    bright = SplatCloud(
        plain.means, plain.quats, plain.scales, plain.opacities, colors=generator.uniform(-1.0, 4.0, (100, 3))
    )
    for background in ((0.0, 0.0, 0.0), (1.0, 0.5, 0.25), (3.0, -0.5, 0.1)):
        yield FrameSpec(bright, camera(), background=background)
    cloud = random_splats(100, 32, depth=(1.0, 5.0), scale=(0.03, 0.5))
    names, behind = ("rgb", "alpha"), (2.0, 0.5, -1.0)
    black = renderer.render(cloud, camera(), names)
    lit = renderer.render(cloud, camera(), names, background=behind)
    light = (1.0 - black["alpha"].astype(np.float64))[..., None]
    error = np.abs(lit["rgb"] - black["rgb"] - light * np.array(behind)).max()
    yield Finding("difference of the background from T times its colour", float(error), 1e-6)

    fire = splats([[0.0, 0.0, 2.0]], FACING, (0.05, 0.05), 0.9, (1e15, 1e15, 1e15))
    for marked in (False, True):
        both = SplatCloud.concatenate([cloud, fire])
        both = both.with_coplanar_groups(0) if marked else both
        without_fire = cloud.with_coplanar_groups(0) if marked else cloud
        frame = renderer.render(both, camera(), names)
        footprint = renderer.render(fire, camera(), names)["alpha"] > 0
        without = renderer.render(without_fire, camera(), names)
        name = "coplanar" if marked else "ordered"
        yield Finding(
            f"{name}: non-finite pixels next to a colour of 1e15",
            float((~np.isfinite(frame["rgb"])).sum()),
            0.0,
        )
        changed = (frame["rgb"] != without["rgb"]).any(-1) & ~footprint
        yield Finding(f"{name}: pixels that it changes outside of its footprint", float(changed.sum()), 0.0)
    dark = SplatCloud(fire.means, fire.quats, fire.scales, fire.opacities, sh=np.full((1, 1, 3), -9.0))
    lowest = float(renderer.render(dark, camera())["rgb"].min())
    yield Finding("negative part of a clamped SH colour", -lowest, 0.0)
