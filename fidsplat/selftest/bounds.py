"""Self-test group A: screen-space bounds, the near plane, and splats behind the camera."""

from __future__ import annotations

import math

import numpy as np

from fidsplat.render.renderer import Renderer
from fidsplat.scenes.random_clouds import log_uniform, random_splats
from fidsplat.selftest.agreement import (
    ALL_OUTPUTS,
    CULLED,
    FrameSpec,
    differing,
    render,
    render_intermediates,
)
from fidsplat.selftest.case import Finding, Found, case
from fidsplat.selftest.clouds import camera, quaternion, rotation, splats, subset_of
from fidsplat.splats.cloud import SplatCloud

FOCAL = 52.0  # 1000 px at a width of 1920 are 52 px at 100
GROUND = quaternion((1, 0, 0), (0, 0, 1))
"""quaternion of a splat in the ground plane: tangents along x and z"""
CUT = 1.0 / 255.0


def _spec(cloud: SplatCloud, focal: float = FOCAL, **view) -> FrameSpec:
    return FrameSpec(cloud, camera(focal=focal, **view), outputs=ALL_OUTPUTS)


def _ground(scale: float, depth: float = 5.0, below: float = 1.5) -> SplatCloud:
    return splats([[0, below, depth]], GROUND, scale)


def _wall(degrees: float) -> SplatCloud:
    """An upright splat at 0.4 m, rotated about y."""
    return splats([[0, 0, 0.4]], rotation((0, 1, 0), degrees), 0.2)


def _crossing(count: int = 300, seed: int = 1) -> SplatCloud:
    """Splats that may cross the camera plane, with centres in front of it or behind it."""
    generator = np.random.default_rng(seed)
    scales = log_uniform(generator, 0.05, 2.0, (count, 2))
    depths = generator.uniform(-1, 1, count) * 3.33 * scales.max(axis=1)
    means = np.column_stack([generator.uniform(-2, 2, (count, 2)), depths])
    opacities = generator.choice([0.05, 0.3, 0.9], count)
    return splats(means, generator.normal(size=(count, 4)), scales, opacities, generator.random((count, 3)))


@case("A1", "disk through the camera plane", "d >= 0: ground splat at 5 m, s = 1 to 4; wall at 0.4 m")
def a1(renderer: Renderer) -> Found:
    for scale in (1.0, 1.6, 2.0, 4.0):
        yield _spec(_ground(scale))
    for degrees in (45, 60, 85):
        yield _spec(_wall(degrees))
    yield _spec(_crossing())


def _ring(count: int = 60) -> SplatCloud:
    """Splats all around the camera, with random orientations."""
    generator = np.random.default_rng(2)
    angle = np.arange(count) / count * 2 * math.pi
    means = np.column_stack([np.sin(angle), generator.uniform(-0.5, 0.5, count), np.cos(angle)])
    colors = generator.random((count, 3))
    return splats(means, generator.normal(size=(count, 4)), (0.35, 0.2), 0.6, colors)


@case("A2", "fragments behind the camera", "s = 4 at 5 m; wall rotated by 85 deg; a ring")
def a2(renderer: Renderer) -> Found:
    yield _spec(_ground(4.0))
    yield _spec(_wall(85))
    yield _spec(_ring())
    # removing the culled splats must not change the image
    spec = _spec(_ring())
    buffers = render_intermediates(renderer, spec)
    visible = (
        buffers["order"] if buffers["keys"].dtype != np.uint32 else np.flatnonzero(buffers["keys"] != CULLED)
    )
    fewer = _spec(subset_of(spec.cloud, np.sort(visible)))
    changed = differing(render(renderer, spec), render(renderer, fewer), ALL_OUTPUTS)
    yield Finding("pixels that change without the culled splats", changed, 0)
    yield Finding("splats behind the camera that are not culled", float(len(visible)), len(spec.cloud) * 0.75)


@case("A3", "near-plane culling by the disk, not its centre", "s = 30 under the camera; near 0.01, 0.2, 1")
def a3(renderer: Renderer) -> Found:
    for near in (0.01, 0.2, 1.0):
        for depth in (0.0, -3.0):
            yield _spec(_ground(30.0, depth, below=1.7), near=near)
    yield _spec(_ground(30.0, 40.0, below=1.7), far=20.0)
    yield _spec(random_splats(100, seed=3), near=0.5, far=3.0)


def _tilted(ratio: float, degrees: float = 80.0, depth: float = 5.0, opacity: float = 1.0) -> SplatCloud:
    return splats([[0.1, 0.05, depth]], rotation((0.2, 1, 0), degrees), ratio * depth, opacity)


