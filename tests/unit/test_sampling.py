"""Cases that plain pytest leaves to `pytest -m exhaustive`."""

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
        self.marks = []

    def get_closest_marker(self, name):
        return name in self.marks or (name == "sweep" and "swept" in self.nodeid)

    def add_marker(self, mark):
        self.marks.append(mark.name)


def selected_cases(turn, devices=DEVICES, files="abcdefgh", cases=2):
    """Of the cases per file and device, those that plain pytest runs, as (file, device, case)."""
    items = [Item(file, device, case) for file in files for device in devices for case in range(cases)]
    take_turns(items, DEVICES[:2], turn)
    ids = [item.nodeid.replace("::test[", " ").replace("-", " ")[:-1] for item in items if not item.marks]
    return {tuple(each.split()) for each in ids}


def test_each_file_runs_on_one_device_of_the_processor_and_on_every_gpu():
    run = selected_cases(0)
    own = {file: device for file, device, _ in run if device != "gpu"}
    assert run == {(file, device, case) for file in own for device in (own[file], "gpu") for case in "01"}
    assert set(own.values()) == {"one", "two"}
    # a selection of files keeps their devices
    assert selected_cases(0, files="c") == {each for each in run if each[0] == "c"}


def test_a_sweep_of_kernels_runs_every_other_case():
    for cases in (sampling.SWEEP, 9):
        run = selected_cases(0, files="a", devices=("one",), cases=cases)
        assert abs(len(run) - cases / 2) <= 0.5
        assert len({int(case) % 2 for *_, case in run}) == 2
    others = {
        name: selected_cases(0, files=[f"tests/unit/{name}.py"], devices=("one",), cases=8)
        for name in ("a", "swept")
    }
    assert [len(run) for run in others.values()] == [8, 4]
    runs = [selected_cases(turn, files=["swept"], devices=("one",), cases=1) for turn in (0, 4)]
    assert sorted(map(len, runs)) == [0, 1]


def test_all_turns_have_every_case_on_every_device():
    runs = [selected_cases(turn, cases=9) for turn in range(8)]
    assert len(set.union(*runs)) == 8 * 3 * 9
    assert set.intersection(*runs) == set()
    assert max(map(len, runs)) < 8 * 3 * 9 / 2


def test_tests_of_one_device_run_always():
    assert (
        selected_cases(0, ("one", "gpu"))
        == selected_cases(1, ("one", "gpu"))
        == selected_cases(4, ("one", "gpu"))
    )
    assert len(selected_cases(0, ("one", "gpu"))) == 8 * 2 * 2


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
