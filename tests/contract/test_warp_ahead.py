"""Warp's pictures that are drawn without waiting for what their lists take: CUDA's, here on the CPU too."""

import gc
import weakref

import numpy as np
import pytest
from derivative_errors import random_picture

import fidsplat as fs
from fidsplat.backends.prepare import prepare

BACKEND = "warp"
WHOLE = random_picture(1, count=3000, degree=None, quality="surfel", outputs=("rgb",))
"""as tests/contract/test_gradients.py draws, whose kernels it shares"""
CLOUD, CAPTURE = WHOLE
ELSEWHERE = fs.Camera.look_at(61, 43, 1.1, (0.0, 0.0, 0.0), (0.0, 0.0, -1.0))
FAR = fs.Camera.look_at(61, 43, 1.1, (0.0, 0.0, -60.0), (0.0, 0.0, 3.0))


@pytest.fixture
def ahead(renderer):
    """Its backend; what it waits for is restored."""
    backend = renderer.backend
    before, backend.ahead = backend.ahead, True
    yield backend
    backend.ahead = before


def pictures(backend, draw):
    """How many pictures are begun while it draws."""
    before = backend.pictures
    draw()
    return backend.pictures - before


def waiting(renderer, cameras):
    """Their pictures, each drawn when its counts were known."""
    backend = renderer.backend
    before, backend.ahead = backend.ahead, False
    frames = [renderer.render(CLOUD, CAPTURE.with_(camera=camera)) for camera in cameras]
    backend.ahead = before
    return frames


CAMERAS = {
    "the same": [CAPTURE.camera] * 3,
    "more and more": [ELSEWHERE, FAR, CAPTURE.camera],
    "less and less": [CAPTURE.camera, ELSEWHERE, ELSEWHERE],
    "fewer splats, more pairs": [FAR, CAPTURE.camera],
}
AGAIN = {"more and more": 2, "fewer splats, more pairs": 1}
"""how many are drawn twice"""


@pytest.mark.parametrize("case", CAMERAS)
def test_pictures_are_those_that_wait(renderer, ahead, case):
    """Those that need more than the room that was left are drawn twice."""
    cameras, resident = CAMERAS[case], renderer.upload(CLOUD)
    drawn = []

    def draw():
        frames = [renderer.render(resident, CAPTURE.with_(camera=camera)) for camera in cameras]
        drawn.extend((frame["rgb"], frame.stats) for frame in frames)

    assert pictures(ahead, draw) == len(cameras) + AGAIN.get(case, 0)
    for (rgb, stats), wanted in zip(drawn, waiting(renderer, cameras), strict=True):
        assert np.array_equal(rgb, wanted["rgb"])
        assert stats == wanted.stats
    assert wanted.stats["pairs"] > 2000 or case == "less and less"


def test_a_batch_of_views_waits_for_the_first_alone(renderer, ahead):
    cameras, resident = [FAR, *[CAPTURE.camera] * 2, ELSEWHERE], renderer.upload(CLOUD)
    batch = renderer.render_batch(resident, [CAPTURE.with_(camera=camera) for camera in cameras])
    for number, wanted in enumerate(waiting(renderer, cameras)):
        assert np.array_equal(batch["rgb"][number], wanted["rgb"]), number


def test_adopted_arrays_are_waited_for(renderer, ahead):
    """Who gave them may change them before a picture would have to be drawn again."""
    arrays = {
        name: getattr(CLOUD, name).copy() for name in ("means", "quats", "scales", "opacities", "colors")
    }
    resident = renderer.adopt(**arrays)
    for capture in (CAPTURE.with_(camera=ELSEWHERE), CAPTURE):
        assert pictures(ahead, lambda capture=capture: renderer.render(resident, capture)["rgb"]) == 1


def test_a_budget_without_room_is_waited_for(renderer, ahead):
    """A picture within it is drawn once its counts are known, in bands if need be."""
    resident = renderer.upload(CLOUD)
    renderer.render(resident, CAPTURE)
    before, ahead.pair_budget = ahead.pair_budget, 4000
    try:
        frame = renderer.render(resident, CAPTURE)
    finally:
        ahead.pair_budget = before
    assert np.array_equal(frame["rgb"], waiting(renderer, [CAPTURE.camera])[0]["rgb"])


def test_images_that_nobody_reads_leave_at_once(ahead):
    """A loop that draws and never looks takes no more of the device."""
    resident = ahead.upload(CLOUD)
    features, view = prepare(resident, CAPTURE)
    pipeline = ahead.pipeline(features)
    pipeline.render(resident, view)
    images = pipeline.render(resident, view)
    assert images.settle
    array = weakref.ref(images.arrays["rgb"])
    gc.disable()
    try:
        images = pipeline.render(resident, view)  # whose launches take the place of the others'
        assert array() is None
    finally:
        gc.enable()
    assert images.settle
