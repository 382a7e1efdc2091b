"""Pacing: number, size and time of the viewer's images."""

import threading
from dataclasses import replace

import pytest
from viewing import HERE

import fidsplat as fs
from fidsplat.viewer.settings import Viewpoint
from fidsplat.viewer.stream import MIN_SCALE, REST_DELAY, Pace, Stream


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def looked_at(moving_takes=lambda scale: 0.0):
    """A stream with a simulated clock, and the images that it rendered."""
    clock, rendered = Clock(), []

    def moving(viewpoint, scale):
        rendered.append((viewpoint.position[0], scale))
        clock.now += moving_takes(scale)
        return lambda: None

    stream = Stream(moving, lambda viewpoint: rendered.append((viewpoint.position[0], "exact")), clock=clock)
    return stream, clock, rendered


def at(x) -> Viewpoint:
    return replace(HERE, position=(x, 0.0, 0.0))


def test_the_newest_viewpoint_then_one_exact_frame_then_nothing():
    stream, clock, rendered = looked_at()
    assert stream.step() is None  # no viewpoint yet
    for x in (1.0, 2.0, 3.0):
        stream.set_viewpoint(at(x))
    assert stream.step() == 0.0
    assert rendered == [(3.0, 0.5)]
    assert stream.step() == pytest.approx(REST_DELAY)
    assert len(rendered) == 1
    clock.now += REST_DELAY
    assert stream.step() == 0.0
    assert rendered[1:] == [(3.0, "exact")]
    for _ in range(3):
        clock.now += 60
        assert stream.step() is None
    stream.set_viewpoint(at(3.0))  # the same viewpoint
    assert stream.step() is None
    stream.refresh()
    assert stream.step() == 0.0
    assert rendered[2][0] == 3.0
    assert len(rendered) == 3


@pytest.mark.parametrize("full", [0.01, 0.05, 0.2])
def test_the_scale_holds_the_rate(full):
    """A machine that needs this time for an image of the page's size."""
    stream, _, rendered = looked_at(lambda scale: full * scale**2)
    for k in range(40):
        stream.set_viewpoint(at(float(k)))
        stream.step()
    last = rendered[-1][1]
    assert last == stream.pace.step_scale
    if full < 0.03:
        assert last == 1.0
    else:
        assert full * last**2 == pytest.approx(0.9 / 30, rel=0.1)


def test_the_scale_has_an_end():
    pace = Pace()
    for _ in range(50):
        pace.update(10.0, pace.step_scale)
    assert pace.step_scale == MIN_SCALE
    for _ in range(50):
        pace.update(1e-9, pace.step_scale)
    assert pace.step_scale == 1.0


def test_an_image_that_fails_is_reported_and_the_stream_continues():
    messages = []

    def refused(*_):
        raise fs.InputError("too large")

    stream = Stream(refused, refused, messages.append, clock=Clock())
    stream.set_viewpoint(HERE)
    assert stream.step() == 0.0
    assert messages == ["too large"]
    assert stream.step() is not None


def test_a_frame_that_exceeds_the_memory_is_reported():
    messages: list[str] = []

    def fail(*_):
        raise MemoryError

    stream = Stream(fail, fail, messages.append, clock=lambda: 0.0)
    stream.set_viewpoint(HERE)
    stream.step()
    assert messages == ["not enough memory for this image"]


def test_a_frame_is_sent_while_the_next_is_rendered_and_before_the_exact_one():
    done, rendered, clock = [], [], Clock()
    next_is_drawn = threading.Event()

    def moving(viewpoint, scale):
        number = len(rendered)
        rendered.append(number)
        if number == 1:
            next_is_drawn.set()

        def send():
            assert next_is_drawn.wait(10)
            done.append(number)

        return send

    stream = Stream(moving, lambda viewpoint: done.append("exact"), clock=clock)
    for x in (1.0, 2.0, 3.0):
        stream.set_viewpoint(at(x))
        stream.step()
    clock.now += REST_DELAY
    stream.step()
    assert done == [0, 1, 2, "exact"]


def test_errors_of_sending_a_frame_are_reported():
    messages = []

    def send():
        raise fs.InputError("the browser left")

    stream = Stream(lambda *_: send, lambda *_: None, messages.append, clock=Clock())
    for x in (1.0, 2.0):
        stream.set_viewpoint(at(x))
        stream.step()
    assert messages == ["the browser left"]


def test_a_stream_runs_in_a_thread_until_it_is_closed():
    rested = threading.Event()
    stream = Stream(lambda *_: lambda: None, lambda *_: rested.set())
    thread = threading.Thread(target=stream.run)
    thread.start()
    stream.set_viewpoint(HERE)
    assert rested.wait(20)
    stream.close()
    thread.join(20)
    assert not thread.is_alive()
