"""Comparison with the float64 reference: a tight tolerance, plus the certificate near thresholds."""

import numpy as np

from fidsplat.backends.base import View
from fidsplat.effects import select
from fidsplat.quality import Quality

ALL_OUTPUTS = ("rgb", "alpha", "depth", "depth_median", "normal", "label")
COLOR_TOLERANCE = 2e-5
DEPTH_TOLERANCE = 1e-4  # relative
RARE = 1e-3  # share of pixels whose median or label may flip, and whose certificate may exceed 0.05


def reference_pixels(judge, cloud, camera, outputs, quality, background=(0.0, 0.0, 0.0), pixels=None):
    """Reference planes with the certificate: whole, or at `pixels` = (rows, columns)."""
    quality = Quality.of(quality)
    features = select(cloud, outputs, quality)
    view = View.of(camera, quality, cloud.origin, background)
    pipeline, resident = judge.backend.pipeline(features), judge.backend.upload(cloud)
    if pixels is not None:
        return pipeline.pixels(resident, view, *pixels)
    return pipeline.render(resident, view).planes


def assert_agrees(
    renderer, judge, cloud, camera, outputs=ALL_OUTPUTS, quality=None, background=(0.1, 0.2, 0.3)
):
    """Draw with both and compare every plane; returns the frame."""
    quality = Quality.of(quality)
    frame = renderer.render(cloud, camera, outputs=outputs, quality=quality, background=background)
    truth = reference_pixels(judge, cloud, camera, (*outputs, "alpha"), quality, background)
    risk, alpha = truth["certificate"], truth["alpha"]
    assert (risk > 0.05).mean() < RARE
    covered = alpha > 1e-3
    spread = risk / np.where(covered, alpha, 1)
    for name in outputs:
        plane, want = frame[name], truth[name]
        assert plane.shape == want.shape
        assert np.isfinite(plane).all()
        error = np.abs(plane - want)
        if name in ("rgb", "alpha"):
            limit = COLOR_TOLERANCE + risk * max(1.0, float(np.abs(truth["rgb"]).max()))
            worst = (error - (limit[..., None] if error.ndim == 3 else limit)).max()
            assert worst <= 0, f"{name}: {worst:.2e} beyond tolerance and certificate"
        elif name == "depth":
            limit = DEPTH_TOLERANCE * np.abs(want) + spread * float(want.max(initial=0.0))
            worst = np.where(covered, error - limit, 0).max()
            assert worst <= 0, f"depth: {worst:.2e} m beyond tolerance and certificate"
        elif name == "normal":
            # blended normals may cancel, so their direction is compared where little can have cancelled
            limit = 1e-3 + 4 * spread
            wrong = covered & (error.max(2) > limit)
            assert wrong.mean() < RARE, f"normal: {wrong.mean():.2%} of the pixels differ"
        else:
            wrong = error > (DEPTH_TOLERANCE * np.abs(want) if name == "depth_median" else 0)
            assert wrong.mean() < RARE, f"{name}: {wrong.mean():.2%} of the pixels differ"
    return frame


def random_splats(count, seed, depth=(-1.0, 6.0), scale=(1e-3, 2.0), across=2.0, sh_degree=None):
    """A cloud with hard opacities around a camera at the origin that looks down +z."""
    from fidsplat.splats import SplatCloud

    generator = np.random.default_rng(seed)
    x, y = generator.uniform(-across, across, (2, count))
    means = np.stack([x, y, generator.uniform(*depth, count)], 1).astype(np.float32)
    quats = generator.normal(size=(count, 4)).astype(np.float32)
    scales = np.exp(generator.uniform(*np.log(scale), (count, 2))).astype(np.float32)
    opacities = generator.choice(np.float32([0.002, 0.05, 0.3, 0.5, 0.9, 0.99, 1.0]), count)
    labels = generator.integers(0, 9, count)
    if sh_degree is None:
        colors = generator.uniform(0, 1, (count, 3)).astype(np.float32)
        return SplatCloud(means, quats, scales, opacities, colors=colors, labels=labels)
    sh = generator.normal(0, 0.3, (count, (sh_degree + 1) ** 2, 3)).astype(np.float32)
    return SplatCloud(means, quats, scales, opacities, sh=sh, labels=labels)
