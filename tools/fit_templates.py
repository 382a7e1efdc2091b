"""Optimise the templates of the mixture `fitted` and write fidsplat/markers/templates.json.

    python tools/fit_templates.py [-o FILE] [--sizes N ...] [--starts N] [--rounds N]

A size is the number of Gaussians of a rectangle that is not long; sizes that are not named stay unchanged in
the file. Requires scipy (extra `dev`) and some minutes on one core; results are reproducible with the same
library versions. There are two stages, both L-BFGS-B with analytic gradients, mirror-symmetric by
construction:

1. For each class of aspect ratio, a single rectangle: the mean square of (coverage - indicator) around it,
from several random starts. With one colour the order of compositing does not matter.
2. All classes together on parts of real markers, both colours, against the ideal texture, over black, grey
   and white backgrounds: composited as a coplanar group (one layer, colours weighted by optical depth), and
   like other renderers in the order of the splats' centres along two directions.

Samples have random positions in the cells of a grid: a regular grid would miss lines thinner than its step.
"""

from __future__ import annotations

import argparse
import json
import random
import string
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from fidsplat.markers import marker
from fidsplat.markers.mixture import split_rectangles
from fidsplat.markers.partition import partition
from fidsplat.markers.printing import grow
from fidsplat.util.files import atomic_write

GROWTH = 0.4  # modules; measured together with the templates, see docs/markers.md
THINNEST = 0.025  # minimum sigma in half widths: thinner lines alias between the samples of a pixel
LONGEST = {"c": 0.42, "x": 0.42, "y": 0.42, "q": 0.25}  # maximum sigma: longer lines are visible at corners
FEW, LONGEST_OF_FEW = 13, 0.8  # fewer Gaussians than this must be wide, in spite of these lines
CUT = 1 / 255
# maximum aspect ratio of each class, and aspect ratio of stage 1
CLASSES = ((2.5, 1.0), (6.0, 4.0), (10.0, 9.0))
# for each class, in addition to the central Gaussian: pairs on the long axis, pairs on the short axis, fours
COUNTS = {
    1: ((0, 0, 0), (0, 0, 0), (0, 0, 0)),
    5: ((1, 1, 0), (1, 1, 0), (1, 1, 0)),
    9: ((1, 1, 1), (1, 1, 1), (2, 1, 1)),
    13: ((2, 2, 1), (2, 2, 1), (3, 2, 1)),
    25: ((4, 4, 2), (4, 4, 2), (5, 4, 3)),
    41: ((6, 6, 4), (6, 6, 4), (7, 7, 5)),
}
BACKGROUNDS = (0.0, 0.5, 1.0)
ORDERS = {"layer": 2.0, "0": 1.0, "130": 1.0}  # weights; an angle sorts the centres along that direction


class Symmetric:
    """Raw parameters of first-quadrant Gaussians (m, 5) x, y, ln sigma (2), opacity <-> slots (n,
    5).
    """

    def __init__(self, counts: list[tuple[int, int, int]]) -> None:
        parameter, signs, longest, self.first, self.quadrant = [], [], [], [0], [0]
        m = 0
        few = 1 + 2 * counts[0][0] + 2 * counts[0][1] + 4 * counts[0][2] < FEW
        for long, short, fours in counts:
            for kind, number in (("c", 1), ("x", long), ("y", short), ("q", fours)):
                for _ in range(number):
                    xs = (1, -1) if kind in "xq" else (0,)
                    ys = (1, -1) if kind in "yq" else (0,)
                    signs += [(sx, sy) for sy in ys for sx in xs]
                    parameter += [m] * (len(xs) * len(ys))
                    longest.append(LONGEST_OF_FEW if few else LONGEST[kind])
                    m += 1
            self.first.append(len(parameter))
            self.quadrant.append(m)
        self.parameter, self.m = np.array(parameter), m
        self.signs, self.longest = np.array(signs, float), np.array(longest)

    def slots(self, raw: np.ndarray) -> np.ndarray:
        t = raw[self.parameter]
        return np.column_stack([t[:, :2] * self.signs, np.exp(t[:, 2:4]), t[:, 4]])

    def gradient(self, slots: np.ndarray, g: np.ndarray) -> np.ndarray:
        full = np.column_stack([g[:, :2] * self.signs, g[:, 2:4] * slots[:, 2:4], g[:, 4]])
        return np.column_stack([np.bincount(self.parameter, column, self.m) for column in full.T])


