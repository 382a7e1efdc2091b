"""Bar charts with error bars as SVG, so that plots need no plotting library."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

COLOURS = (
    "#777777", "#d1495b", "#edae49", "#00798c", "#30638e", "#7b4f9d", "#2e8b57", "#c26a2d", "#1f2d3d",
    "#e377c2", "#8c6d31", "#6baed6", "#9c9ede",
)  # fmt: skip
"""as many as a chart has series: the ideal, three mixtures in three ways, and what is the paper's"""
_WIDTH, _HEIGHT = 900, 360
_LEFT, _RIGHT, _BOTTOM = 62, 16, 34
_ROW = 16  # of the legend


class Bar(NamedTuple):
    """A value and half the length of its error bar."""

    value: float
    spread: float = 0.0


def bar_chart(
    title: str,
    axis: str,
    groups: Sequence[str],
    series: Mapping[str, Sequence[Bar | None]],
    logarithmic: bool = False,
) -> str:
    """Groups of bars side by side, one bar for each series.

    Args:
        title, axis: what is shown, and its unit.
        groups: names along the axis.
        series: name -> a bar for each group, None where there is no value.
        logarithmic: values above 0 on a scale of powers of ten.

    Returns an SVG document. Raises ValueError when there is no bar, or one at or below 0 on a logarithmic
    scale.
    """
    bars = [bar for row in series.values() for bar in row if bar is not None]
    if not bars:
        raise ValueError("a chart needs at least one bar")
    ticks = _powers(bars) if logarithmic else _steps(bars)
    low, high = ticks[0], ticks[-1]

    names, rows = legend(list(series))
    top = 44 + _ROW * rows

    def place(value: float) -> float:
        if logarithmic:
            share = math.log10(max(value, low) / low) / math.log10(high / low)
        else:
            share = (max(value, low) - low) / (high - low)
        return _HEIGHT - _BOTTOM - share * (_HEIGHT - top - _BOTTOM)

    parts = [text(_WIDTH / 2, 18, title, "middle", 15), text(8, top - 8, axis, "start", 11), *names]
    for tick in ticks:
        y = place(tick)
        parts.append(f'<path d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}" stroke="#ddd"/>')
        parts.append(text(_LEFT - 6, y + 4, f"{tick:,.10g}", "end", 11))
    wide = (_WIDTH - _LEFT - _RIGHT) / len(groups)
    thick = 0.84 * wide / len(series)
    for g, group in enumerate(groups):
        x0 = _LEFT + g * wide
        parts.append(text(x0 + wide / 2, _HEIGHT - 12, group, "middle", 12))
        for s, row in enumerate(series.values()):
            bar = row[g]
            if bar is None:
                continue
            x, y = x0 + 0.08 * wide + s * thick, place(bar.value)
            floor = _HEIGHT - _BOTTOM - y
            colour = COLOURS[s % len(COLOURS)]
            size = f'width="{0.92 * thick:.1f}" height="{floor:.1f}"'
            parts.append(f'<rect x="{x:.1f}" y="{y:.1f}" {size} fill="{colour}"/>')
            if bar.spread > 0:
                ends = place(bar.value + bar.spread), place(bar.value - bar.spread)
                middle = x + 0.46 * thick
                parts.append(f'<path d="M{middle:.1f} {ends[0]:.1f}V{ends[1]:.1f}" stroke="#000"/>')
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" font-family="sans-serif">'
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="#fff"/>{"".join(parts)}</svg>\n'
    )


def legend(names: list[str]) -> tuple[list[str], int]:
    """Squares and names in as many rows as they need; the number of rows."""
    parts, x, rows = [], float(_LEFT), 1
    for s, name in enumerate(names):
        length = 30 + 6.4 * len(name)
        if x + length > _WIDTH and x > _LEFT:
            x, rows = float(_LEFT), rows + 1
        y = 10 + _ROW * rows
        square = f'width="10" height="10" fill="{COLOURS[s % len(COLOURS)]}"'
        parts += [f'<rect x="{x:.0f}" y="{y}" {square}/>', text(x + 14, y + 9, name, "start", 11)]
        x += length
    return parts, rows


def _steps(bars: list[Bar]) -> list[float]:
    top = max(bar.value + bar.spread for bar in bars) or 1.0
    unit = 10 ** math.floor(math.log10(max(top, 1e-12)))
    step = next(unit * k for k in (0.1, 0.2, 0.5, 1, 2) if top / (unit * k) <= 8)
    return [round(i * step, 12) for i in range(math.ceil(top / step - 1e-9) + 1)]


def _powers(bars: list[Bar]) -> list[float]:
    if min(bar.value for bar in bars) <= 0:
        raise ValueError("a logarithmic scale has no place for values at or below 0")
    first = math.floor(math.log10(min(bar.value for bar in bars)))
    last = math.ceil(math.log10(max(bar.value + bar.spread for bar in bars)))
    return [10.0**k for k in range(first, max(last, first + 1) + 1)]


def text(x: float, y: float, words: str, anchor: str, size: int) -> str:
    """Words at a place, as SVG."""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}">{html.escape(words)}</text>'
    )
