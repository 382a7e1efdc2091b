"""Mixtures: approximation of a rectangle by 2D Gaussians.

A template has the Gaussians of a rectangle with half sizes of 1: rows of x, y, sigma_x, sigma_y, opacity.
`paper` (`paper_template`) is the construction of the paper's section 3.2. `fitted` (`fitted_templates`) are
templates optimised by tools/fit_templates.py for complete markers; see docs/markers.md. `nested_gaussians`
computes templates of many Gaussians by a formula: along each axis a central Gaussian, and pairs at the
distances d = ratio^-k from the ends, each so wide that it has decayed at a small distance beyond the end. A
template is the product over both axes: every interior point is near the centres of several Gaussians.
"""

from __future__ import annotations

import json
import math
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from fidsplat.capture.quality import LADDER, MAX_DENSITY, MAX_LEVELS, NESTED, MarkerQuality
from fidsplat.util.arguments import whole_number

GAMMA = 3.0
"""The paper's cut-off: a Gaussian ends at 3 standard deviations."""

OVERLAP = 0.2
"""Overlap of the pieces of a long rectangle, relative to its width."""


class Template(NamedTuple):
    """Gaussians for rectangles up to an aspect ratio, in units of the rectangle's half sizes."""

    max_aspect: float
    """maximum ratio of the longer to the shorter side"""
    gaussians: np.ndarray
    """(n, 5) float64: position along the long side and the short side, sigma along each, opacity"""


def paper_template(levels: int = 4, density: int = 3, duplicates: bool = False) -> np.ndarray:
    """The paper's mixture of a rectangle (section 3.2): (n, 5) float64 x, y, sigma_x, sigma_y, opacity.

    Level 0 is one Gaussian of sigma 1/3. Each level l = 1 ... levels-1 puts a corner Gaussian at d = 1 -
    2^-l and two arms of 2^(l-1) Gaussians at offsets evenly spaced in [0, d); all opacities are 1.

    Args:
        levels: L of the paper, 1 to 8.
        density: rho of the paper, a whole number of copies of the "early" levels; here all but the last (none
            with one level).
        duplicates: the paper mirrors the first quadrant across both axes, which duplicates the first
            Gaussians of the arms, on the axes. True keeps the duplicates, 2^(L+2) + 4 L - 11 Gaussians at
            density 1; False omits them, 2^(L+2) - 7.

    Raises:
        InputError: levels or density out of range.
    """
    levels = whole_number("levels", levels, 1, MAX_LEVELS)
    density = whole_number("density", density, 1, MAX_DENSITY)
    rows = [np.array([[0.0, 0.0, 1 / GAMMA, 1 / GAMMA, 1.0]])] * (density if levels > 1 else 1)
    for level in range(1, levels):
        d, sigma = 1 - 2.0**-level, 2.0**-level / GAMMA
        offset = d * np.arange(2 ** (level - 1)) / 2 ** (level - 1)
        along = (1 - offset) / GAMMA
        quadrant = [(d, d, sigma, sigma)]
        quadrant += [(o, d, a, sigma) for o, a in zip(offset, along, strict=True)]
        quadrant += [(d, o, sigma, a) for o, a in zip(offset, along, strict=True)]
        mirrored = [
            (sx * x, sy * y, a, b, 1.0)
            for x, y, a, b in quadrant
            for sx, sy in ((1, 1), (-1, 1), (1, -1), (-1, -1))
            if duplicates or ((x or sx > 0) and (y or sy > 0))
        ]
        rows += [np.array(mirrored)] * (density if level < levels - 1 else 1)
    return np.concatenate(rows)


@cache
def _fitted() -> tuple[dict[int, tuple[Template, ...]], float]:
    data = json.loads(files("fidsplat.markers").joinpath("templates.json").read_text("utf-8"))
    sets = {entry["size"]: tuple(map(_template, entry["templates"])) for entry in data["sets"]}
    return sets, data["growth"]


@cache
def _nested(size: int) -> tuple[Template, ...]:
    ladder = LADDERS[size]
    return tuple(Template(limit, nested_gaussians(aspect, ladder)) for limit, aspect in CLASSES)


def _template(entry: dict) -> Template:
    gaussians = np.array([mirror for row in entry["quadrant"] for mirror in _mirrors(row)])
    gaussians.flags.writeable = False
    return Template(entry["max_aspect"], gaussians)


def _mirrors(row: list[float]) -> list[list[float]]:
    """A Gaussian of the first quadrant and its distinct mirror images."""
    x, y, *rest = row
    return [[sx * x, sy * y, *rest] for sy in ((1, -1) if y else (1,)) for sx in ((1, -1) if x else (1,))]


def fitted_templates(size: int = MarkerQuality.template) -> tuple[Template, ...]:
    """The shipped templates of a size (`TEMPLATE_SIZES`) by increasing aspect ratio; `place` cuts longer
    rectangles."""
    return _nested(size) if size in LADDERS else _fitted()[0][size]


def fitted_growth() -> float:
    """Growth of rectangles [modules] for which the shipped templates are optimised."""
    return _fitted()[1]


def count_gaussians(aspect: np.ndarray, templates: tuple[Template, ...]) -> np.ndarray:
    """Number (n,) int64 of Gaussians of each rectangle in `place`."""
    parts = _parts(aspect, templates[-1].max_aspect)
    counts = np.array([len(t.gaussians) for t in templates])
    return parts * counts[_which(np.maximum(aspect, 1 / aspect) / parts, templates)]


