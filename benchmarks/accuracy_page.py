"""Write the measurements of docs/accuracy.md from results of `fidsplat tradeoff`.

    python benchmarks/accuracy_page.py [DIR ...]

DIR: folders with results or their tables; by default devlog/accuracy. Replaces the generated block of
docs/accuracy.md, and writes devlog/accuracy.md with the tables and charts of `fidsplat tradeoff report`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from fidsplat.experiments.pages import fill_template, write_page
from fidsplat.experiments.tradeoff.report import report_content
from fidsplat.util.files import atomic_write

TREE = Path(__file__).parents[1]
PAGE, REPORT = TREE / "docs" / "accuracy.md", TREE / "devlog" / "accuracy.md"
BEGIN, END = "<!-- begin generated -->\n", "<!-- end generated -->\n"


def write_accuracy(folders: Sequence[Path], page: Path = PAGE, report: Path = REPORT) -> None:
    """Write the block of a page, and a report with its tables and charts in the folder of its name."""
    folder = report.with_suffix("")
    context, _ = report_content(folders, folder)
    write_page(report, folder, "accuracy.md.j2", context)
    before, _, rest = page.read_text("utf-8").partition(BEGIN)
    after = rest.partition(END)[2]
    block = fill_template(page, folder, "accuracy_summary.md.j2", context | {"summary": True})
    with atomic_write(page) as stream:
        stream.write(f"{before}{BEGIN}{block}{END}{after}".encode())


if __name__ == "__main__":
    write_accuracy([Path(name) for name in sys.argv[1:]] or [REPORT.with_suffix("")])
