"""The reference: invisible splats that it skips change nothing."""

import numpy as np
import pytest
from agreement import random_splats
from combined import LENSES, SWITCHES

import fidsplat as fs
from fidsplat.backends.reference import backend
from fidsplat.effects import OUTPUTS
from fidsplat.selftest.agreement import FrameSpec, reference_images
from fidsplat.splats.rotations import rigid_matrix

CAMERAS = {"pinhole": fs.Camera.pinhole(37, 22, 30.0, 30.0, 18.0, 11.0)}
CAMERAS |= {name: SWITCHES[name].camera for name in LENSES}
LOWPASSES = ("none", "screen", "pixel")


def clouds():
    """From below a pixel to across the image, around the camera; ellipsoids, thin boxes, planes."""
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
        "planes": cloud.with_boxes(group % 2 == 0).with_coplanar_groups(np.maximum(group % 8 - 2, -1)),
    }


@pytest.mark.sweep
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("kind", clouds())
def test_a_splat_that_is_left_out_of_a_tile_is_not_visible_there(monkeypatch, camera, kind):
    shares = []

    def counted(setup, view, x, y):
        seen = choose(setup, view, x, y)
        shares.append(seen.mean())
        return seen

    choose = backend.may_contribute
    monkeypatch.setattr(backend, "_BLOCK", 1 << 15)
    for lowpass in LOWPASSES:
        quality = fs.Quality(lowpass=lowpass, ellipsoid="exact")
        picture = FrameSpec(clouds()[kind], camera, quality, tuple(OUTPUTS))
        monkeypatch.setattr(backend, "may_contribute", counted)
        fewer = reference_images(picture)
        monkeypatch.setattr(
            backend, "may_contribute", lambda setup, view, x, y: np.ones(len(setup.order), bool)
        )
        for name, image in reference_images(picture).items():
            assert np.allclose(fewer[name], image, rtol=1e-11, atol=1e-11, equal_nan=True), (lowpass, name)
    assert np.mean(shares) < 0.8


def test_pixels_that_are_far_apart_are_those_of_the_whole_image(monkeypatch):
    """Splats are chosen for many of them together."""
    monkeypatch.setattr(backend, "_BLOCK", 1000)
    chosen, choose = [], backend.may_contribute
    monkeypatch.setattr(
        backend, "may_contribute", lambda *requested: chosen.append(choose(*requested)) or chosen[-1]
    )
    camera = fs.Camera.look_at(200, 150, 1.0, (0, 0, -2), (0, 0, 0))
    picture = FrameSpec(random_splats(100, 3, depth=(-0.5, 1.0)), camera, outputs=("rgb", "depth"))
    full_frame = reference_images(picture)
    rows, columns = np.random.default_rng(1).integers(0, (150, 200), (50, 2)).T
    tiles = len(np.unique(rows // 16 * 200 + columns // 16))
    chosen.clear()
    for name, values in reference_images(picture, (rows, columns)).items():
        assert np.allclose(values, full_frame[name][rows, columns], rtol=1e-11, atol=1e-11), name
    assert 1 < len(chosen) < tiles / 3
    assert np.mean(chosen) < 0.9


@pytest.mark.parametrize("exposed", [False, True])
def test_every_third_pixel_is_that_of_the_whole_image(monkeypatch, exposed):
    monkeypatch.setattr(backend, "_BLOCK", 500)
    motion = fs.Motion(lambda time: rigid_matrix((time, 0, 0)))
    shutter = fs.Shutter(exposure_time=0.1, sub_poses=2, readout=0.1, rows_per_band=8)
    capture = fs.Capture(
        fs.Camera.look_at(20, 16, 1.0, (0, 0, -2), (0, 0, 0)),
        ("rgb", "depth", "label"),
        "samples=2",
        **({"motion": motion, "shutter": shutter} if exposed else {}),
    )
    renderer, cloud, shares = fs.Renderer("reference"), random_splats(40, 3), []
    full_frame = renderer.render(cloud, capture)
    some = renderer.render_subsampled(3, cloud, capture, progress=shares.append)
    for name in some.outputs:
        np.testing.assert_array_equal(some[name], full_frame[name][::3, ::3])
    assert some["rgb"].shape == (6, 7, 3)
    assert shares == sorted(shares)
    assert len(shares) > 3
    assert shares[-1] == pytest.approx(1)
    assert renderer.render_subsampled(100, cloud, capture)["label"].shape == (1, 1)


def test_partial_frames_that_cannot_be_rendered():
    camera = fs.Camera.look_at(20, 16, 1.0, (0, 0, -2), (0, 0, 0))
    with pytest.raises(fs.InputError, match=r"step must be .* got 0"):
        fs.Renderer("reference").render_subsampled(0, random_splats(4, 3), camera)
    with pytest.raises(fs.InputError, match="render subsets of pixels, got opencl:pocl"):
        fs.Renderer("opencl:pocl").render_subsampled(2, random_splats(4, 3), camera)
