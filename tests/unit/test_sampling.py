"""What plain pytest leaves to `pytest -m exhaustive`."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import sampling
from agreement import FEW_PIXELS, differences_of, random_splats, reference_images
from sampling import alternate, by, by_lens, in_turn, sampled, take_turns

import fidsplat as fs
from fidsplat.selftest.agreement import FrameSpec

DEVICES = ("one", "two", "gpu")
PINHOLE = fs.Camera.pinhole(8, 8, 8.0, 8.0, 4.0, 4.0)
CAMERAS = (
    PINHOLE,
    fs.Camera.fisheye(8, 8, 2.0),
    fs.Camera.equirectangular(8, 8),
    replace(PINHOLE, lens=fs.Fisheye(0.1)),
    replace(PINHOLE, lens=fs.BrownConrady(-0.1)),
)


class Item:
    """A collected test."""

    def __init__(self, device, case, *marks):
        self.name = f"{device}-{case}"
        self.nodeid = f"file::test[{self.name}]"
        self.callspec = SimpleNamespace(
            id=self.name, params={"renderer": device, "camera": CAMERAS[case]}, indices={"pair": case // 2}
        )
        self.marks = {mark.name: mark for mark in marks}

    def get_closest_marker(self, name):
        return self.marks.get(name)

    def add_marker(self, mark):
        self.marks[mark.name] = mark.mark


def kept(marks_of, turn=0):
    """Of five cases on three devices, those that plain pytest runs."""
    items = [Item(device, case, *marks_of(case)) for device in DEVICES for case in range(5)]
    take_turns(items, DEVICES[:2], turn)
    return [item.name for item in items if "exhaustive" not in item.marks and item.name[:3] != "gpu"], items


def test_each_case_runs_on_one_device_round_robin_and_on_every_gpu():
    names, items = kept(lambda case: [in_turn().mark])
    assert names == ["one-0", "one-2", "one-4", "two-1", "two-3"]
    assert not any("exhaustive" in item.marks for item in items[10:])
    assert kept(lambda case: [in_turn(1).mark])[0] == ["one-1", "one-3", "two-0", "two-2", "two-4"]


@pytest.mark.parametrize("number", [None, by("pair"), by_lens])
def test_two_runs_have_every_case_on_both_devices(number):
    runs = [kept(lambda case: [in_turn(0, number).mark], turn)[0] for turn in (0, 1)]
    assert all(len(run) == 5 and {name[:3] for name in run} == {"one", "two"} for run in runs)
    assert len({*runs[0], *runs[1]}) == 10


def test_cases_of_one_number_run_on_one_device():
    assert kept(lambda case: [in_turn(0, by("pair")).mark])[0] == [
        "one-0",
        "one-1",
        "one-4",
        "two-2",
        "two-3",
    ]
    assert kept(lambda case: [in_turn(0, by_lens).mark])[0] == ["one-0", "one-1", "one-3", "two-2", "two-4"]


def test_what_is_left_out_anyway_is_not_scheduled():
    rest = pytest.mark.exhaustive.mark
    assert kept(lambda case: [in_turn().mark] + [rest] * (case % 2))[0] == ["one-0", "one-4", "two-2"]


def test_other_tests_run_on_every_device():
    assert len(kept(lambda case: [])[0]) == 10


def test_a_chessboard_and_a_sample():
    fields = alternate({"a": 1, "b": 2}, {"x": 3, "y": 4})
    assert [case.values for case in fields if not case.marks] == [(1, 3), (2, 4)]
    cases = sampled("abcdef", 2, seed=1)
    assert sum(not case.marks for case in cases) == 2
    assert [case.values[0] for case in cases] == list("abcdef")


def test_a_wrong_pixel_is_found_in_one_of_two_runs(monkeypatch):
    """And by complete sweeps."""
    image = FrameSpec(random_splats(3, 1), fs.Camera.pinhole(50, 40, 40.0, 40.0, 25.0, 20.0))
    assert FEW_PIXELS < 50 * 40
    images = {name: np.array(reference_images(image)[name]) for name in image.outputs}
    agree = []
    for pixel in (None, (7, 8), (8, 8)):
        if pixel is not None:
            images["rgb"][pixel] += 0.5
        for turn in (0, 1, None):
            monkeypatch.setattr(sampling, "TURN", turn)
            agree.append(all(difference.agrees for difference in differences_of(images, image)))
    assert agree == [True, True, True, True, False, False, False, False, False]
