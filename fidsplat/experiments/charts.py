"""Charts by matplotlib as SVG or PNG: grouped bars, and point labels that do not overlap."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import IO, Any

import numpy as np

from fidsplat.util.errors import required_package
from fidsplat.util.files import atomic_write, printable

with required_package("matplotlib", "experiments"):
    import matplotlib
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.text import Text
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
    from matplotlib.transforms import Bbox

Values = Sequence[float]
_STYLE: dict[Any, Any] = {
    "svg.hashsalt": "fidsplat",  # files are reproducible
    "figure.dpi": 72,  # SVG's resolution, so that measured text sizes are correct
    "font.size": 10,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
}
COLORS = (
    *("#777777", "#d1495b", "#edae49", "#00798c", "#30638e"),
    *("#7b4f9d", "#2e8b57", "#1f2d3d", "#c26a2d", "#a9c5a0"),
)
"""colours of series"""


@contextmanager
def chart(
    file: Path, panels: int = 1, size: tuple[float, float] = (9.0, 4.2), one_scale: bool = True, rows: int = 1
):
    """Figure and its axes in a row; the file is written on exit unless an error is raised.

    size: inches. one_scale: share the vertical scale among all axes. rows: number of rows of `panels` axes.
    """
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)  # required to measure texts
        axes = figure.subplots(rows, panels, squeeze=False, sharey=one_scale).ravel()
        yield figure, axes
        with atomic_write(file) as stream:
            if file.suffix == ".png":
                _write_png(figure, stream)
            else:
                figure.savefig(stream, format=file.suffix[1:], metadata={"Date": None})


def _write_png(figure: Figure, stream: IO[bytes]) -> None:
    """Write a PNG file with a palette, which has a quarter of the size."""
    from PIL import Image  # matplotlib requires it

    with io.BytesIO() as content:
        figure.savefig(content, format="png", dpi=110)
        Image.open(content).convert("RGB").quantize(128).save(stream, format="png", optimize=True)


def bars(axes: Axes, groups: Sequence[str], series: Mapping[str, Values], logarithmic: bool = False) -> None:
    """Draw grouped bars of series; NaN leaves a gap."""
    width = 0.84 / max(1, len(series))
    for number, (name, values) in enumerate(series.items()):
        places = np.arange(len(groups)) - 0.42 + width * (number + 0.5)
        axes.bar(places, values, 0.92 * width, label=literal(name), color=COLORS[number % len(COLORS)])
    axes.set_xticks(range(len(groups)), list(map(literal, groups)))
    axes.grid(axis="x", visible=False)
    if logarithmic:
        axes.set_yscale("log")


def legend_above(figure: Figure, axes: Axes) -> None:
    """Add one legend above all panels, with as few rows as fit."""
    handles, names = axes.get_legend_handles_labels()
    for columns in range(min(len(names), 6), 0, -1):
        legend = figure.legend(handles, names, loc="outside upper center", ncols=columns, frameon=False)
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            break
        legend.remove()


def literal(text: str) -> str:
    """Escape a name for matplotlib, which renders text between two $ as mathematics."""
    return printable(text).replace("$", r"\$")


def plain_ticks(axis) -> None:
    """Set ticks of a logarithmic axis at 1, 2 and 5, as plain numbers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def label_points(figure: Figure, axes: Axes, points: Sequence[tuple[float, float, str]]) -> None:
    """Label points without overlaps with other labels, points, texts and horizontal lines."""
    figure.canvas.draw()
    inside = axes.get_window_extent()
    dots = [axes.transData.transform((x, y)) for x, y, _ in points]
    occupied = [Bbox.from_bounds(x - 5, y - 5, 10, 10) for x, y in dots]
    occupied += [text.get_window_extent() for text in axes.texts]
    across = [line for line in axes.lines if line.get_transform() == axes.get_yaxis_transform(which="grid")]
    occupied += [line.get_window_extent() for line in across]
    for x, y, name in points:
        for far, (right, up) in product((9, 18, 30, 44, 60, 80), _DIRECTIONS):
            label = axes.annotate(
                name,
                (x, y),
                (right * far, up * far),
                textcoords="offset points",
                ha=("right", "center", "left")[int(np.sign(right)) + 1],
                va=("top", "center", "bottom")[int(np.sign(up)) + 1],
                fontsize=9,
                arrowprops={"arrowstyle": "-", "color": "#888888", "lw": 0.6, "shrinkA": 1, "shrinkB": 3},
            )
            label.set_in_layout(False)
            label.update_positions(figure.canvas.get_renderer())  # type: ignore[attr-defined]
            box = Text.get_window_extent(label).padded(2)  # the text without the line to its point
            if _contains(inside, box) and not any(box.overlaps(other) for other in occupied):
                occupied.append(box)
                break
            label.remove()


def _contains(outer: Bbox, inner: Bbox) -> bool:
    return outer.x0 <= inner.x0 and inner.x1 <= outer.x1 and outer.y0 <= inner.y0 and inner.y1 <= outer.y1


_DIRECTIONS = ((1, 0.5), (1, 0), (1, -0.7), (0, 1), (0, -1), (-1, 0), (-1, 0.7), (-1, -0.7))