def minimise(
    function, raw: np.ndarray, thinnest: np.ndarray, longest: np.ndarray, iterations: int
) -> tuple[np.ndarray, float]:
    """L-BFGS-B within bounds; thinnest (m, 2) and longest (m,) are the minimum and maximum sigmas."""
    low = np.column_stack([np.zeros((len(raw), 2)), np.log(thinnest), np.full(len(raw), 0.02)])
    reach, one = np.log(longest), np.ones(len(raw))
    high = np.column_stack([1.3 * one, 1.3 * one, reach, reach, one])
    bounds = list(zip(low.ravel(), high.ravel(), strict=True))
    options = {"maxiter": iterations, "maxcor": 20, "ftol": 1e-8}
    found = minimize(function, np.clip(raw, low, high).ravel(), jac=True, bounds=bounds, options=options)
    return found.x.reshape(raw.shape), float(found.fun)


# ---- stage 1: a single rectangle


def coverage_loss(
    slots: np.ndarray, x: np.ndarray, y: np.ndarray, inside: np.ndarray
) -> tuple[float, np.ndarray]:
    """Mean square error of coverage on a grid of one quadrant, and its gradient (n, 5)."""
    px, py, sx, sy, opacity = slots.T[:, :, None]
    ux, uy = (x - px) / sx, (y - py) / sy
    alpha = opacity[:, :, None] * np.exp(-0.5 * ux * ux)[:, :, None] * np.exp(-0.5 * uy * uy)[:, None, :]
    live = alpha >= CUT
    alpha = np.minimum(alpha * live, 1 - 1e-6)
    left = np.exp(np.log1p(-alpha).sum(0))
    off = 1 - left - inside
    g = 2 * off * left / inside.sum() / (1 - alpha) * live  # with respect to alpha
    q = g * alpha
    by_x, by_y = q.sum(2), q.sum(1)
    gradient = [by_x * ux / sx, by_y * uy / sy, by_x * ux * ux / sx, by_y * uy * uy / sy]
    columns = [column.sum(1) for column in gradient] + [q.sum((1, 2)) / opacity[:, 0]]
    return float((off * off).sum() / inside.sum()), np.column_stack(columns)


def fit_single(aspect: float, counts: tuple[int, int, int], starts: int) -> np.ndarray:
    """Raw parameters (m, 5) of the best of several random starts for a rectangle of an aspect ratio."""
    model = Symmetric([counts])
    thinnest = np.tile([THINNEST / aspect, THINNEST], (model.m, 1))

    def search(raw: np.ndarray, per_unit: int, iterations: int) -> tuple[np.ndarray, float]:
        x = (np.arange(int((aspect + 0.3) * per_unit)) + 0.5) / per_unit / aspect
        y = (np.arange(int(1.3 * per_unit)) + 0.5) / per_unit
        inside = np.outer(x < 1, y < 1).astype(float)

        def function(v: np.ndarray):
            slots = model.slots(v.reshape(-1, 5))
            error, g = coverage_loss(slots, x, y, inside)
            return error, model.gradient(slots, g).ravel()

        return minimise(function, raw, thinnest, model.longest, iterations)

    found = []
    for seed in range(starts):
        rng = np.random.default_rng(seed)
        near = 2.0 ** -rng.uniform(0.3, 4.0, model.m)  # distance to the edge
        long = rng.uniform(0.3, 0.6, model.m)
        on = np.concatenate([np.zeros(1), np.repeat([1, 2, 3], counts)])
        x = np.where((on == 1) | (on == 3), 1 - near, 0.0)
        y = np.where((on == 2) | (on == 3), 1 - near, 0.0)
        sx, sy = np.where(on == 2, long, 0.6 * near), np.where(on == 1, long, 0.6 * near)
        sx[0] = sy[0] = 0.35
        raw = np.column_stack([x, y, np.log(sx), np.log(sy), np.full(model.m, 0.97)])
        found.append(search(raw, 30 if aspect < 3 else 18, 250))
    best = min(found, key=lambda pair: pair[1])[0]
    return search(best, 60 if aspect < 3 else 30, 500)[0]


