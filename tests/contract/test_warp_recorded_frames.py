"""Warp frames rendered without waiting for the sizes of their tile lists, and by a captured graph: CUDA
graphs, here simulated on the CPU too."""

import gc
import weakref

import numpy as np
import pytest
from derivative_errors import random_scene

import fidsplat as fs
from fidsplat.backends.prepare import prepare, prepare_batch
from fidsplat.backends.warp import memory_plan, runtime
from fidsplat.backends.warp.frame import DeviceFrame
from fidsplat.backends.warp.kernel_config import KernelConfig
from fidsplat.backends.warp.pipeline import RecordedFrame
from fidsplat.capture.views import capture_batch

BACKEND = "warp"
WHOLE = random_scene(1, count=3000, degree=None, quality="surfel", outputs=("rgb",))
"""as tests/contract/test_gradients.py renders, whose kernels it shares"""
CLOUD, CAPTURE = WHOLE
ELSEWHERE = fs.Camera.look_at(61, 43, 1.1, (0.0, 0.0, 0.0), (0.0, 0.0, -1.0))
FAR = fs.Camera.look_at(61, 43, 1.1, (0.0, 0.0, -60.0), (0.0, 0.0, 3.0))


@pytest.fixture
def ahead(renderer):
    """The Warp backend; its synchronisation is restored."""
    backend = renderer.backend
    before, backend.asynchronous = backend.asynchronous, True
    yield backend
    backend.asynchronous = before


def pictures(backend, draw):
    """How many images are begun while it renders."""
    before = backend.frames
    draw()
    return backend.frames - before


def waiting(renderer, cameras):
    """Their images, each rendered when its counts were known."""
    backend = renderer.backend
    before, backend.asynchronous = backend.asynchronous, False
    frames = [renderer.render(CLOUD, CAPTURE.with_(camera=camera)) for camera in cameras]
    backend.asynchronous = before
    return frames


CAMERAS = {
    "the same": [CAPTURE.camera] * 3,
    "more and more": [ELSEWHERE, FAR, CAPTURE.camera],
    "less and less": [CAPTURE.camera, ELSEWHERE, ELSEWHERE],
    "fewer splats, more pairs": [FAR, CAPTURE.camera],
}
AGAIN = {"more and more": 2, "fewer splats, more pairs": 1}
"""how many are rendered twice"""


@pytest.mark.parametrize("case", CAMERAS)
def test_frames_equal_those_that_wait(renderer, ahead, case):
    """Those that need more than the room that was left are rendered twice."""
    cameras, resident = CAMERAS[case], renderer.upload(CLOUD)
    drawn = []

    def draw():
        frames = [renderer.render(resident, CAPTURE.with_(camera=camera)) for camera in cameras]
        drawn.extend((frame["rgb"], frame.stats) for frame in frames)

    assert pictures(ahead, draw) == len(cameras) + AGAIN.get(case, 0)
    for (rgb, stats), expected in zip(drawn, waiting(renderer, cameras), strict=True):
        assert np.array_equal(rgb, expected["rgb"])
        assert stats == expected.stats
    assert expected.stats["pairs"] > 2000 or case == "less and less"


def test_a_batch_of_views_waits_for_the_first_only(renderer, ahead):
    cameras, resident = [FAR, *[CAPTURE.camera] * 2, ELSEWHERE], renderer.upload(CLOUD)
    batch = renderer.render_batch(resident, [CAPTURE.with_(camera=camera) for camera in cameras])
    for number, expected in enumerate(waiting(renderer, cameras)):
        assert np.array_equal(batch["rgb"][number], expected["rgb"]), number


def test_adopted_arrays_are_waited_for(renderer, ahead):
    """The caller may change the arguments before a frame has to be rendered again."""
    arrays = {
        name: getattr(CLOUD, name).copy() for name in ("means", "quats", "scales", "opacities", "colors")
    }
    resident = renderer.wrap_arrays(**arrays)
    for capture in (CAPTURE.with_(camera=ELSEWHERE), CAPTURE):
        assert pictures(ahead, lambda capture=capture: renderer.render(resident, capture)["rgb"]) == 1


