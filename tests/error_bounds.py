"""`pytest --error-bounds=FILE`: counts of pixels that the reference does not determine, over all images
that a run compares.

An error bound says what float32 may change in a pixel's colour (fidsplat/backends/reference/error_bounds.py):
where it is large, a test sees little there. A plugin of pytest, which conftest.py names.
"""

import json
import os
from collections import defaultdict
from pathlib import Path

import numpy as np

from fidsplat.backends.reference.backend import ReferencePipeline

THRESHOLDS = 2e-5, 1e-3, 0.05
"""the tolerance of colours, a quarter of an 8-bit step, and what a thousandth of an image may exceed"""
FILES = 5
"""that have a row of their own"""
_found = defaultdict(lambda: np.zeros(2 + len(THRESHOLDS), int))
"""images, pixels, pixels above each threshold, by the file of the test"""


def pytest_addoption(parser):
    words = "count the error bounds of all pictures that are compared, and print their distribution"
    parser.addoption("--error-bounds", metavar="FILE", type=Path, help=words)


def pytest_configure(config):
    file = config.getoption("--error-bounds")
    if file is None:
        return
    if not hasattr(config, "workerinput"):  # in the first process alone
        file.write_text("", "utf-8")
    ReferencePipeline.pixels = counting(ReferencePipeline.pixels)


def counting(pixels):
    """`ReferencePipeline.pixels`, through which each image of the reference is rendered, and counted here."""

    def counted(self, resident, view, rows, columns, **how):
        images = pixels(self, resident, view, rows, columns, **how)
        bound = images["error_bound"]
        above = [np.count_nonzero(bound > threshold) for threshold in THRESHOLDS]
        _found[os.environ.get("PYTEST_CURRENT_TEST", "").split("::")[0]] += [1, bound.size, *above]
        return images

    return counted


def pytest_sessionfinish(session):
    file = session.config.getoption("--error-bounds")
    if file is not None and _found:
        with file.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({name: counts.tolist() for name, counts in _found.items()}) + "\n")


def pytest_terminal_summary(terminalreporter, config):
    file = config.getoption("--error-bounds")
    if file is not None:
        terminalreporter.write_line(table(file))


def table(file):
    """Markdown table of the counts of all processes: by folder, and the files with the most pixels above
    the second threshold."""
    files, folders = (defaultdict(lambda: np.zeros(2 + len(THRESHOLDS), int)) for _ in range(2))
    for line in file.read_text("utf-8").splitlines():
        for name, counts in json.loads(line).items():
            files[name.removeprefix("tests/")] += counts
    for name, counts in files.items():
        folders[name.rpartition("/")[0]] += counts
    widest = sorted(files, key=lambda name: files[name][3] / max(files[name][1], 1), reverse=True)[:FILES]
    heads = "".join(f" above {threshold:g} |" for threshold in THRESHOLDS)
    rows = [
        f"| error bounds | pictures | pixels |{heads}",
        "|---|" + "---|" * (2 + len(THRESHOLDS)),
        *(_row(name, folders[name]) for name in sorted(folders)),
        *(_row(name, files[name]) for name in widest),
        _row("all", sum(folders.values(), np.zeros(2 + len(THRESHOLDS), int))),
    ]
    return "\n".join(rows)


def _row(name, counts):
    pictures, pixels, *above = counts.tolist()
    shares = "".join(f" {count / max(pixels, 1):.4%} |" for count in above)
    return f"| {name} | {pictures:,} | {pixels:,} |{shares}"