@case("A4", "box of a disk in perspective", "tilt 80 deg, s / z = 0.05 to 0.28; tiles")
def a4(renderer: Renderer) -> Found:
    for ratio in (0.05, 0.1, 0.2, 0.28):
        yield _spec(_tilted(ratio), focal=80.0)
    clouds = [_tilted(0.2), _crossing(60), random_splats(120, seed=4), _specks()]
    spec = _spec(SplatCloud.concatenate(clouds), width=93, height=77)
    if not renderer.backend.has("probe"):
        return
    base = render_intermediates(renderer, spec)
    for name, shape in renderer.backend.configs("tiles").items():
        changed = differing(base, render_intermediates(renderer, spec, shape), ALL_OUTPUTS)
        yield Finding(f"pixels that change with tiles of {name}", changed, 0)


def _specks() -> SplatCloud:
    """Opaque splats much smaller than a pixel, at and near tile borders."""
    x = np.array([14.6, 15.0, 15.4, 16.0, 30.7, 31.0, 32.0, 33.2, 47.9, 63.0, 64.0, 65.2])
    columns, rows = (grid.ravel() for grid in np.meshgrid(x, x))
    depth = 10.0
    means = [(columns - 46.5) / FOCAL * depth, (rows - 38.5) / FOCAL * depth, np.full(len(rows), depth)]
    return splats(np.column_stack(means), rotation((1, 2, 3), 40), 1e-4)


def _speck(x: float) -> FrameSpec:
    """One speck at pixel coordinate x, in the middle of row 20."""
    view = camera(focal=FOCAL)
    means = [[(x - view.cx) / FOCAL * 10, (20.5 - view.cy) / FOCAL * 10, 10]]
    return FrameSpec(splats(means, (1, 0, 0, 0), 1e-4), view, outputs=ALL_OUTPUTS)


@case("A5", "support of the low-pass", "s f / z = 5e-4 centred at x = 15.0, tile of 16")
def a5(renderer: Renderer) -> Found:
    for x in (15.0, 15.9, 31.3):
        yield _speck(x)
    yield _spec(_specks(), width=93, height=77)
    # the first pixel of the next tile is 1.5 px from x = 15.0: its alpha is exp(-1.5^2), as the low-pass has
    # a variance of 1/2
    alpha = render(renderer, _speck(15.0))["alpha"]
    yield Finding("alpha error across the tile border", abs(float(alpha[20, 16]) - math.exp(-2.25)), 2e-5)


@case("A6", "centre of the low-pass", "tilt 60 deg, s / z = 0.1 and 0.2")
def a6(renderer: Renderer) -> Found:
    for ratio in (0.1, 0.2):
        yield _spec(_tilted(ratio, 60.0), focal=80.0)
    yield _spec(_tilted(0.1, 60.0, opacity=0.3), focal=80.0)
    # no bright dot at the centre of the 3-sigma box, only the value of the disk
    spec = _spec(_tilted(0.2, 60.0), focal=80.0)
    alpha = render(renderer, spec)["alpha"].astype(float)
    # a dot would exceed its neighbours two pixels away by up to 0.7; a disk is smooth
    padded = np.pad(alpha, 2, mode="edge")
    around = np.max([padded[2:-2, :-4], padded[2:-2, 4:], padded[:-4, 2:-2], padded[4:, 2:-2]], axis=0)
    yield Finding("height of the largest dot above its surroundings", float((alpha - around).max()), 0.02)


@case("A7", "huge, tiny and thin splats", "s / z = 1e-6 to 1e6, anisotropy 1 to 1e6, denormal")
def a7(renderer: Renderer) -> Found:
    generator = np.random.default_rng(5)
    for ratio in (1e-6, 1e-3, 1.0, 1e3, 1e6):
        rows = []
        for anisotropy in (1.0, 1e2, 1e4, 1e6):
            for _ in range(5):
                rows.append((generator.normal(size=4), ratio * 4.0, ratio * 4.0 / anisotropy))
        quats = [row[0] for row in rows]
        means = np.column_stack([generator.uniform(-1.5, 1.5, (20, 2)), np.full(20, 4.0)])
        colors = generator.random((20, 3))
        yield _spec(splats(means, quats, [row[1:] for row in rows], 0.4, colors))
    # the smallest positive float32, and far behind the far plane
    means = [[0, 0, 4], [0.5, 0.2, 4], [-0.5, 0.1, -4], [0, 0, 1e6]]
    thin = [[1.0, 1.4e-45], [1.4e-45, 1.4e-45], [1.0, 1e-3], [1e5, 1e5]]
    yield _spec(splats(means, rotation((1, 1, 1), 30), thin, 0.7), far=1e5)