def test_a_budget_that_is_full_is_waited_for(renderer, ahead):
    """An image within it is rendered once its counts are known, in bands if need be."""
    resident = renderer.upload(CLOUD)
    renderer.render(resident, CAPTURE)
    before, ahead.pair_budget = ahead.pair_budget, 4000
    try:
        frame = renderer.render(resident, CAPTURE)
    finally:
        ahead.pair_budget = before
    assert np.array_equal(frame["rgb"], waiting(renderer, [CAPTURE.camera])[0]["rgb"])


def test_unread_images_are_released_immediately(ahead):
    """A loop that renders and never reads images needs no more memory of the device."""
    resident = ahead.upload(CLOUD)
    features, view = prepare(resident, CAPTURE)
    pipeline = ahead.pipeline(features)
    pipeline.render_view(resident, view)
    images = pipeline.render_view(resident, view)
    assert images.rendered[0].complete
    array = weakref.ref(images.arrays["rgb"])
    gc.disable()
    try:
        images = pipeline.render_view(resident, view)
        assert array() is None
    finally:
        gc.enable()
    assert images.rendered[0].complete


@pytest.fixture
def replayed(ahead, monkeypatch):
    """Frames rendered by graphs of the backend, which captures its launches."""
    drawn, own = [], RecordedFrame.replay

    def counted(replay, stack):
        drawn.append(stack)
        own(replay, stack)

    monkeypatch.setattr(ahead, "replays", True)
    monkeypatch.setattr(RecordedFrame, "replay", counted)
    return drawn


def assert_drawn(renderer, frames, cameras):
    for frame, expected in zip(frames, waiting(renderer, cameras), strict=True):
        assert np.array_equal(frame["rgb"], expected["rgb"])
        assert frame.stats == expected.stats


def test_equal_frames_are_replayed(renderer, replayed):
    """From the fourth on, whatever the camera."""
    near = CAPTURE.camera
    cameras, resident = [near, near, near, ELSEWHERE, near, near], renderer.upload(CLOUD)
    frames = [renderer.render(resident, CAPTURE.with_(camera=camera)) for camera in cameras]
    assert len(replayed) == 3
    assert_drawn(renderer, frames, cameras)
    assert set(frames[-1].timings) == {"project", "sort", "bin", "blend", "resolve"}


def test_a_replay_beyond_its_capacity_is_rendered_and_captured_again(renderer, replayed):
    cameras, resident = [FAR] * 4 + [CAPTURE.camera], renderer.upload(CLOUD)
    frames = [renderer.render(resident, CAPTURE.with_(camera=camera)) for camera in cameras]
    assert len(replayed) == 2
    assert_drawn(renderer, frames, cameras)
    more = [renderer.render(resident, CAPTURE) for _ in range(3)]
    assert len(replayed) == 3  # the room has grown: two are launched kernel by kernel
    assert_drawn(renderer, more, [CAPTURE.camera] * 3)


@pytest.mark.parametrize("size", [(61, 40), (50, 43)])
def test_sizes_that_share_a_side_are_replayed_alternately(renderer, replayed, size):
    other = fs.Camera.look_at(*size, 1.1, (0.0, 0.0, 0.0), (0.0, 0.0, 3.0))
    cameras, resident = [CAPTURE.camera, other] * 6, renderer.upload(CLOUD)
    frames = [renderer.render(resident, CAPTURE.with_(camera=camera)) for camera in cameras]
    assert {stack.view.height for stack in replayed} == {43, size[1]}
    assert {stack.view.width for stack in replayed} == {61, size[0]}
    assert_drawn(renderer, frames, cameras)


