"""Images that lenses took are trained on as pinholes would have taken them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from training_scene import scene, write

import fidsplat as fs
from fidsplat.images.files import write_png
from fidsplat.train import load_dataset
from fidsplat.train.masks import undistorted_view


@pytest.fixture
def folder(tmp_path):
    write(scene(count=6), tmp_path / "set")
    return tmp_path / "set"


OF_COLMAP = {
    "SIMPLE_RADIAL": "30 32 24 -0.1",
    "RADIAL": "30 32 24 0.1 0.05",
    "OPENCV": "30 31 32 24 -0.2 0.05 0.01 -0.02",
    "FULL_OPENCV": "30 31 32 24 -0.2 0.05 0.01 -0.02 0.01 0.1 0.02 0.01",
    "OPENCV_FISHEYE": "30 31 32 24 0.05 -0.01 0.002 0.001",
    "SIMPLE_RADIAL_FISHEYE": "30 32 24 0.05",
    "RADIAL_FISHEYE": "30 32 24 0.05 -0.01",
}
"""cameras, of 64 x 48 pixels"""
BROWN, FISHEYE = fs.BrownConrady, fs.Fisheye
LENSES = {
    "SIMPLE_RADIAL": BROWN(k1=-0.1),
    "RADIAL": BROWN(k1=0.1, k2=0.05),
    "OPENCV": BROWN(k1=-0.2, k2=0.05, p1=0.01, p2=-0.02),
    "FULL_OPENCV": BROWN(k1=-0.2, k2=0.05, p1=0.01, p2=-0.02, k3=0.01, k4=0.1, k5=0.02, k6=0.01),
    "OPENCV_FISHEYE": FISHEYE(0.05, -0.01, 0.002, 0.001),
    "SIMPLE_RADIAL_FISHEYE": FISHEYE(0.05),
    "RADIAL_FISHEYE": FISHEYE(0.05, -0.01),
}


def taken(camera):
    """A smooth image of directions alone, as a camera sees them; grey where it sees nothing."""
    y, x = np.mgrid[0.5 : camera.height, 0.5 : camera.width]
    rays = camera.rays(np.stack([x.ravel(), y.ravel()], 1))
    slopes = (rays / rays[:, 2:])[:, :2].reshape(camera.height, camera.width, 2)
    waves = [np.sin(3 * slopes[..., 0]), np.cos(2 * slopes[..., 1]), np.sin(slopes.sum(2))]
    return np.nan_to_num(np.rint(127.5 + 100 * np.stack(waves, 2)), nan=127).astype(np.uint8)


def flat_as_wanted(view, lens, mask):
    """Whether a view has the image of a pinhole camera, where its source pixels exist."""
    camera = view.camera
    assert camera.lens is None
    there = np.ones(mask.shape, bool) if view.mask is None else view.mask
    off = np.abs(view.image.astype(int) - taken(camera)).max(2)
    # slopes bend a wave of 100 by 1000 at most; half a pixel's square of it, two roundings
    assert off[there].max() <= 2 + 1000 / (8 * camera.fx**2) * 8
    y, x = np.mgrid[0.5 : camera.height, 0.5 : camera.width]
    at = lens.image(camera.rays(np.stack([x.ravel(), y.ravel()], 1)))
    at = (at * (camera.fx, camera.fy) + (camera.cx, camera.cy) - 0.5).reshape(*mask.shape, 2)
    low = np.floor(np.nan_to_num(at, nan=-9)).astype(int)
    whole = np.ones(mask.shape, bool)
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = low[..., 0] + right, low[..., 1] + down
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        whole &= inside & mask[np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1)]
    assert (there | ~whole).all()
    assert 0.3 < there.mean() < 1
    assert (there & ~whole).mean() < 0.02  # where a neighbour has no weight


@pytest.mark.parametrize("model", OF_COLMAP)
def test_what_lenses_took_is_flat(folder, tmp_path, model):
    """Of COLMAP's models and nerfstudio's, with a mask."""
    for file in folder.rglob("*.bin"):
        file.unlink()
    cameras, images = folder / "sparse/0/cameras.txt", folder / "images"
    number = next(line for line in cameras.read_text().splitlines() if line[:1].isdigit()).split()[0]
    cameras.write_text(f"{number} {model} 64 48 {OF_COLMAP[model]}\n")
    f, *middle = map(float, OF_COLMAP[model].split()[: 3 if "RADIAL" in model else 4])
    lens, pinhole = LENSES[model], (64, 48, f, *middle) if len(middle) == 3 else (64, 48, f, f, *middle)
    picture = taken(fs.Camera.pinhole(*pinhole, lens=lens))
    mask = np.ones((48, 64), bool)
    mask[:12, :20] = False
    (folder / "masks").mkdir()
    for file in images.iterdir():
        write_png(file, picture)
        write_png(folder / "masks" / f"{file.name}.png", mask)
    dataset = load_dataset(folder)
    for view in dataset.views:
        flat_as_wanted(view, lens, mask)
    if model in ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"):
        return
    arguments = {field: value for field, value in vars(lens).items() if value and field != "fold"}
    frames = [
        {"file_path": f"images/{view.name}", "mask_path": f"masks/{view.name}.png", "transform_matrix": pose}
        for view in dataset.views
        for pose in [(np.linalg.inv(view.camera.world_to_camera) @ np.diag([1, -1, -1, 1])).tolist()]
    ]
    names = dict(zip(("fl_x", "fl_y", "cx", "cy"), pinhole[2:], strict=True))
    table = {"camera_model": model, "frames": frames, **names, **arguments}
    (folder / "transforms.json").write_text(json.dumps(table))
    for ours, theirs in zip(load_dataset(folder, random_points=9).views, dataset.views, strict=True):
        np.testing.assert_array_equal(ours.image, theirs.image)
        np.testing.assert_array_equal(ours.mask, theirs.mask)


def test_a_lens_that_sees_all_of_a_flat_image_leaves_no_mask():
    view = scene(count=6).views[0]
    camera = replace(view.camera, lens=BROWN(k1=-0.01))
    assert undistorted_view("a.png", camera, view.image, None).mask is None
    with pytest.raises(fs.InputError, match=r"got 2 x 2; give images of the size"):
        undistorted_view("a.png", camera, np.zeros((2, 2, 3), np.uint8), None)
