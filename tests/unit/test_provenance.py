"""The hash under which results are kept covers every source that may change them."""

import json
import shutil

import pytest

import fidsplat as fs
from fidsplat import provenance


@pytest.fixture(scope="module")
def tree():
    return provenance.sources()


@pytest.mark.parametrize(
    "folder",
    [
        "kernels/opencl", "kernels/warp", "fidsplat/scenes", "fidsplat/hard_cases",
        "fidsplat/experiments/bench", "fidsplat/budget", "fidsplat/backends/warp", "fidsplat/vision",
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
    assert "fidsplat/budget/prices.json" in tree
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