# ---- stage 2: real markers


@dataclass
class Layout:
    """Sampled window of a marker; `loss` compares its splats with the ideal texture."""

    grid: np.ndarray
    model: Symmetric
    per_module: float
    seed: int
    margin: float = 2.0
    orders: list = field(default_factory=list)

    def __post_init__(self) -> None:
        boxes = partition(self.grid)
        grown = grow(self.grid, boxes, GROWTH)
        w, h = boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]
        limits = [limit for limit, _ in CLASSES]
        pieces, aspect, source = split_rectangles(grown, w / h, limits[-1])
        kind = np.searchsorted(limits, np.maximum(aspect, 1 / aspect) - 1e-9)
        first = np.array(self.model.first)
        n = np.diff(first)[kind]
        owner = np.repeat(np.arange(len(pieces)), n)
        self.slot = np.arange(len(owner)) + np.repeat(first[kind] - (np.cumsum(n) - n), n)
        self.upright = (aspect < 1)[owner]
        self.center = ((pieces[:, :2] + pieces[:, 2:]) / 2)[owner]
        self.half = ((pieces[:, 2:] - pieces[:, :2]) / 2)[owner]
        self.light = 1.0 - self.grid[boxes[:, 1], boxes[:, 0]][source[owner]]

        rng = np.random.default_rng(self.seed)
        rows, columns = (int((edge + 2 * self.margin) * self.per_module) for edge in self.grid.shape)
        self.x = (np.arange(columns) + rng.random(columns)) / self.per_module - self.margin
        self.y = (np.arange(rows) + rng.random(rows)) / self.per_module - self.margin
        gx, gy = np.floor(self.x).astype(int), np.floor(self.y).astype(int)
        h, w = self.grid.shape
        ideal = np.full((rows, columns), np.nan)  # outside: the background
        inside = np.ix_((gy >= 0) & (gy < h), (gx >= 0) & (gx < w))
        ideal[inside] = 1.0 - self.grid[np.ix_(gy[(gy >= 0) & (gy < h)], gx[(gx >= 0) & (gx < w)])]
        self.ideal = ideal.ravel()

    def _placed(self, slots: np.ndarray) -> np.ndarray:
        t = slots[self.slot]
        t = np.where(self.upright[:, None], t[:, [1, 0, 3, 2, 4]], t)
        return np.column_stack([self.center + self.half * t[:, :2], self.half * t[:, 2:4], t[:, 4]])

    def freeze(self, slots: np.ndarray) -> None:
        """Compute the pairs of splats and samples, and the orders, for one round, with a margin for larger
        splats."""
        x, y, sx, sy, opacity = self._placed(slots).T
        reach = 1.3 * np.sqrt(2 * np.log(np.maximum(opacity, 1.01 * CUT) / CUT))
        x0, x1 = np.searchsorted(self.x, x - reach * sx), np.searchsorted(self.x, x + reach * sx)
        y0, y1 = np.searchsorted(self.y, y - reach * sy), np.searchsorted(self.y, y + reach * sy)
        width, n = x1 - x0, (x1 - x0) * (y1 - y0)
        k = np.repeat(np.arange(len(n)), n)
        offset = np.arange(len(k)) - np.repeat(np.cumsum(n) - n, n)
        ix, iy = x0[k] + offset % width[k], y0[k] + offset // width[k]
        keep = ((self.x[ix] - x[k]) / sx[k]) ** 2 + ((self.y[iy] - y[k]) / sy[k]) ** 2 < reach[k] ** 2
        self.k, ix, iy = k[keep], ix[keep], iy[keep]
        self.ex, self.ey, sample = self.x[ix], self.y[iy], iy * len(self.x) + ix
        self.orders = []
        for name, weight in ORDERS.items():
            rank = np.arange(len(x))
            if name != "layer":
                angle = np.deg2rad(float(name))
                rank[np.argsort(x * np.cos(angle) + y * np.sin(angle), kind="stable")] = np.arange(len(x))
            by = np.argsort(sample * len(x) + rank[self.k])
            start = np.flatnonzero(np.diff(sample[by], prepend=-1))
            self.orders.append((name == "layer", weight / sum(ORDERS.values()), by, start, sample[by][start]))

    def loss(self, slots: np.ndarray) -> tuple[float, np.ndarray]:
        """Mean square error over orders and backgrounds, and its gradient in the slots (n, 5)."""
        placed, k = self._placed(slots), self.k
        x, y, sx, sy, opacity = placed[k].T
        ux, uy = (self.ex - x) / sx, (self.ey - y) / sy
        shape = np.exp(-0.5 * (ux * ux + uy * uy))
        live = opacity * shape >= CUT
        alpha = np.minimum(opacity * shape, 1 - 1e-6) * live
        error, g = 0.0, np.zeros(len(k))
        for layer, weight, by, start, sample in self.orders:
            blend = _layered if layer else _ordered
            e, ge = blend(alpha[by], self.light[k[by]], start, self.ideal, sample)
            error += weight * e
            g[by] += weight * ge
        g *= live
        q = g * alpha
        columns = [q * ux / sx, q * uy / sy, q * ux * ux / sx, q * uy * uy / sy, g * shape]
        per = np.column_stack([np.bincount(k, column, len(placed)) for column in columns])
        per[:, :2] *= self.half
        per[:, 2:4] *= self.half
        per = np.where(self.upright[:, None], per[:, [1, 0, 3, 2, 4]], per)
        return error, np.column_stack([np.bincount(self.slot, c, len(slots)) for c in per.T])


