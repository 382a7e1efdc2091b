"""The pages of results are what their tables give, short, and their data are small."""

import shutil
from pathlib import Path

import pytest
from accuracy_page import write_accuracy

from fidsplat.experiments.charts import bars, chart, legend_above
from fidsplat.experiments.report import make_report

ROOT = Path(__file__).parents[2]
FOLDERS = {"accuracy": ROOT / "docs", "results": ROOT / "devlog"}


@pytest.mark.parametrize(("name", "write"), [("accuracy", write_accuracy), ("results", make_report)])
def test_a_page_is_what_its_tables_give(tmp_path, name, write):
    folder = FOLDERS[name]
    shutil.copytree(folder / name, tmp_path / name)
    shutil.copy(folder / f"{name}.md", tmp_path)  # may have a generated block
    write([tmp_path / name], tmp_path / f"{name}.md")
    again = "run benchmarks/accuracy_page.py, or fidsplat experiment report"
    assert (tmp_path / f"{name}.md").read_text() == (folder / f"{name}.md").read_text(), again
    for file in ("*.csv", "*.md"):
        for table in (folder / name).glob(file):
            assert (tmp_path / name / table.name).read_bytes() == table.read_bytes(), again


def test_data_of_pages_are_small():
    tables = [file for name in FOLDERS for file in (FOLDERS[name] / name).glob("*.csv")]
    assert 0 < sum(file.stat().st_size for file in tables) < 300_000
    images = [f for name in FOLDERS for f in (FOLDERS[name] / name).iterdir() if f.suffix in (".svg", ".png")]
    assert max(file.stat().st_size for file in images) < 150_000


def test_a_legend_is_not_wider_than_its_chart(tmp_path):
    with chart(tmp_path / "chart.svg", size=(9.0, 3.0)) as (figure, (axes,)):
        bars(axes, ("one", "two"), {f"paper, training 2DGS, {views} views": (1.0, 2.0) for views in range(6)})
        legend_above(figure, axes)
        figure.canvas.draw()
        (legend,) = figure.legends
        place = legend.get_window_extent()
    assert 0 <= place.x0 < place.x1 <= figure.bbox.width