def test_what_another_kind_reallocated_is_not_replayed(renderer, ahead, replayed, monkeypatch):
    """Arrays that a larger image has replaced are not those of the graph."""
    resident, large = (
        renderer.upload(CLOUD),
        fs.Camera.look_at(200, 160, 1.1, (0.0, 0.0, 0.0), (0.0, 0.0, 3.0)),
    )
    # earlier tests may have left larger arrays
    monkeypatch.setattr(ahead.pool, "_arrays", {})
    monkeypatch.setattr(ahead.pool, "_parts", {})
    monkeypatch.setattr(ahead.pool, "generation", object())
    small = [renderer.render(resident, CAPTURE) for _ in range(4)]
    renderer.render(resident, CAPTURE.with_(camera=large))
    small += [renderer.render(resident, CAPTURE) for _ in range(2)]
    assert len(replayed) == 1
    assert_drawn(renderer, small, [CAPTURE.camera] * 6)


def test_what_moves_is_replayed(renderer, replayed):
    """Groups, coplanar groups and inputs of the resolve step are filled for each image."""
    cloud = CLOUD.with_labels(np.arange(3000) % 2).with_coplanar_groups(np.arange(3000) // 2900 - 1)
    resident, places = renderer.upload(cloud), (0.0, 0.1, 0.2, 0.3, 0.4)

    def capture(place):
        motion = fs.Motion(groups={1: lambda time: np.eye(4) + place * np.eye(4, k=3)})
        return CAPTURE.with_(outputs=("rgb", "normal_world", "splat_id"), motion=motion)

    frames = [renderer.render(resident, capture(place)) for place in places]
    assert len(replayed) == 2
    renderer.backend.asynchronous = False
    for frame, place in zip(frames, places, strict=True):
        expected = renderer.render(cloud, capture(place))
        assert all(np.array_equal(frame[name], expected[name]) for name in frame)
    aside = capture(0.1).with_(camera=fs.Camera.look_at(61, 43, 1.1, (0.4, 0.0, 0.0), (0.0, 0.0, 3.0)))
    batch = renderer.render_batch(cloud, [capture(0.1), aside])
    expected = renderer.render(cloud, aside)
    assert all(np.array_equal(batch[name][1], expected[name]) for name in batch)


def budget(renderer, pairs):
    renderer.backend.pair_budget = pairs
    return CAPTURE


BEHIND = [fs.Gradient((0.1, 0.2, 0.3), (0.4, 0.3, 0.2)), fs.Gradient((0.9, 0.2, 0.3), (0.4, 0.9, 0.2))]
OTHERS = {
    "budgets": [lambda renderer, pairs=pairs: budget(renderer, pairs) for pairs in (10**9, 10**8)],
    "what lies behind": [
        lambda renderer, behind=behind: CAPTURE.with_(background=behind) for behind in BEHIND
    ],
}


@pytest.mark.parametrize("kind", OTHERS)
def test_a_frame_between_replays_leaves_its_view_to_none(renderer, replayed, monkeypatch, kind):
    """Of an image of the same size that was launched kernel by kernel, as it is no image of the graph's,
    the next of these has nothing: the view is the same object as before it."""
    monkeypatch.setattr(renderer.backend, "pair_budget", renderer.backend.pair_budget)
    mine, other = OTHERS[kind]
    resident, capture = renderer.upload(CLOUD), mine(renderer)
    frames = [renderer.render(resident, capture)["rgb"] for _ in range(4)]
    assert replayed
    elsewhere = renderer.render(resident, other(renderer).with_(camera=ELSEWHERE))["rgb"]
    mine(renderer)
    frames += [renderer.render(resident, capture)["rgb"] for _ in range(4)]
    assert not np.array_equal(elsewhere, frames[0])
    assert all(np.array_equal(frame, frames[0]) for frame in frames)


def test_a_replay_that_fails_half_filled_is_not_launched_again(renderer, replayed, monkeypatch):
    """The view that it was to show is rendered again."""
    resident, there = renderer.upload(CLOUD), CAPTURE.with_(camera=ELSEWHERE)
    expected = renderer.render(resident, there)["rgb"]
    for _ in range(4):
        renderer.render(resident, CAPTURE)["rgb"]
    assert replayed

    def refused(image):
        raise RuntimeError("no copy")

    with monkeypatch.context() as failing:
        failing.setattr(DeviceFrame, "_fill_views", refused)
        with pytest.raises(fs.DeviceError, match="no copy"):
            renderer.render(resident, there)
    assert np.array_equal(renderer.render(resident, there)["rgb"], expected)


def test_a_graph_keeps_no_splats(renderer, replayed):
    """A cloud leaves the device with its last reference, and a scratch array as soon as it is replaced."""
    gc.collect()  # frames in reference cycles, of exceptions in other tests, hold scratch arrays too
    resident = renderer.upload(CLOUD)
    for _ in range(4):
        renderer.render(resident, CAPTURE).wait()
    assert replayed
    pool, array = renderer.backend.pool, weakref.ref(resident.data.arrays["means"])
    scratch = weakref.ref(pool.scratch("raw color", 1, runtime.load().vec4))
    gc.disable()
    try:
        pool.scratch("raw color", scratch().size + 1, runtime.load().vec4)
        assert scratch() is None, [type(each) for each in gc.get_referrers(scratch())]
        del resident
        assert array() is None
    finally:
        gc.enable()


def test_empty_frames_are_recorded_too(renderer, replayed):
    """A cloud without splats."""
    arrays = [getattr(CLOUD, name)[:0] for name in ("means", "quats", "scales", "opacities")]
    resident = renderer.upload(fs.SplatCloud(*arrays, colors=CLOUD.colors[:0]))
    frames = [renderer.render(resident, CAPTURE) for _ in range(4)]
    assert all(np.array_equal(frame["rgb"], frames[0]["rgb"]) for frame in frames)
    assert frames[-1].stats == {"splats": 0, "visible": 0, "pairs": 0}


CROSSING = [fs.Camera.look_at(61, 43, 1.1, (0.02 * k, 0.0, 0.0), (0.0, 0.0, 3.0)) for k in range(12)]


def test_parts_of_a_batch_are_replayed(renderer, replayed, monkeypatch):
    """Two views at a time, each with the bits of itself alone."""
    monkeypatch.setattr(memory_plan, "_MAX_SUB_BATCH_BYTES", {False: 1_300_000, True: 1_300_000})
    captures, resident = [CAPTURE.with_(camera=camera) for camera in CROSSING], renderer.upload(CLOUD)
    batch = renderer.render_batch(resident, captures)
    assert [len(stack) for stack in replayed] == [2, 2, 2]
    for drawn, expected in zip(batch["rgb"], waiting(renderer, CROSSING), strict=True):
        assert np.array_equal(drawn, expected["rgb"])
    assert batch.stats["pairs"] == sum(each.stats["pairs"] for each in waiting(renderer, CROSSING))


def test_views_together_in_blocks_of_threads(renderer):
    """The GPU's schedule of a batch: all views at once, more than the budget in ranges of tiles."""
    backend = renderer.backend
    resident, captures = backend.upload(CLOUD), [CAPTURE.with_(camera=camera) for camera in CROSSING[:3]]
    features, views = prepare_batch(resident, capture_batch(captures, None, None, None))
    pipeline = backend.pipeline(features, KernelConfig("group", 8, 8))
    full_frame = pipeline.render(resident, views).read("rgb")
    before, backend.pair_budget = backend.pair_budget, 4000
    try:
        banded = pipeline.render(resident, views).read("rgb")
    finally:
        backend.pair_budget = before
    for k, expected in enumerate(waiting(renderer, CROSSING[:3])):
        assert np.array_equal(full_frame[k], expected["rgb"])
        assert np.array_equal(banded[k], expected["rgb"])


def test_a_device_that_captures_nothing_renders_nevertheless(renderer, replayed, monkeypatch):
    """The warning is issued once."""

    wp, resident = runtime.load(), renderer.upload(CLOUD)
    own = wp.array.zero_

    def refused(array):
        if renderer.backend.device.is_capturing:
            raise RuntimeError("operation not permitted when stream is capturing")
        own(array)

    monkeypatch.setattr(wp.array, "zero_", refused)
    with pytest.warns(UserWarning, match="captures no graphs .operation not permitted") as message:
        frames = [renderer.render(resident, CAPTURE) for _ in range(6)]
    assert len(message) == 1
    assert not replayed
    assert_drawn(renderer, frames, [CAPTURE.camera] * 6)
