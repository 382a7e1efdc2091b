"""The reference: what it leaves out as unseen changes nothing."""

import numpy as np
import pytest
from agreement import random_splats
from combined import LENSES, SWITCHES

import fidsplat as fs
from fidsplat.backends.reference import backend
from fidsplat.effects import OUTPUTS
from fidsplat.hard_cases.agreement import Picture, truth_of

CAMERAS = {"pinhole": fs.Camera.pinhole(37, 22, 30.0, 30.0, 18.0, 11.0)}
CAMERAS |= {name: SWITCHES[name].camera for name in LENSES}
LOWPASSES = ("none", "screen", "pixel")


def clouds():
    """From below a pixel to across the picture, around the camera; ellipsoids, thin boxes, planes."""
    cloud = random_splats(90, 3, depth=(-5.0, 6.0), scale=(1e-4, 5.0))
    scales = cloud.scales.copy()
    scales[::4, 0] = 1e-5
    lines = fs.SplatCloud(cloud.means, cloud.quats, scales, cloud.opacities, colors=cloud.colors)
    group = np.arange(90) // 3
    thick = np.column_stack([cloud.scales, cloud.scales.mean(1) * (group % 3)])
    # balls that the camera is just outside of: their rims lie far from those of disks of their size
    thick[::5] = np.linalg.norm(cloud.means[::5], axis=1, keepdims=True) / 5.6
    return {
        "splats": cloud,
        "ellipsoids": fs.SplatCloud(cloud.means, cloud.quats, thick, cloud.opacities, colors=cloud.colors),
        "boxes": lines.with_boxes(),
        "planes": cloud.with_boxes(group % 2 == 0).with_planes(np.maximum(group % 8 - 2, -1)),
    }


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("kind", clouds())
def test_a_splat_that_is_left_out_of_a_tile_is_not_seen_there(monkeypatch, camera, kind):
    shares = []

    def counted(setup, view, x, y):
        seen = choose(setup, view, x, y)
        shares.append(seen.mean())
        return seen

    choose = backend.may_see
    monkeypatch.setattr(backend, "_BLOCK", 1 << 15)
    for lowpass in LOWPASSES:
        quality = fs.Quality(lowpass=lowpass, ellipsoid="exact")
        picture = Picture(clouds()[kind], camera, quality, tuple(OUTPUTS))
        monkeypatch.setattr(backend, "may_see", counted)
        fewer = truth_of(picture)
        monkeypatch.setattr(backend, "may_see", lambda setup, view, x, y: np.ones(len(setup.order), bool))
        for name, image in truth_of(picture).items():
            assert np.allclose(fewer[name], image, rtol=1e-11, atol=1e-11, equal_nan=True), (lowpass, name)
    assert np.mean(shares) < 0.8
