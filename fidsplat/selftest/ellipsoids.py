"""Self-test group G: 3D Gaussians (docs/primitives.md)."""

from __future__ import annotations

import math

import numpy as np

from fidsplat.render.renderer import Renderer
from fidsplat.scenes.random_clouds import log_uniform
from fidsplat.selftest.agreement import ALL_OUTPUTS, CATALOGUED, FrameSpec, render
from fidsplat.selftest.case import Finding, Found, case
from fidsplat.selftest.clouds import camera, rotation, splats
from fidsplat.splats.cloud import SplatCloud

ALONG_Z = (1.0, 0.0, 0.0, 0.0)
EXACT, EWA = CATALOGUED.with_(ellipsoid="exact"), CATALOGUED.with_(ellipsoid="ewa")


def _spec(cloud: SplatCloud, quality=EXACT, **view) -> FrameSpec:
    return FrameSpec(cloud, camera(**view), quality, ALL_OUTPUTS)


def _spread(scales, seed: int) -> SplatCloud:
    """3D Gaussians with standard deviations (n, 3) and random poses; the first is centred and not rotated."""
    generator = np.random.default_rng(seed)
    n = len(scales)
    means = np.column_stack([generator.uniform(-1.2, 1.2, (n, 2)), generator.uniform(1.0, 5.0, n)])
    quats = generator.normal(size=(n, 4))
    means[0], quats[0] = (0, 0, 2), ALONG_Z
    return splats(means, quats, scales, generator.uniform(0.2, 1, n), generator.random((n, 3)))


@case("G1", "needles", "anisotropy 1e3 to 1e6, from all directions and along the axis")
def g1(renderer: Renderer) -> Found:
    for anisotropy in (1e3, 1e6):
        yield _spec(_spread(np.tile([0.4 / anisotropy, 0.4 / anisotropy, 0.4], (30, 1)), 1))
        yield _spec(_spread(np.tile([0.4, 0.4 / anisotropy, 0.01], (30, 1)), 2))


@case("G2", "flat Gaussians equal disks", "third scale 1e-6 of the others, also edge-on")
def g2(renderer: Renderer) -> Found:
    generator = np.random.default_rng(3)
    flat = generator.uniform(0.1, 0.4, (40, 3))
    flat[:, 2] = 1e-6 * flat[:, :2].min(axis=1)
    thick = _spec(_spread(flat, 4))
    yield thick
    yield _spec(splats([[0, 0, 2]], rotation((1, 0, 0), 90), flat[:1]))
    disks = FrameSpec(thick.cloud.flattened(), thick.camera, EXACT, ALL_OUTPUTS)
    error = render(renderer, thick)["rgb"] - render(renderer, disks)["rgb"]
    psnr = -10 * math.log10(max(float((error**2).mean()), 1e-20))
    yield Finding("shortfall below 80 dB PSNR of flat 3D Gaussians against disks", 80 - psnr, 0)


@case(
    "G3",
    "camera inside of a Gaussian",
    "centre at the camera, behind it, at the near plane; Gaussians of 0.3 to 3 m; many at once",
)
def g3(renderer: Renderer) -> Found:
    generator = np.random.default_rng(5)
    for depth in (-0.5, -1e-3, 0.0, 1e-3, 0.0100001, 0.5):
        for size in (0.3, 3.0):
            yield _spec(splats([[0.05, -0.02, depth]], (1, 2, 3, 4), [[size, 0.3 * size, 0.1 * size]], 0.9))
    for seed in range(2):
        scales = log_uniform(generator, 0.02, 2.0, (60, 3))
        means = generator.uniform(-1, 1, (60, 3)) * scales.max(axis=1, keepdims=True) * 2
        quats, opacities = generator.normal(size=(60, 4)), generator.choice([0.05, 0.3, 0.9], 60)
        yield _spec(splats(means, quats, scales, opacities, generator.random((60, 3))), near=0.01 + seed)


@case("G4", "huge and tiny", "scale / distance 1e-6 to 1e6")
def g4(renderer: Renderer) -> Found:
    for ratio in (1e-6, 1e-3, 1.0, 1e3, 1e6):
        scales = ratio * np.random.default_rng(6).uniform(0.3, 1.5, (20, 3))
        yield _spec(_spread(scales, 7))


@case(
    "G5",
    "EWA projection as in 3DGS",
    "far below a pixel, needles, centres up to 3 image widths outside, in front of and behind the near plane",
)
def g5(renderer: Renderer) -> Found:
    generator = np.random.default_rng(8)
    yield _spec(_spread(log_uniform(generator, 1e-6, 1.0, (60, 3)), 9), EWA)
    n = 60
    depths = log_uniform(generator, 0.005, 4.0, n)
    means = np.column_stack([generator.uniform(-3, 3, (n, 2)) * depths[:, None], depths])
    scales = log_uniform(generator, 0.01, 1.0, (n, 3))
    cloud = splats(means, generator.normal(size=(n, 4)), scales, 0.5, generator.random((n, 3)))
    yield _spec(cloud, EWA)
