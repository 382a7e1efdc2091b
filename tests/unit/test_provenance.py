"""The hash of the code, under which results are stored, covers every source that may change them."""

import json
import pickle
import shutil
from functools import partial

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cameras import Motion, Trajectory
from fidsplat.util import provenance


@pytest.fixture(scope="module")
def tree():
    return provenance.sources()


@pytest.mark.parametrize(
    "folder",
    [
        "kernels/opencl", "kernels/warp", "fidsplat/scenes", "fidsplat/selftest",
        "fidsplat/experiments/bench", "fidsplat/accuracy", "fidsplat/backends/warp", "fidsplat/vision",
    ],
)  # fmt: skip
def test_a_changed_source_is_other_code(tree, tmp_path, monkeypatch, folder):
    before = provenance.code_hash.__wrapped__()
    files = {name: file for name, file in tree.items() if name.startswith(f"{folder}/")}
    assert files
    name = min(files)
    (tmp_path / "changed").write_bytes(files[name].read_bytes() + b" ")
    monkeypatch.setattr(provenance, "sources", lambda: tree | {name: tmp_path / "changed"})
    assert provenance.code_hash.__wrapped__() != before
    monkeypatch.setattr(provenance, "sources", lambda: {k: v for k, v in tree.items() if k != name})
    assert provenance.code_hash.__wrapped__() != before


def test_data_counts_and_what_python_makes_of_sources_does_not(tree):
    assert "fidsplat/accuracy/candidates.json" in tree
    assert not [name for name in tree if "__pycache__" in name or name.endswith(".pyc")]


def test_a_wheel_has_the_code_of_its_checkout(tree, tmp_path, monkeypatch):
    """Its kernels lie within the package."""
    before = provenance.code_hash.__wrapped__()
    for name, file in tree.items():
        top, _, rest = name.partition("/")
        copy = tmp_path / "fidsplat" / ("_kernels" if top == "kernels" else "") / rest
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, copy)
    monkeypatch.setattr(provenance, "_PACKAGE", tmp_path / "fidsplat")
    monkeypatch.setattr(provenance, "kernels_folder", lambda: tmp_path / "fidsplat" / "_kernels")
    assert provenance.code_hash.__wrapped__() == before


def test_facts_name_what_numbers_depend_on():
    facts = json.loads(json.dumps(provenance.run_facts("a device", 3, {"opencv": "5"})))
    assert set(facts) == {"device", "machine", "versions", "commit", "code", "seed", "date"}
    assert facts["versions"]["fidsplat"] == fs.__version__
    assert facts["versions"]["opencv"] == "5"
    assert facts["code"] == provenance.code_hash()


def resting(time):
    """A pose that anybody may write otherwise under the same name."""
    return np.eye(4)


class Resting:
    def __call__(self, time):
        return resting(time)


@pytest.mark.parametrize("pose", [resting, partial(resting), Resting(), Resting().__call__])
def test_what_is_known_by_name_only_has_no_digest(pose):
    with pytest.raises(pickle.PicklingError, match="a function, not data"):
        provenance.digest_of(fs.Capture(motion=Motion(pose)))


def test_data_have_the_digest_of_what_they_hold():
    def digest(height):
        pose = np.eye(4)
        pose[1, 3] = height
        path = Trajectory([0, 1], np.stack([pose, pose]))
        return provenance.digest_of((fs.Capture(motion=Motion(path)), np.ones(3)))

    assert digest(1.0) == digest(1.0)
    assert digest(1.0) != digest(2.0)