def _off(value: np.ndarray, left: np.ndarray, ideal: np.ndarray, sample: np.ndarray):
    """Errors for each background: yields background, its mean square error, and the errors at covered
    samples."""
    for background in BACKGROUNDS:
        image = np.full(len(ideal), background)
        image[sample] = value + left * background
        off = image - np.where(np.isnan(ideal), background, ideal)
        yield background, float(np.mean(off * off)) / len(BACKGROUNDS), off[sample]


def _layered(alpha, light, start, ideal, sample) -> tuple[float, np.ndarray]:
    """Compositing of coplanar splats as one layer (kernels/opencl/part/coplanar_layers.cl): error, gradient
    by alpha."""
    tau = -np.log1p(-alpha)
    n = np.diff(start, append=len(alpha))
    depth, shone = np.add.reduceat(tau, start), np.add.reduceat(tau * light, start)
    left = np.exp(-depth)
    mean = shone / np.maximum(depth, 1e-9)
    per_depth = (1 - left) / np.maximum(depth, 1e-9)
    error, g = 0.0, 0.0
    for background, e, off in _off((1 - left) * mean, left, ideal, sample):
        error += e
        own = off * per_depth
        g = g + np.repeat(own, n) * light + np.repeat(left * off * (mean - background) - own * mean, n)
    return error, g * 2 / len(ideal) / len(BACKGROUNDS) / (1 - alpha)


def _ordered(alpha, light, start, ideal, sample) -> tuple[float, np.ndarray]:
    """Front-to-back compositing in the given order: error, gradient by alpha."""
    n = np.diff(start, append=len(alpha))
    log_left = np.log1p(-alpha)
    total = np.cumsum(log_left)
    before = np.exp(total - log_left - np.repeat((total - log_left)[start], n))
    shone = np.cumsum(alpha * before * light)
    stop = np.append(start[1:], len(alpha)) - 1
    left = before[stop] * (1 - alpha[stop])
    value = np.diff(shone[stop], prepend=0.0)
    behind = np.repeat(shone[stop], n) - shone
    error, g = 0.0, 0.0
    for background, e, off in _off(value, left, ideal, sample):
        error += e
        g = g + np.repeat(off, n) * (
            before * light - (behind + np.repeat(background * left, n)) / (1 - alpha)
        )
    return error, g * 2 / len(ideal) / len(BACKGROUNDS)


def training_grids() -> list[tuple[np.ndarray, float]]:
    """Grids and samples per module, different from those of benchmarks/marker_quality.py."""

    def code(length: int, seed: int) -> np.ndarray:
        text = "".join(random.Random(seed).choices(string.ascii_letters + string.digits, k=length))
        return marker(f"qr-L:{text}").grid

    tags = [(marker(f"apriltag:36h11:{i}").grid, 14.0) for i in (101, 407)]
    return [*tags, (code(20, 901)[:20, :20], 12.0), (code(100, 902)[14:30, 14:30], 12.0)]


