"""Plain data can be pickled and copied; objects with a device raise an error for it, and after a fork."""

import copy
import multiprocessing
import os
import pickle
import sys

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.scenes import PlacedMarker

CAMERA = fs.Camera.look_at(16, 12, 1.0, (0, 0, -4), (0, 0, 0))
CLOUD = fs.SplatCloud([[0, 0, 0.0]], [[1, 0, 0, 0]], [[0.5, 0.5]], [0.9], colors=[[1, 0, 0]])
PATH = fs.Trajectory([0.0, 1.0], np.stack([np.eye(4)] * 2))
WAYS = {
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
}
ONE_LINE = 100  # status of a child that was refused in one line


def plain() -> list:
    tag = fs.marker("aruco:4x4_50:7", size=0.1, mixture="exact")
    scene = fs.Scene(
        [CLOUD],
        CAMERA,
        [PlacedMarker(tag)],
        background=fs.Panorama(np.ones((4, 8, 3))),
        sensor=fs.Sensor(gain=2.0),
        fog=fs.Fog(0.1),
        cloud_motions={0: PATH},
    )
    scene.cloud(), scene.motion  # kept for later; need not come along
    motion, quality = fs.Motion(groups={0: PATH}), fs.Quality(samples=2)
    return [
        CLOUD,
        CAMERA,
        fs.Capture(CAMERA, fog=fs.Fog(0.1)),
        tag,
        PATH,
        motion,
        scene,
        quality,
        fs.Shutter(time=1.0),
        fs.BrownConrady(k1=0.1),
    ]


@pytest.mark.parametrize("way", WAYS)
def test_plain_data(way):
    """It renders the same, and its arrays are still read-only."""
    for value in plain():
        again = WAYS[way](value)
        assert type(again) is type(value)
        for name, array in vars(again).items():
            if isinstance(array, np.ndarray):
                assert not array.flags.writeable, (type(value), name)
                assert np.array_equal(array, getattr(value, name))
        if isinstance(value, fs.Scene):
            draw = fs.Renderer("reference").render
            assert np.array_equal(draw(again)["rgb"], draw(value)["rgb"])


@pytest.mark.parametrize("way", WAYS)
def test_a_frame_is_its_arrays(way, renderer):
    frame = renderer.render(CLOUD, CAMERA, ("rgb", "depth"))
    again = WAYS[way](frame)
    assert again.outputs == frame.outputs
    assert all(np.array_equal(again[name], frame[name]) for name in frame)
    assert not again["rgb"].flags.writeable
    assert (again.timings, again.stats) == (dict(frame.timings), dict(frame.stats))


@pytest.mark.parametrize("way", WAYS)
def test_what_holds_a_device(way):
    renderer = fs.Renderer("reference")
    for held, words in ((renderer, "a Renderer holds"), (renderer.upload(CLOUD), "pickled or copied")):
        with pytest.raises(fs.InputError, match=words):
            WAYS[way](held)


def test_an_output_that_was_not_rendered():
    """An InputError for users, and a KeyError for code that uses a mapping."""
    frame = fs.Renderer("reference").render(CLOUD, CAMERA)
    for name in ("depth", 5, None, np.zeros(3), LookupError):
        for take in (frame.__getitem__, frame.device_array):
            with pytest.raises(fs.InputError, match=r"an output of this frame must be one of rgb"):
                take(name)
        assert frame.get(name, "none") == "none"
    assert "depth" not in frame
    assert "rgb" in frame


# --- processes


def ends(method, target, *given) -> int:
    """Exit status of a process that calls the target; it hangs if it is not done in half a minute."""
    process = multiprocessing.get_context(method).Process(target=target, args=given)
    process.start()
    process.join(30)
    try:
        assert process.exitcode is not None, "it hangs"
    finally:
        process.kill()
    return process.exitcode


def draws(device, expected) -> None:
    frame = fs.Renderer(device).render(CLOUD, CAMERA)
    sys.exit(0 if np.array_equal(frame["rgb"], expected) else 1)


def is_refused(use, *given) -> None:
    try:
        use(*given)
    except fs.FidsplatError as error:
        os._exit(ONE_LINE if "fork" in str(error) and "\n" not in str(error) else 1)
    os._exit(2)


@pytest.mark.parametrize(
    ("device", "method"), [("reference", "fork"), ("reference", "spawn"), ("opencl", "spawn")]
)
def test_a_worker_opens_its_own(device, method):
    expected = fs.Renderer(device).render(CLOUD, CAMERA)["rgb"]
    assert ends(method, draws, device, expected) == 0


def parent_that_only_forks(device) -> None:
    """Runs in its own process, which has opened no device: its fork may open any."""
    expected = np.asarray(fs.Renderer("reference").render(CLOUD, CAMERA)["rgb"])

    def close() -> None:
        frame = fs.Renderer(device).render(CLOUD, CAMERA)
        os._exit(0 if np.allclose(frame["rgb"], expected, atol=1e-4) else 1)

    os._exit(ends("fork", close))


def test_a_fork_of_a_process_that_has_opened_nothing_opens_its_own():
    assert ends("spawn", parent_that_only_forks, "opencl") == 0


@pytest.mark.parametrize("device", ["reference", "opencl"])
def test_a_renderer_is_refused_in_a_fork(device):
    renderer = fs.Renderer(device)
    resident, frame, read = (
        renderer.upload(CLOUD),
        renderer.render(CLOUD, CAMERA),
        renderer.render(CLOUD, CAMERA),
    )
    read["rgb"]
    uses = [
        (renderer.upload, CLOUD),
        (renderer.render, CLOUD, CAMERA),
        (renderer.render, resident, CAMERA),
        (frame.__getitem__, "rgb"),
    ]
    for use in uses:
        assert ends("fork", is_refused, *use) == ONE_LINE, use
    assert ends("fork", is_refused, read.__getitem__, "rgb") == 2  # a copy in memory is everybody's


def test_a_driver_that_a_fork_left_without_threads_is_not_used():
    fs.Renderer("opencl")
    for use in ((fs.Renderer, "opencl"), (fs.devices,)):
        assert ends("fork", is_refused, *use) == ONE_LINE