def place(
    rectangles: np.ndarray, aspect: np.ndarray, templates: tuple[Template, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Place templates on n rectangles; the Gaussians are in the order of the rectangles.

    rectangles: (n, 4) float64 x0, y0, x1, y1. aspect: (n,) width over height, which selects the template; its
    first axis is along the longer side. Rectangles that are too long for all templates are cut into equal
    pieces. Returns (m, 5) float64 x, y, sigma_x, sigma_y, opacity and (m,) int64 the rectangle of each.
    """
    pieces, aspect, source = split_rectangles(rectangles, aspect, templates[-1].max_aspect)
    upright = aspect < 1
    which = _which(np.maximum(aspect, 1 / aspect), templates)
    counts = np.array([len(t.gaussians) for t in templates])
    # each template in two orientations, the second for upright rectangles
    lying = np.concatenate([t.gaussians for t in templates])
    table = np.concatenate([lying, lying[:, [1, 0, 3, 2, 4]]]).T.copy()
    first = np.cumsum(counts) - counts

    n = counts[which]
    start = first[which] + np.where(upright, len(lying), 0)
    row = np.arange(n.sum()) + np.repeat(start - (np.cumsum(n) - n), n)
    out = np.empty((5, len(row)))  # column by column, without a temporary copy of a hundred million rows
    for axis in (0, 1):
        low, high = pieces[:, axis], pieces[:, axis + 2]
        half = np.repeat((high - low) / 2, n)
        np.multiply(half, table[axis][row], out=out[axis])
        out[axis] += np.repeat((low + high) / 2, n)
        np.multiply(half, table[axis + 2][row], out=out[axis + 2])
    out[4] = table[4][row]
    return out.T, np.repeat(source, n)


def split_rectangles(
    rectangles: np.ndarray, aspect: np.ndarray, longest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut n rectangles across their longer sides into the fewest equal pieces of at most an aspect ratio.

    rectangles: (n, 4) float64 x0, y0, x1, y1. aspect: (n,) width over height. Returns pieces (m, 4), their
    aspect (m,) and the rectangle of each, (m,) int64. Templates fade towards their ends, so pieces overlap at
    cuts, each by `OVERLAP` of its width.
    """
    parts = _parts(aspect, longest)
    owner = np.repeat(np.arange(len(parts)), parts)
    nth = np.arange(len(owner)) - np.repeat(np.cumsum(parts) - parts, parts)
    pieces, aspect, parts = rectangles[owner], aspect[owner], parts[owner]
    each, axis = np.arange(len(owner)), (aspect < 1).astype(np.int64)
    low, high = pieces[each, axis], pieces[each, axis + 2]
    step = (high - low) / parts
    overlap = OVERLAP * (pieces[each, 3 - axis] - pieces[each, 1 - axis])
    pieces[each, axis] = np.where(nth > 0, low + nth * step - overlap, low)
    pieces[each, axis + 2] = np.where(nth < parts - 1, low + (nth + 1) * step + overlap, high)
    return pieces, np.where(axis, aspect * parts, aspect / parts), owner


def _parts(aspect: np.ndarray, longest: float) -> np.ndarray:
    """Minimum number of equal pieces of aspect ratio at most `longest`, for rectangles of these aspect
    ratios."""
    return np.maximum(np.ceil(np.maximum(aspect, 1 / aspect) * (1 - 1e-9) / longest), 1).astype(np.int64)


def _which(aspect: np.ndarray, templates: tuple[Template, ...]) -> np.ndarray:
    """Index of the template for each aspect ratio of 1 or more."""
    return np.searchsorted([t.max_aspect for t in templates], aspect * (1 - 1e-9))


CUT = math.sqrt(2 * math.log(255))
"""Standard deviations at which an opaque Gaussian has fallen to 1/255."""
CLASSES = ((1.3, 1.0), (2.6, 2.0), (5.2, 4.0), (10.4, 8.0))
"""Maximum aspect ratio of a template, and the aspect ratio that it is computed for."""


class Ladder(NamedTuple):
    """Geometric series of Gaussians towards each end of a side, with distances that decrease by `ratio`."""

    ratio: float
    pairs: int
    overhang: float
    """distance beyond the end, in half widths of the short side"""
    reach: float
    """standard deviations from a Gaussian's centre to its overhang"""
    copies: int


LADDERS = {
    LADDER: Ladder(ratio=2.0, pairs=5, overhang=0.03, reach=2.6, copies=1),
    # one copy would transmit 1 % between neighbours, and with an opacity ceiling of 0.99 also at its centre
    NESTED: Ladder(ratio=1.55, pairs=8, overhang=0.03, reach=CUT, copies=2),
}
"""Parameters by the number of Gaussians of a square."""


def nested_gaussians(aspect: float, ladder: Ladder) -> np.ndarray:
    """Template for an aspect ratio: (n, 5) float64 x, y, sigma_x, sigma_y, opacity in half sizes, the long
    side first."""
    pairs, overhang = ladder.pairs, ladder.overhang
    further = math.ceil(math.log(aspect) / math.log(ladder.ratio))
    along, across = _axis(ladder, pairs + further, overhang / aspect), _axis(ladder, pairs, overhang)
    rows = [
        (x, y, sx, sy, 1.0)
        for i, x, sx in along
        for j, y, sy in across
        # the smallest Gaussians, in the corners, need no copies
        for _ in range(1 if min(i, j) > pairs - 2 else ladder.copies)
    ]
    gaussians = np.array(rows)
    gaussians.flags.writeable = False
    return gaussians


def _axis(ladder: Ladder, pairs: int, overhang: float) -> list[tuple[int, float, float]]:
    """Step towards the ends, position and sigma of each Gaussian of an axis, in half lengths."""
    steps = [(k, ladder.ratio**-k, side) for k in range(1, pairs + 1) for side in (1, -1)]
    outer = [(k, side * (1 - d), (d + overhang) / ladder.reach) for k, d, side in steps]
    return [(0, 0.0, (1 + overhang) / ladder.reach), *outer]
