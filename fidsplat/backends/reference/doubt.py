"""What single precision may change: the certificates that go with the reference's planes.

A device evaluates the affine forms n_u, n_v, D of a pixel in float32, about the pixel nearest to the splat's
centre. Interval arithmetic over their rounding gives for each fragment the least and the greatest opacity
that it may be drawn with: far apart where a decision lies on its threshold (a rim, the near plane, the
horizon) or where the splat is thinner than the rounding of its distance (needles, grazing disks). A pixel's
certificate adds up what that can change in it, to first order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fidsplat.backends.base import View
from fidsplat.backends.reference.fragments import Fragments, optical_depth, runs, shifted
from fidsplat.backends.reference.setup import Setup

_ROUND = 4 * 2.0**-24  # of a form, relative to its terms: its coefficients' rounding, and its sums'
_WEIGHT = 2 * _ROUND  # relative, of half rho and of an opacity: a division, two products, exp
_STOP = 5e-5  # relative, of a transmittance at a threshold


@dataclass
class Span:
    """Between which values fragments (k, n) may lie."""

    low: np.ndarray
    """opacity"""
    high: np.ndarray
    z_low: np.ndarray
    """metres"""
    z_high: np.ndarray
    front_low: np.ndarray
    """transmittance in front of the fragment"""
    front_high: np.ndarray

    @property
    def undecided(self) -> np.ndarray:
        """Whether a fragment may be drawn or not."""
        return (self.low <= 0) & (self.high > 0)


def span_of(s: Setup, view: View, f: Fragments) -> Span:
    """The span of fragments whose forms are computed in float32."""
    e_u, e_v, e_d = (
        _ROUND * (np.abs(form) + f.dx * np.abs(s.forms[1, :, c]) + f.dy * np.abs(s.forms[2, :, c]))
        for c, form in enumerate((f.n_u, f.n_v, f.d))
    )
    d_low, d_high = f.d - e_d, f.d + e_d
    q_low = np.maximum(np.abs(f.n_u) - e_u, 0) ** 2 + np.maximum(np.abs(f.n_v) - e_v, 0) ** 2
    q_high = (np.abs(f.n_u) + e_u) ** 2 + (np.abs(f.n_v) + e_v) ** 2
    slack = _ROUND * (np.abs(s.log_opacity) + s.half_r2)  # the squared radius is a difference of float32
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        may = (d_high > 0) & (d_low * view.near <= s.z_numerator * (1 + _ROUND))
        must = (d_low > 0) & (d_high * view.near <= s.z_numerator * (1 - _ROUND))
        nearest, furthest = q_low / (2 * d_high**2), q_high / (2 * d_low**2)
        nearest = np.where(may & (nearest <= s.half_r2 + slack), nearest, np.inf)
        furthest = np.where(must & (furthest <= s.half_r2 - slack), furthest, np.inf)
        z_low = np.where(d_high > 0, s.z_numerator / d_high, np.inf)
        z_high = np.where(d_low > 0, s.z_numerator / d_low, np.inf)
    if s.screen:
        away, off = np.sqrt(f.offset), _ROUND * (1 + f.dx + f.dy)
        dot_low, dot_high = np.maximum(away - off, 0) ** 2, (away + off) ** 2
        nearest = np.minimum(nearest, np.where(dot_low <= s.half_r2 + slack, dot_low, np.inf))
        furthest = np.minimum(furthest, np.where(dot_high <= s.half_r2 - slack, dot_high, np.inf))
    low = np.exp(s.log_opacity - furthest * (1 + _WEIGHT)) * (1 - _WEIGHT)
    high = np.exp(s.log_opacity - nearest * (1 - _WEIGHT)) * (1 + _WEIGHT)
    low, high = np.minimum(low, view.ceiling), np.minimum(high, view.ceiling)
    # no ray to the plane: the centre's depth
    z_low = np.where(d_low > 0, np.clip(z_low, s.pz - s.reach, s.pz + s.reach), s.pz - s.reach)
    z_high = np.clip(z_high, s.pz - s.reach, s.pz + s.reach)
    missed = d_high <= 0
    z_low, z_high = np.where(missed, s.pz, z_low), np.where(missed, s.pz, z_high)
    fronts = shifted(np.cumprod(1 - high, axis=1)), shifted(np.cumprod(1 - low, axis=1))
    return Span(low, high, z_low, z_high, *fronts)


def of_color(s: Setup, view: View, span: Span, before: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """What may change (k,) in colour and alpha, per unit of colour."""
    doubt = (before * (span.high - span.low)).sum(1)
    t_low = span.front_low * (1 - span.high) * (1 - _STOP)
    t_high = span.front_high * (1 - span.low) * (1 + _STOP)
    may_stop = (span.high > 0) & (t_low <= view.stop) & (t_high >= view.stop)
    # an exclusive stop drops a fragment, an inclusive one only what follows
    lost = span.front_high * span.high if s.exclusive else np.full_like(before, view.stop)
    doubt += np.where(may_stop, lost, 0.0).max(1, initial=0.0)
    if s.planes is not None:
        doubt += _of_layers(span, s.planes) + _of_cuts(span, s.planes, weight)
    return doubt


def _of_layers(span: Span, planes: np.ndarray) -> np.ndarray:
    """What may change (k,) where splats of a plane share a layer's colour by their optical depths."""
    run = runs(span.high > 0, planes)
    row, column = np.nonzero(run >= 0)
    number = run[row, column]
    count = int(run.max(initial=-1)) + 1
    # 1 - opacity is rounded too
    thin = optical_depth(span.low[row, column] - 2.0**-23)
    thick = optical_depth(span.high[row, column] + 2.0**-23)
    least = np.bincount(number, thin, count)[number]
    others = np.bincount(number, thick, count)[number] - thick
    front = np.zeros(count)
    np.maximum.at(front, number, span.front_high[row, column])
    # slope of the layer's colour over one splat's depth, at most: by the light left and the others' share
    slope = np.exp(-least) + np.minimum(1.0, others / np.maximum(least, 1e-9)) / np.maximum(least, 1.0)
    moved = front[number] * np.minimum(1.0, slope * (thick - thin))
    several = np.bincount(number, minlength=count)[number] > 1
    return np.bincount(row, np.where(several, moved, 0.0), len(run))


