"""One loop times everything (`fidsplat.util.timing`)."""

import math

import pytest

from fidsplat.util.errors import DeviceError
from fidsplat.util.timing import Clock, Timer, quartiles, ratios, time_interleaved


def timers(order, *seconds):
    """A timer for each list of seconds, with a common clock that they advance; `order` receives the
    timers in the order of their runs."""
    clock = Clock()

    def work(number, left):
        def once():
            order.append(number)
            ms = next(left)
            if isinstance(ms, Exception):
                raise ms
            clock.seconds += ms
            return {"half": 500 * ms}

        return once

    return [Timer(work(k, iter(given)), clock, catch_errors=True) for k, given in enumerate(seconds)]


def test_timers_alternate_and_warm_up_is_not_timed():
    order, ticks = [], []
    one, other = timers(order, [9, 1, 2, 3, 4], [9, 2, 2, 2, 2])
    time_interleaved([one, other], 4, warm_up=1, tick=lambda: ticks.append(1))
    assert order == [0, 1, 0, 1, 1, 0, 0, 1, 1, 0]
    assert one.ms == [1000, 2000, 3000, 4000]
    assert one.parts == {"half": [500, 1000, 1500, 2000]}
    assert one.quartiles == quartiles(one.ms) == (1750, 2500, 3250)
    assert (one.median, one.part_medians) == (2500, {"half": 1250})
    assert ratios(one, other) == [0.5, 1, 1.5, 2]
    assert len(ticks) == 8


def test_what_fails_catch_errors_or_raises():
    order = []
    one, other = timers(order, [1, 1, DeviceError("it broke"), 1], [1] * 6)
    time_interleaved([one, other], 4)
    assert (one.ms, one.error) == ([], "it broke")
    assert len(other.ms) == 4
    assert order.count(0) == 3
    assert math.isnan(one.run())
    assert math.isnan(one.median)
    (fragile,) = timers(order, [DeviceError("it broke")])
    fragile._catch_errors = False
    with pytest.raises(DeviceError, match="it broke"):
        time_interleaved([fragile], 1)


@pytest.mark.parametrize(("least", "done"), [(3, 3), (None, 10), (20, 10)])
def test_only_the_minimum_once_time_is_up(least, done):
    (timer,) = timers([], [0.001] * 12)
    time_interleaved([timer], 10, min_rounds=least, seconds=0.0)
    assert len(timer.ms) == done
