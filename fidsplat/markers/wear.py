"""Print defects and wear of a marker: seeded effects of severity 0 to 1 on a fine grid of colours.

The modules are divided into cells. Each effect maps the colours of the cells to new ones; cells of one colour
are then joined to rectangles. Every effect has its own random numbers, so that its severity does not change
other effects.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fidsplat.images.apriltag3 import HOLE
from fidsplat.markers.partition import merge_runs, partition
from fidsplat.markers.printing import Printed
from fidsplat.util.arguments import instance, number, parse_settings, python_scalars, whole_number
from fidsplat.util.errors import InputError

CELLS = 16
"""cells of a module along an edge"""

WIDEST = 1024
"""maximum cells of a sheet along its longer edge, unless it has more modules"""

SMEAR = 0.5
"""modules by which ink bleeds at severity 1"""

DOT = 1.5
"""modules: dots of a printer at severity 1"""

SCRATCH, SCRATCHED = 0.09, 0.5
"""mean width of a scratch in modules; area of the scratches at severity 1, relative to the sheet"""

TORN = 0.75
"""fraction of the sheet that is torn off at severity 1"""

FOLD = 0.9
"""legs of the corner that is folded over at severity 1, relative to the shorter edge"""

LEVELS = 8
"""number of colours of a gradual change"""

SOIL, COVER = (0.30, 0.24, 0.16), (0.36, 0.40, 0.30)
"""RGB of dirt and of a leaf or tape over the marker"""

BACK = 0.92
"""brightness of the sheet's back relative to its paper"""


@dataclass(frozen=True)
class Wear:
    """Severities of print defects and wear, each 0 (none) to 1.

    The marker's true corners do not change.

    Raises:
        InputError: a severity outside 0 to 1, or a negative seed.
    """

    bleed: float = 0.0
    """ink spreads by half a module at 1"""
    coarseness: float = 0.0
    """dots of the printer, 1.5 modules wide at 1"""
    fading: float = 0.0
    """fraction of the ink's contrast that is lost"""
    dirt: float = 0.0
    """fraction of the sheet with dirt"""
    drops: float = 0.0
    """area of water drops, which magnify the code below, relative to the sheet"""
    scratches: float = 0.0
    """area of scratches, which remove ink, half of the sheet at 1"""
    tear: float = 0.0
    """part torn off from a corner, three quarters of the sheet at 1"""
    fold: float = 0.0
    """corner folded over the front, with legs of 0.9 of the sheet's edge at 1"""
    cover: float = 0.0
    """fraction of the sheet covered by an opaque object with a straight edge"""
    seed: int = 0
    """seed of all random numbers"""

    def __post_init__(self) -> None:
        python_scalars(self)
        for name in EFFECTS:
            number(f"wear: {name}", getattr(self, name), "a severity from 0 to 1", 0.0, 1.0)
        whole_number("wear: seed", self.seed, 0, 2**63 - 1)

    @property
    def visible(self) -> bool:
        """Whether a severity is above 0."""
        return any(getattr(self, name) > 0 for name in EFFECTS)


