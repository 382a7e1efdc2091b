"""The reference leaves few pixels undetermined: error bounds excuse no errors of a device in any scene."""

import numpy as np
import pytest
from agreement import random_splats, reference_images
from test_agreement import coplanar_cloud
from test_lens_frames import CAMERAS

import fidsplat as fs
from fidsplat.effects import OUTPUTS
from fidsplat.selftest.agreement import RARE, RISKY, FrameSpec, compare

CAMERA = fs.Camera.look_at(81, 59, 1.0, (0, 0, -0.1), (0, 0, 3.0))
MARKED = fs.Camera.look_at(81, 59, 0.7, (0.8, -0.3, -1.6), (0, 0, 0))
AROUND = random_splats(150, seed=1)
SCENES = {
    "splats around the camera": (AROUND, CAMERA),
    "layers": (coplanar_cloud(1), CAMERA),
    "boxes": (AROUND.with_boxes(np.arange(150) % 2 == 0), CAMERA),
    "a marker of boxes": (fs.marker("aruco:4x4_50:7", size=1.0).cloud, MARKED),
    "a fisheye": (AROUND, CAMERAS["fisheye 200"]),
    "parallel rays": (AROUND, CAMERAS["parallel"]),
}


@pytest.mark.parametrize("name", SCENES)
def test_error_bounds_leave_little_open(name):
    """Nine of ten pixels have the tolerance of colours alone; at most one in forty has a decision that
    rounding may change (median depth, heaviest label)."""
    expected = reference_images(FrameSpec(*SCENES[name], fs.Quality(), tuple(OUTPUTS)))
    bound = expected["error_bound"]
    assert np.median(bound) < 1e-5
    assert (bound > 2e-5).mean() < 0.1
    assert (bound > 1e-3).mean() < RARE
    assert bound.max() < RISKY
    visible = expected["depth"] != 0
    depth = expected["error_bound_depth"][visible] / np.abs(expected["depth"][visible])
    assert np.median(depth) < 2e-5
    assert (depth > 1e-3).mean() < 0.02
    assert (expected["error_bound_normal"] > 1e-3).mean() < 0.03
    for output in OUTPUTS:
        if f"{output}_may_flip" in expected:
            assert expected[f"{output}_may_flip"].mean() < 0.025, output


@pytest.mark.parametrize("output", OUTPUTS)
def test_one_wrong_pixel_is_named(output):
    """By a thousandth of a colour, of a normal's length or of a depth; by one label, index or fragment."""
    expected = reference_images(FrameSpec(AROUND, CAMERA, fs.Quality(), tuple(OUTPUTS)))
    images = {name: expected[name].astype(OUTPUTS[name].dtype) for name in OUTPUTS}
    assert all(difference.agrees for difference in compare(images, expected, OUTPUTS))
    sure = (
        (expected["error_bound"] < 1e-5)
        & (expected["error_bound_normal"] < 2e-4)
        & (expected["depth_first"] > 0)
    )
    for name in OUTPUTS:
        sure &= ~expected.get(f"{name}_may_flip", np.zeros_like(sure))
    row, column = np.argwhere(sure)[0]
    image = images[output]
    thousandth = 1e-3 * max(1.0, float(np.abs(image[row, column]).max()))
    image[row, column] += 1 if image.dtype == np.int32 else thousandth
    assert [one.output for one in compare(images, expected, OUTPUTS) if not one.agrees] == [output]
