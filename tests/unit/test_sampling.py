"""What plain pytest leaves to `pytest -m exhaustive`."""

from types import SimpleNamespace

import numpy as np
import sampling
from agreement import FEW_PIXELS, differences_of, random_splats, reference_images
from sampling import alternate, sampled, take_turns

import fidsplat as fs
from fidsplat.selftest.agreement import FrameSpec

DEVICES = ("one", "two", "gpu")


class Item:
    """A collected test."""

    def __init__(self, file, device, case):
        self.nodeid = f"{file}::test[{device}-{case}]"
        self.callspec = SimpleNamespace(params={"renderer": device})
        self.kept = True

    def add_marker(self, mark):
        self.kept &= mark.name != "exhaustive"


def kept(turn, devices=DEVICES, files="abcdefgh"):
    """Of two cases per file and device, the names of those that plain pytest runs."""
    items = [Item(file, device, case) for file in files for device in devices for case in (0, 1)]
    take_turns(items, DEVICES[:2], turn)
    return {item.nodeid for item in items if item.kept}


def test_each_file_runs_on_one_device_of_the_processor_and_on_every_gpu():
    run = kept(0)
    for file in "abcdefgh":
        cases = {each.partition("[")[2] for each in run if each.startswith(file)}
        assert cases in (
            {f"{device}-{case}]" for device in (own, "gpu") for case in (0, 1)} for own in ("one", "two")
        )
    assert len({each.partition("[")[2][:3] for each in run}) == 3
    # a selection of files keeps their devices
    assert kept(0, files="c") == {each for each in run if each[0] == "c"}


def test_two_runs_have_every_case_on_every_device():
    runs = kept(0), kept(1)
    assert len(runs[0] | runs[1]) == 8 * 3 * 2
    assert all("gpu" in each for each in runs[0] & runs[1])


def test_tests_of_one_device_run_always():
    assert kept(0, ("one", "gpu")) == kept(1, ("one", "gpu")) == kept(2, ("one", "gpu"))
    assert len(kept(0, ("one", "gpu"))) == 8 * 2 * 2


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
        for turn in (0, 2, None):
            monkeypatch.setattr(sampling, "TURN", turn)
            agree.append(all(difference.agrees for difference in differences_of(images, image)))
    assert agree == [True, True, True, True, False, False, False, False, False]