def fit_together(raw: np.ndarray, model: Symmetric, rounds: int) -> tuple[np.ndarray, float]:
    """Raw parameters of all classes after stage 2, and their PSNR in dB."""
    aspects = np.repeat([aspect for _, aspect in CLASSES], np.diff(model.quadrant))
    thinnest = np.column_stack([THINNEST / aspects, np.full(len(aspects), THINNEST)])
    layouts = [Layout(grid, model, per, seed) for seed, (grid, per) in enumerate(training_grids())]

    def function(v: np.ndarray):
        slots = model.slots(v.reshape(-1, 5))
        parts = [layout.loss(slots) for layout in layouts]
        # scaled, since the stopping rule of L-BFGS-B would mistake a small error for convergence
        scale = 100 / len(layouts)
        g = model.gradient(slots, sum(part[1] for part in parts))
        return scale * sum(part[0] for part in parts), scale * g.ravel()

    reached = 0.0
    for number in range(rounds):
        for layout in layouts:
            layout.freeze(model.slots(raw))
        raw, error = minimise(function, raw, thinnest, model.longest, 15)
        reached = float(-10 * np.log10(error / 100))
        print(f"round {number + 1}: {reached:.3f} dB", flush=True)
    return raw, reached


def fit(size: int, starts: int, rounds: int) -> dict:
    """Fit the templates of a size, in the layout of the file."""
    model = Symmetric(list(COUNTS[size]))
    raw = np.concatenate(
        [
            fit_single(aspect, counts, starts)
            for (_, aspect), counts in zip(CLASSES, COUNTS[size], strict=True)
        ]
    )
    print(f"size {size}: stage 1 done", flush=True)
    raw, reached = fit_together(raw, model, rounds)
    templates = []
    for (limit, _), a, b in zip(CLASSES, model.quadrant[:-1], model.quadrant[1:], strict=True):
        slots = np.column_stack([raw[a:b, :2], np.exp(raw[a:b, 2:4]), raw[a:b, 4]])
        signs = [np.abs(model.signs[model.parameter == i][0]) for i in range(a, b)]
        # mirrored Gaussians must not be on the mirror axis
        slots[:, :2] = np.maximum(slots[:, :2], 1e-4) * signs
        templates.append({"max_aspect": limit, "quadrant": np.round(slots, 4).tolist()})
    return {"size": size, "fit_db": round(reached, 2), "templates": templates}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    default = Path(__file__).resolve().parents[1] / "fidsplat" / "markers" / "templates.json"
    parser.add_argument("-o", "--out", type=Path, default=default)
    parser.add_argument("--sizes", type=int, nargs="+", choices=COUNTS, default=list(COUNTS))
    parser.add_argument("--starts", type=int, default=24, help="random starts per class in stage 1")
    parser.add_argument("--rounds", type=int, default=12, help="rounds of 15 iterations in stage 2")
    options = parser.parse_args()

    start = time.perf_counter()
    known = json.loads(options.out.read_text("utf-8"))["sets"] if options.out.exists() else []
    sets = {entry["size"]: entry for entry in known}
    sets |= {size: fit(size, options.starts, options.rounds) for size in options.sizes}
    about = (
        "made by tools/fit_templates.py; rows: x, y, sigma_x, sigma_y, opacity in half sizes, long side "
        "first; fit_db: against the ideal texture of the markers that it was fitted on"
    )
    text = json.dumps({"about": about, "growth": GROWTH, "sets": [sets[size] for size in sorted(sets)]})
    text = (
        text.replace(' {"size', '\n {"size')
        .replace('[{"size', '[\n {"size')
        .replace(' {"max', '\n  {"max')
        .replace('[{"max', '[\n  {"max')
        .replace("[[", "[\n    [")
        .replace("], [", "],\n    [")
    )
    with atomic_write(options.out) as stream:
        stream.write((text + "\n").encode())
    print(f"wrote {options.out} after {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
