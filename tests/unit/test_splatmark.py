"""The Splatmark site: which renderer wins at 1/255, rank reversals, exponents, the table of the README."""

import json

import pytest
import splatmark

UNIFORM, HAZE, POINTS = ("r1", "r2"), ("h",), ("splats@10", "splats@100", "splats@1000")


def scene(regime: str, x: float | None = None) -> dict:
    size = {"splats": 10, "width": 64, "height": 48, "views": 1}
    return size | {
        "regime": regime,
        "kind": "disks",
        "about": "<splats>",
        "licence": "",
        "batch": False,
        "x": x,
    }


def result(name: str, renderer: str, setting: str, median: float, error: float) -> dict:
    times = {
        "quartiles_ms": [0.9 * median, median, 1.2 * median],
        "fastest_ms": median,
        "first_frame_ms": 9.0,
    }
    errors = {"largest_error": error, "mean_error": error / 10, "psnr_db": 40.0}
    return {"scene": name, "renderer": renderer, "setting": setting, "frames": 3, "memory_bytes": 2**20} | {
        "memory_of": "process", "load_ms": 1.0, **times, **errors
    }  # fmt: skip


@pytest.fixture
def file(tmp_path):
    facts = {"version": "1", "device": "a CPU", "kind": "cpu", "driver": "d", "settings": {}}
    results = [
        result("r1", "a", "exact", 4.0, 1e-5), result("r1", "a", "coarse", 1.0, 0.1),
        result("r2", "a", "exact", 9.0, 0.0), result("h", "a", "exact", 50.0, 1e-3),
        result("r1", "b", "only", 8.0, 1e-3), result("r2", "b", "only", 8.0, 1e-3),
        result("h", "b", "only", 20.0, 3e-3),
        result("r1", "half", "only", 2.0, 0.02), result("r2", "half", "only", 2.0, 0.5),
        *(result(f"splats@{x}", "a", "exact", x**0.5, 0.0) for x in (10, 100, 1000)),
        {"scene": "r1", "renderer": "none", "skipped": "no GPU"},
    ]  # fmt: skip
    scenes = {name: scene("uniform") for name in UNIFORM} | {"h": scene("haze")}
    content = {
        "schema": 2,
        "run": {"date": "2026-11-28", "machine": "m", "commit": None, "command": "bench & more"},
        "scenes": scenes | {name: scene("scaling", float(name.split("@")[1])) for name in POINTS},
        "renderers": {name: facts for name in ("a", "b", "half")} | {"none": {"skipped": "no GPU"}},
        "results": results,
    }
    path = tmp_path / "suite-test.json"
    path.write_text(json.dumps(content))
    return path


def test_renderers_are_ranked_by_the_times_of_settings_within_the_error(file):
    uniform, haze = splatmark.groups_of(splatmark.load([file]))
    assert [(entry.renderer, entry.scenes) for entry in uniform.ranking] == [("a", 2), ("b", 2)]
    assert uniform.winner.milliseconds == pytest.approx(6.0)  # of 4 and 9
    assert uniform.ranking[0].ratio == pytest.approx((9 / 8) ** 0.5)
    assert [(entry.renderer, entry.scenes) for entry in uniform.by_mean] == [("a", 2), ("b", 2), ("half", 1)]
    assert haze.winner.renderer == "b"
    assert splatmark.reversals(haze, [uniform, haze]) == {"a": ["b"], "b": ["a"]}
    assert splatmark.reversals(uniform, [uniform, haze]) == {}


def test_exponents_of_series(file):
    (device,) = splatmark.load([file])
    assert splatmark.scaling(device) == [
        {"renderer": "a", "splats": pytest.approx(0.5), "pixels": None, "size": None}
    ]


def test_the_page_answers_first_and_escapes_names(file, tmp_path):
    page = splatmark.write_site([file], tmp_path / "site").read_text()
    answer = page[: page.index("<h2>")]
    assert '<span class="win">b</span> 20 ms' in answer
    assert 'class="reversed"' in page
    assert "&lt;splats&gt;" in page
    assert "bench &amp; more" in page
    assert "skipped: no GPU" in page
    assert page.count("<svg") == 3
    assert json.loads((tmp_path / "site" / file.name).read_text())["schema"] == 2


def test_the_readme_has_a_line_for_each_regime(file):
    text = splatmark.readme_table(splatmark.load([file]))
    assert text.splitlines()[2:] == [
        "| uniform | disks: **a**, then b (1.3 x) |",
        "| haze | disks: **b**, then a (2.5 x) |",
    ]
