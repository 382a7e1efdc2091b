"""The notebooks of examples/ run unchanged, cell by cell, and contain no outputs."""

import ast
import json
from pathlib import Path

import numpy as np
import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "examples" / "notebooks").glob("*.ipynb"))


def run(code: str, names: dict):
    """Run a cell; returns the value of its last line, if that is an expression, as a notebook shows it."""
    tree = ast.parse(code)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "cell", "exec"), names)
    return None if last is None else eval(compile(ast.Expression(last.value), "cell", "eval"), names)


@pytest.fixture
def shown(request, tmp_path, monkeypatch):
    """Output of each code cell, and the names that the notebook defines."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FIDSPLAT_DEVICE", "reference")
    names: dict = {}
    cells = json.loads(request.param.read_text("utf-8"))["cells"]
    return [run("".join(c["source"]), names) for c in cells if c["cell_type"] == "code"], names


def named(stem: str):
    return next(path for path in NOTEBOOKS if path.stem == stem)


@pytest.mark.parametrize("shown", [named("markers")], indirect=True)
def test_a_marker_is_rendered_and_detected(shown):
    values, names = shown
    assert [reading.pose is not None for reading in names["readings"]] == [True, True]
    assert max(reading.position_error for reading in names["readings"]) < 5e-3
    images = [value._repr_png_() for value in values if hasattr(value, "_repr_png_")]
    assert len(images) == 2
    assert all(png.startswith(b"\x89PNG") for png in images)
    assert sum("<table>" in value._repr_html_() for value in values if hasattr(value, "_repr_html_")) == 3


@pytest.mark.parametrize("shown", [named("images")], indirect=True)
def test_images_are_converted_for_other_libraries(shown, tmp_path):
    values, _ = shown
    assert values[1] == (5, 120, 160, 3)
    assert values[2] == ((120, 160, 3), np.float32)
    assert values[3].ravel().tolist() == [7]
    assert "pixels, 0.99" in values[4] or "pixels, 1.0" in values[4]
    assert (tmp_path / "flight.tum").exists()


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebooks_have_no_stored_results(path):
    notebook = json.loads(path.read_text("utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    ids = [cell["id"] for cell in notebook["cells"]]
    assert len(set(ids)) == len(ids)
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            assert cell["execution_count"] is None
