"""Scatter plots on logarithmic or plain axes as SVG, in the manner of `charts`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from fidsplat.experiments.charts import COLOURS, legend, text

_WIDTH, _HEIGHT = 900, 520
_LEFT, _RIGHT, _BOTTOM = 72, 24, 48
_LETTER, _LINE = 5.6, 12  # of a label, px


class Dot(NamedTuple):
    """A point of a plot; one with a label is drawn larger."""

    x: float
    y: float
    label: str = ""


@dataclass(frozen=True)
class Axis:
    """What stands along an axis."""

    title: str
    logarithmic: bool = False


def scatter_chart(
    title: str,
    x_axis: Axis,
    y_axis: Axis,
    series: Mapping[str, Sequence[Dot]],
    joined: Sequence[Dot] = (),
) -> str:
    """Dots in one colour for each series, and a line through `joined`.

    Returns an SVG document. Raises ValueError when there is no dot, or one at or below 0 on a logarithmic
    axis.
    """
    dots = [dot for row in series.values() for dot in row]
    if not dots:
        raise ValueError("a plot needs at least one dot")
    names, rows = legend(list(series))
    top = 44 + 16 * rows
    across = _Scale([dot.x for dot in dots], x_axis.logarithmic, _LEFT, _WIDTH - _RIGHT)
    upward = _Scale([dot.y for dot in dots], y_axis.logarithmic, _HEIGHT - _BOTTOM, top)
    parts = [text(_WIDTH / 2, 18, title, "middle", 15), text(8, top - 8, y_axis.title, "start", 11), *names]
    parts.append(text(_WIDTH - _RIGHT, _HEIGHT - 8, x_axis.title, "end", 11))
    for tick in upward.ticks:
        y = upward.place(tick)
        parts.append(f'<path d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}" stroke="#ddd"/>')
        parts.append(text(_LEFT - 6, y + 4, f"{tick:.10g}", "end", 11))
    for tick in across.ticks:
        x = across.place(tick)
        parts.append(f'<path d="M{x:.1f} {top}V{_HEIGHT - _BOTTOM}" stroke="#eee"/>')
        parts.append(text(x, _HEIGHT - _BOTTOM + 16, f"{tick:.10g}", "middle", 11))
    if joined:
        way = "L".join(f"{across.place(dot.x):.1f} {upward.place(dot.y):.1f}" for dot in joined)
        parts.append(f'<path d="M{way}" fill="none" stroke="#999" stroke-dasharray="4 3"/>')
    labels = _Labels()
    for number, row in enumerate(series.values()):
        colour = COLOURS[number % len(COLOURS)]
        for dot in row:
            x, y = across.place(dot.x), upward.place(dot.y)
            radius = 5 if dot.label else 3
            parts.append(
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="{colour}" fill-opacity="0.8"/>'
            )
            labels.add(x, y, dot.label)
    parts += labels.parts
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" font-family="sans-serif">'
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="#fff"/>{"".join(parts)}</svg>\n'
    )


class _Scale:
    """Values to pixels, with ticks at a few multiples of powers of ten, or at equal steps."""

    def __init__(self, values: Sequence[float], logarithmic: bool, start: float, stop: float) -> None:
        self._start, self._stop, self._logarithmic = start, stop, logarithmic
        low, high = min(values), max(values)
        if logarithmic:
            if low <= 0:
                raise ValueError("a logarithmic scale has no place for values at or below 0")
            spread = high / low
            steps = (1, 1.5, 2, 3, 5, 7) if spread < 10 else (1, 2, 5) if spread < 300 else (1,)
            powers = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 2)
            every = [step * 10.0**power for power in powers for step in steps]
        else:
            unit = 10 ** math.floor(math.log10(max(high - low, 1e-9)))
            step = next(unit * k for k in (0.1, 0.2, 0.5, 1, 2) if (high - low) / (unit * k) <= 10)
            every = [
                round(step * k, 12) for k in range(math.floor(low / step) - 1, math.ceil(high / step) + 2)
            ]
        first = max(tick for tick in every if tick <= low)
        last = min(tick for tick in every if tick >= high and tick > first)
        self.ticks = [tick for tick in every if first <= tick <= last]

    def place(self, value: float) -> float:
        low, high = self.ticks[0], self.ticks[-1]
        if self._logarithmic:
            value, low, high = math.log10(value), math.log10(low), math.log10(high)
        return self._start + (value - low) / (high - low) * (self._stop - self._start)


class _Labels:
    """Names beside dots where there is room; one that finds none stays away."""

    def __init__(self) -> None:
        self.parts: list[str] = []
        self._taken: list[tuple[float, float, float, float]] = []

    def add(self, x: float, y: float, label: str) -> None:
        wide = _LETTER * len(label)
        for dx, dy in ((8, 4), (8, -8), (8, 16), (-8 - wide, 4), (-8 - wide, -8), (-8 - wide, 16)):
            box = (x + dx, y + dy - _LINE, x + dx + wide, y + dy)
            inside = box[0] > _LEFT and box[2] < _WIDTH and box[3] < _HEIGHT - _BOTTOM
            if label and inside and not any(_meet(box, other) for other in self._taken):
                self._taken.append(box)
                self.parts.append(text(x + dx, y + dy, label, "start", 10))
                return


def _meet(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
