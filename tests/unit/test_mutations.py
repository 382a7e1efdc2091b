"""tools/mutations.toml: bugs that can still be planted, and tools/mutate.py, which plants them."""

import dataclasses
from collections import Counter
from pathlib import Path

import mutate
import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def plants():
    return mutate.read_plants()


def test_every_bug_can_still_be_planted(plants):
    """Its text stands exactly once in its file, and the tests that are to see it exist."""
    texts = {plant.path: (ROOT / plant.path).read_text("utf-8") for plant in plants}
    for plant in plants:
        assert mutate.planted(texts[plant.path], plant) != texts[plant.path]
        files = [test for test in plant.tests if test.startswith("tests/")]
        assert files
        assert all((ROOT / test).exists() for test in files), plant.name
    assert len(plants) >= 150
    assert max(Counter(plant.name for plant in plants).values()) == 1
    assert len({plant.key for plant in plants}) == len(plants)


def test_what_has_changed_is_not_planted(plants):
    for text in ("", plants[0].old * 2):
        with pytest.raises(ValueError, match=f"stands {2 if text else 0} times"):
            mutate.planted(text, plants[0])


def test_a_sample_is_that_of_its_seed(plants):
    some = mutate.chosen(plants, ["formats", "scenes"], 9, 1)
    assert some == mutate.chosen(plants, ["formats", "scenes"], 9, 1)
    assert some != mutate.chosen(plants, ["formats", "scenes"], 9, 2)
    assert len(some) == 9
    assert {plant.area for plant in some} <= {"formats", "scenes"}
    assert mutate.chosen(plants, [], None, 0) == plants


@pytest.fixture
def quick_pytest(monkeypatch):
    """Small runs of pytest spend most of their time on plugins that they do not need."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.setenv("PYTEST_PLUGINS", "xdist.plugin")


@pytest.mark.usefixtures("quick_pytest")
def test_bugs_are_caught_survive_or_are_not_tested(tmp_path, monkeypatch):
    """In a tree of three files; a second run knows what the first found."""
    (tmp_path / "sum.py").write_text("def plus(a, b):\n    return a + b\n")
    (tmp_path / "test_sum.py").write_text(
        "from sum import plus\n\ndef test_it():\n    assert plus(2, 2) == 4\n"
    )
    (tmp_path / "test_bad.py").write_text("def test_it():\n    assert False\n")
    (tmp_path / "pyproject.toml").write_text(
        '[tool.hatch.build.targets.sdist]\ninclude = ["/sum.py", "/test_sum.py", "/test_bad.py"]\n'
        "[tool.pytest.ini_options]\naddopts = '-ra'\n"
    )
    monkeypatch.setattr(mutate, "ROOT", tmp_path)
    caught = mutate.Plant("sum.py", "sums", ("test_sum.py",), "a + b", "a - b", "sign")
    bugs = {
        "caught": caught,
        "survived": dataclasses.replace(caught, new="a * b", wrong="product"),
        "untested": dataclasses.replace(caught, tests=("test_bad.py",), new="a / b"),
    }
    garden, results = mutate.Garden(tmp_path / "copies", 1), mutate.Results(tmp_path / "found.jsonl")
    for expected, plant in bugs.items():
        found = garden.try_plant(plant)
        assert found is not None
        assert found.result == expected
        assert found.test == ("test_sum.py::test_it" if expected == "caught" else "")
        results.add(plant, found)
    known = mutate.Results(tmp_path / "found.jsonl")
    assert [known.of(plant) for plant in bugs.values()] == list(bugs)
    changed = dataclasses.replace(caught, old="return a + b", new="return a - b")
    assert known.of(changed) is None
    assert known.test_of(changed) == "test_sum.py::test_it"
    assert known.of(dataclasses.replace(caught, new="b")) is None
    assert "| sums | 3 | 2 | 1 | 1 |" in mutate.table(list(bugs.values()), known)
    assert (tmp_path / "copies" / "0" / "sum.py").read_text() == (tmp_path / "sum.py").read_text()


@pytest.mark.usefixtures("quick_pytest")
def test_the_likeliest_tests_come_first(tmp_path, monkeypatch):
    """What caught it before, though a sweep leaves that out; then what the plant names; then all."""
    (tmp_path / "sum.py").write_text("def plus(a, b):\n    return a + b\n")
    (tmp_path / "test_sum.py").write_text(
        "import pytest\nfrom sum import plus\n\n"
        "def test_all():\n    assert plus(2, 1) == 3\n\n"
        "def test_few():\n    assert plus(2, 1) == 3\n\n"
        "@pytest.mark.exhaustive\ndef test_swept():\n    assert plus(2, 1) == 3\n"
    )
    (tmp_path / "pyproject.toml").write_text(
        '[tool.hatch.build.targets.sdist]\ninclude = ["/sum.py", "/test_sum.py"]\n[tool.pytest.ini_options]\n'
        "addopts = '-ra -m \"not exhaustive\"'\nmarkers = ['exhaustive']\n"
    )
    monkeypatch.setattr(mutate, "ROOT", tmp_path)
    garden = mutate.Garden(tmp_path / "copies", 1)
    plant = mutate.Plant("sum.py", "sums", ("test_sum.py",), "a + b", "a - b", "sign")
    named = dataclasses.replace(plant, first=("test_sum.py", "-k", "few"))
    nowhere = dataclasses.replace(plant, first=("test_sum.py", "-k", "none"))
    tried = [(plant, "test_sum.py::test_swept"), (named, None), (nowhere, None)]
    found = [garden.try_plant(bug, before) for bug, before in tried]
    assert [one.test.partition("_sum.py::")[2] for one in found if one] == [
        "test_swept",
        "test_few",
        "test_all",
    ]


def test_tests_without_a_device_run_beside_those_of_one():
    """Their names may hold a backend's."""
    (plant,) = (p for p in mutate.read_plants(device="warp:cpu") if p.wrong.endswith("read past the rays"))
    assert plant.tests[-1].endswith("(warp:cpu or not (opencl: or warp:))")
    assert plant.first[-1] == f"{plant.tests[-1]} and (reads_no_ray_beyond)"