class Sheet(NamedTuple):
    """Colours of the cells of a sheet."""

    color: np.ndarray
    """(h, w, 3) float64 RGB"""
    present: np.ndarray
    """(h, w) bool, False where there is no paper"""
    cells: int
    """cells of a module along an edge"""
    paper: np.ndarray
    """(3,) RGB of the paper"""

    @property
    def positions(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions of the cells' centres in modules: y (h, 1) and x (1, w)."""
        h, w = self.present.shape
        return (np.arange(h)[:, None] + 0.5) / self.cells, (np.arange(w)[None] + 0.5) / self.cells

    @property
    def size(self) -> tuple[float, float]:
        """Height and width in modules."""
        h, w = self.present.shape
        return h / self.cells, w / self.cells


def wear_of(wear: Wear | str | None) -> Wear | None:
    """Convert a `Wear`, its text or None to a `Wear`: "fading=0.4,dirt=0.2,seed=3"; None if no severity is
    above 0.

    Raises:
        InputError: an unknown effect, or a value out of range.
    """
    if isinstance(wear, str):
        wear = Wear(**parse_settings("wear", Wear, (part.strip() for part in wear.split(","))))
    if wear is None:
        return None
    instance("wear", wear, Wear, "a Wear, its text or None", "e.g. fidsplat.markers.Wear(fading=0.4)")
    return wear if wear.visible else None


def worn(spec: str, printed: Printed, wear: Wear) -> Printed:
    """Rectangles of a worn marker, on a finer grid.

    Raises:
        InputError: a drawing with edges off its module grid.
    """
    if printed.regions is not None:
        raise InputError(
            f"a marker with wear must consist of modules, got {spec}, which has slanted edges; use another "
            "family, or image:FILE of a drawing"
        )
    cells = max(1, min(CELLS, WIDEST // max(printed.grid.shape)))
    fine = printed.grid.repeat(cells, 0).repeat(cells, 1)
    palette = printed.palette.astype(np.float64)
    present = fine != HOLE
    sheet = Sheet(palette[np.where(present, fine, 0)], present, cells, palette[0])
    for place, (name, effect) in enumerate(EFFECTS.items()):
        severity = getattr(wear, name)
        if severity > 0:
            sheet = effect(sheet, float(severity), np.random.default_rng([wear.seed, place]))
    values, palette = _indexed(sheet)
    boxes = partition(values) if values.max() <= 1 else merge_runs(values)
    value = values[boxes[:, 1], boxes[:, 0]]
    left = value != HOLE
    return Printed(values, boxes[left], value[left], None, None, printed.module / cells, palette)


def _indexed(sheet: Sheet) -> tuple[np.ndarray, np.ndarray]:
    """Palette indices of the cells, `HOLE` without paper, and the palette (k, 3) float32."""
    colors = sheet.color[sheet.present]
    steps = 0
    while True:
        known, index = [], np.zeros(len(colors), np.int64)
        for channel in colors.T:
            levels, indices = np.unique(channel, return_inverse=True)
            known.append(levels)
            index = index * len(levels) + indices
        used, index = np.unique(index, return_inverse=True)
        if len(used) < HOLE:
            break
        steps = steps // 2 or 32
        colors = np.rint(colors * steps) / steps
    places = np.unravel_index(used, [len(levels) for levels in known])
    palette = np.column_stack([levels[indices] for levels, indices in zip(known, places, strict=True)])
    values = np.full(sheet.present.shape, HOLE, np.uint8)
    values[sheet.present] = index
    return values, palette.astype(np.float32)


def _coarse(sheet: Sheet, severity: float, rng: np.random.Generator) -> Sheet:
    """Print in square dots, each in the colour of the sheet at the dot's centre."""
    dot = DOT * severity * sheet.cells

    def centers(count: int) -> np.ndarray:
        """Cell at the centre of the dot of each cell along an edge."""
        shift = rng.random()
        number = np.floor((np.arange(count) + 0.5) / dot + shift)
        return np.clip(np.floor((number + 0.5 - shift) * dot), 0, count - 1).astype(int)

    dots = np.ix_(*map(centers, sheet.present.shape))
    return sheet._replace(color=sheet.color[dots], present=sheet.present & sheet.present[dots])


def _bled(sheet: Sheet, severity: float, rng: np.random.Generator) -> Sheet:
    """Ink spreads, unevenly along the edges, and keeps the colour of the nearest ink."""
    distances = SMEAR * severity * sheet.cells * (0.7 + 0.6 * _noise(sheet, 0.4, rng))
    ink = sheet.present & (sheet.color != sheet.paper).any(2)
    max_distance = math.ceil(distances.max() + 0.5)
    steps = np.arange(-max_distance, max_distance + 1)
    dy, dx = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    distance = np.hypot(dy, dx)
    padded, color = np.pad(ink, max_distance), sheet.color.copy()
    todo, (h, w) = sheet.present & ~ink, ink.shape
    colors = np.pad(sheet.color, ((max_distance, max_distance), (max_distance, max_distance), (0, 0)))
    for i in np.argsort(distance, kind="stable"):
        if distance[i] - 0.5 > distances.max():
            break
        shifted = np.s_[
            max_distance + dy[i] : max_distance + dy[i] + h, max_distance + dx[i] : max_distance + dx[i] + w
        ]
        # 0.5 cells: the edge of the ink is half a cell nearer than the centre of the inked cell
        spread = todo & padded[shifted] & (distance[i] - 0.5 <= distances)
        color[spread] = colors[shifted][spread]
        todo &= ~spread
    return sheet._replace(color=color)


def _faded(sheet: Sheet, severity: float, rng: np.random.Generator) -> Sheet:
    """Ink loses contrast to the paper."""
    return sheet._replace(color=sheet.color + severity * (sheet.paper - sheet.color))


def _scratched(sheet: Sheet, severity: float, rng: np.random.Generator) -> Sheet:
    """Straight scratches without ink."""
    h, w = sheet.size
    color, left = sheet.color.copy(), SCRATCHED * severity * h * w
    while left > 0:
        middle, angle = rng.random(2) * (h, w), rng.uniform(0, math.pi)
        length, width = rng.uniform(0.05, 0.5) * max(h, w), SCRATCH * rng.uniform(0.7, 1.3)
        length = min(length, left / width)
        left -= length * width
        near, dy, dx = _around(sheet, middle, length / 2 + width)
        along = np.abs(math.cos(angle) * dx + math.sin(angle) * dy)
        across = np.abs(math.cos(angle) * dy - math.sin(angle) * dx)
        color[near][(along < length / 2) & (across < width / 2)] = sheet.paper
    return sheet._replace(color=color)


def _wet(sheet: Sheet, severity: float, rng: np.random.Generator) -> Sheet:
    """Water drops: lenses that magnify the code, with a dark rim and a highlight."""
    h, w = sheet.size
    color, left = sheet.color.copy(), severity * h * w
    while left > 0:
        middle = rng.random(2) * (h, w)
        radius = min(rng.uniform(0.3, 1.3), math.sqrt(left / math.pi))
        left -= math.pi * radius**2
        near, dy, dx = _around(sheet, middle, radius)
        rows, columns = np.nonzero((np.hypot(dy, dx) < radius) & sheet.present[near])
        dy, dx = dy[rows, 0], dx[0, columns]
        far = np.hypot(dy, dx) / radius
        shrunk = 0.4 + 0.5 * far**2
        source = [
            np.clip(((at + shrunk * step) * sheet.cells).astype(int), 0, n - 1)
            for at, step, n in zip(middle, (dy, dx), sheet.present.shape, strict=True)
        ]
        rim = np.floor(LEVELS * np.clip((far - 0.75) / 0.25, 0, 1)) / LEVELS
        color[near][rows, columns] = sheet.color[tuple(source)] * (0.9 - 0.35 * rim)[:, None]
        shine = np.hypot(dy + 0.4 * radius, dx + 0.4 * radius) < 0.18 * radius
        color[near][rows[shine], columns[shine]] = 1.0
    return sheet._replace(color=color)


def _soiled(sheet: Sheet, severity: float, rng: np.random.Generator) -> Sheet:
    """Patches of dirt with soft edges."""
    rank = _ranks(sheet, np.sum([_noise(sheet, wide, rng) * wide for wide in (4.0, 2.0, 1.0, 0.5)], axis=0))
    opacity = np.clip((rank - (1 - severity)) / 0.15, 0, 1)
    opacity = np.ceil(LEVELS * opacity)[..., None] / LEVELS
    return sheet._replace(color=sheet.color + opacity * (np.array(SOIL) - sheet.color))


def _folded(sheet: Sheet, severity: float, rng: np.random.Generator) -> Sheet:
    """A corner folded over the front, which shows the back of the sheet."""
    (y, x), (h, w) = sheet.positions, sheet.size
    bottom, right = rng.integers(0, 2, 2)
    legs = FOLD * severity * min(h, w) * np.array([1.0, rng.uniform(0.6, 1.0)])
    down, in_ = (h - y if bottom else y), (w - x if right else x)  # from the corner
    normal = np.array([legs[1], legs[0]]) / math.hypot(*legs)
    line = legs[0] * normal[0]
    beyond = line - (normal[0] * down + normal[1] * in_)  # above 0: beyond the fold
    # mirror image of each cell in the fold: under the flap if it is on the corner's side of the sheet
    flap = (beyond <= 0) & (down + 2 * beyond * normal[0] >= 0) & (in_ + 2 * beyond * normal[1] >= 0)
    color = sheet.color.copy()
    color[flap] = BACK * sheet.paper
    return sheet._replace(color=color, present=sheet.present & (beyond <= 0))


def _torn(sheet: Sheet, severity: float, rng: np.random.Generator) -> Sheet:
    """A part torn off from a corner along a ragged line, with a rim of bare paper."""
    (y, x), (h, w) = sheet.positions, sheet.size
    bottom, right = rng.integers(0, 2, 2)
    angle = rng.uniform(0.15, 0.35) * math.pi
    down, in_ = (h - y if bottom else y), (w - x if right else x)
    ragged = 0.6 * (_noise(sheet, 1.2, rng) + 0.5 * _noise(sheet, 0.4, rng))
    distance = math.sin(angle) * down + math.cos(angle) * in_ + ragged
    rank = _ranks(sheet, distance)
    gone = rank < TORN * severity
    edge = distance[~gone & sheet.present].min(initial=math.inf)
    color = sheet.color.copy()
    color[distance < edge + 0.15] = sheet.paper
    return sheet._replace(color=color, present=sheet.present & ~gone)


def _covered(sheet: Sheet, severity: float, rng: np.random.Generator) -> Sheet:
    """An opaque object over one side."""
    (y, x), angle = sheet.positions, rng.uniform(0, 2 * math.pi)
    rank = _ranks(sheet, math.cos(angle) * x + math.sin(angle) * y)
    color = sheet.color.copy()
    color[rank < severity] = COVER
    return sheet._replace(color=color)


EFFECTS: dict[str, Callable[[Sheet, float, np.random.Generator], Sheet]] = {
    "coarseness": _coarse,
    "bleed": _bled,
    "fading": _faded,
    "scratches": _scratched,
    "drops": _wet,
    "dirt": _soiled,
    "fold": _folded,
    "tear": _torn,
    "cover": _covered,
}
"""effects in the order in which they are applied; positions are part of their seeds"""


def _around(
    sheet: Sheet, middle: np.ndarray, reach: float
) -> tuple[tuple[slice, slice], np.ndarray, np.ndarray]:
    """Cells of a square around a position, and their distances (h, 1) down and (1, w) right of it, in
    modules."""
    low = np.maximum(np.floor((middle - reach) * sheet.cells), 0).astype(int)
    high = np.maximum(np.ceil((middle + reach) * sheet.cells), 0).astype(int)
    near, (y, x) = (slice(low[0], high[0]), slice(low[1], high[1])), sheet.positions
    return near, y[near[0]] - middle[0], x[:, near[1]] - middle[1]


def _noise(sheet: Sheet, wide: float, rng: np.random.Generator) -> np.ndarray:
    """Value noise (h, w), 0 to 1: random values on a lattice of some modules, smoothly interpolated."""
    h, w = sheet.size
    lattice = rng.random((math.ceil(h / wide) + 1, math.ceil(w / wide) + 1))
    (i, a), (j, b) = ((np.floor(at / wide).astype(int), at / wide % 1) for at in sheet.positions)
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    above, below = ((1 - b) * lattice[k, j] + b * lattice[k, j + 1] for k in (i, i + 1))
    return (1 - a) * above + a * below


def _ranks(sheet: Sheet, values: np.ndarray) -> np.ndarray:
    """Rank of each cell: fraction of the sheet's cells with a lower value, 0 to 1; 1 without paper."""
    rank = np.ones(sheet.present.shape)
    order = np.argsort(values[sheet.present], kind="stable")
    ranks = np.empty(len(order))
    ranks[order] = np.arange(len(order)) / max(len(order), 1)
    rank[sheet.present] = ranks
    return rank