def _of_cuts(span: Span, planes: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """What may change (k,) where a fragment of something else may or may not cut a run in two."""
    doubt = np.zeros(len(weight))
    rows = np.flatnonzero(span.undecided.any(1))
    undecided, drawn = span.undecided[rows], span.low[rows] > 0
    count = len(planes)
    places = np.arange(count)
    before = np.maximum.accumulate(np.where(drawn, places, -1), axis=1)
    behind = np.minimum.accumulate(np.where(drawn, places, count)[:, ::-1], axis=1)[:, ::-1]
    inner = undecided & (before >= 0) & (behind < count)
    around = np.where(inner, planes[np.clip(before, 0, None)], -1)
    same = around == planes[np.clip(behind, None, count - 1)]
    cuts = (inner & same & (around >= 0) & (planes != around)).any(1)
    doubt[rows] = np.where(cuts, np.where(planes >= 0, weight[rows], 0.0).sum(1), 0.0)
    return doubt


def of_depth(span: Span, weight: np.ndarray, z: np.ndarray) -> dict[str, np.ndarray]:
    """Nearest and furthest depth (k,) that may be seen; sum of weights times what each may move."""
    seen = span.front_high * span.high > 0
    return {
        "nearest": np.where(seen, span.z_low, np.inf).min(1, initial=np.inf),
        "furthest": np.where(seen, span.z_high, -np.inf).max(1, initial=-np.inf),
        "depth_moved": (weight * np.maximum(span.z_high - z, z - span.z_low)).sum(1),
    }


def of_median(span: Span) -> np.ndarray:
    """Whether another fragment (k,) may be the last with half of the light in front of it."""
    may = (span.high > 0) & (span.front_high > 0.5 * (1 - _STOP))
    sure = (span.low > 0) & (span.front_low > 0.5 * (1 + _STOP))
    return np.asarray((may & ~sure).any(1))


def of_label(span: Span, labels: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Whether a fragment of another label (k,), or none at all, may be the heaviest."""
    own = labels == label[:, None]
    heaviest = np.where(own, span.front_low * span.low, 0.0).max(1, initial=0.0)
    other = np.where(own, 0.0, span.front_high * span.high).max(1, initial=0.0)
    return ((other > 0) | (label >= 0)) & (other * (1 + _STOP) >= heaviest)
