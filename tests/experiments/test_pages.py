"""Reports follow from their tables, are short, and have small data files."""

import shutil
from pathlib import Path

import accuracy_page

from fidsplat.experiments.charts import bars, chart, legend_above
from fidsplat.experiments.report import make_report

ROOT = Path(__file__).parents[2]
DEVLOG = ROOT / "devlog"


def test_the_page_of_results_follows_from_its_tables(tmp_path):
    shutil.copytree(DEVLOG / "results", tmp_path / "results")
    make_report([tmp_path / "results"], tmp_path / "results.md")
    check_equal(tmp_path, "results", "run fidsplat experiment report devlog/results -o devlog/results.md")


def test_the_page_of_accuracy_follows_from_its_tables(tmp_path, monkeypatch):
    monkeypatch.setattr(accuracy_page, "label_points", lambda *_: None)  # of its charts
    shutil.copytree(DEVLOG / "accuracy", tmp_path / "devlog" / "accuracy")
    page = tmp_path / "docs" / "accuracy.md"
    page.parent.mkdir()
    shutil.copy(ROOT / "docs" / "accuracy.md", page)
    accuracy_page.write_accuracy(
        [tmp_path / "devlog" / "accuracy"], page, tmp_path / "devlog" / "accuracy.md"
    )
    remedy = "run benchmarks/accuracy_page.py"
    assert page.read_text() == (ROOT / "docs" / "accuracy.md").read_text(), remedy
    check_equal(tmp_path / "devlog", "accuracy", remedy)


def check_equal(folder: Path, name: str, remedy: str) -> None:
    """The page and tables of a folder are those of the repository."""
    assert (folder / f"{name}.md").read_text() == (DEVLOG / f"{name}.md").read_text(), remedy
    for table in (DEVLOG / name).glob("*.csv"):
        assert (folder / name / table.name).read_bytes() == table.read_bytes(), remedy


def test_data_of_pages_are_small():
    tables = [file for name in ("accuracy", "results") for file in (DEVLOG / name).glob("*.csv")]
    assert 0 < sum(file.stat().st_size for file in tables) < 350_000
    images = [
        file
        for name in ("accuracy", "results")
        for file in (DEVLOG / name).iterdir()
        if file.suffix in (".svg", ".png")
    ]
    assert max(file.stat().st_size for file in images) < 150_000


def test_a_legend_is_not_wider_than_its_chart(tmp_path):
    with chart(tmp_path / "chart.svg", size=(9.0, 3.0)) as (figure, (axes,)):
        bars(axes, ("one", "two"), {f"paper, training 2DGS, {views} views": (1.0, 2.0) for views in range(6)})
        legend_above(figure, axes)
        figure.canvas.draw()
        (legend,) = figure.legends
        place = legend.get_window_extent()
    assert 0 <= place.x0 < place.x1 <= figure.bbox.width
