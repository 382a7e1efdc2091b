"""Selection of places for tags by the information about a trajectory: greedy selection and local search.

The objective is the log determinant of the information about all poses of a trajectory, relative to odometry
alone. It is monotone and submodular (Krause et al. 2008), so the greedy selection reaches at least 1 - 1/e of
the optimum (Nemhauser et al. 1978).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fidsplat.util import interrupts

PASSES = 5
"""largest number of passes of the local search"""
_MORE = 1e-9
"""smallest improvement of the objective"""


class Sightings(NamedTuple):
    """Images of one tag along a trajectory."""

    poses: np.ndarray
    """(k,) indices of the poses"""
    information: np.ndarray
    """(k, 6, 6) Fisher information about each pose"""

    @property
    def rows(self) -> np.ndarray:
        """Rows (6 k,) of the poses in the covariance of the trajectory."""
        return (6 * self.poses[:, None] + np.arange(6)).ravel()

    @property
    def roots(self) -> np.ndarray:
        """(k, 6, 6) L with L L^T the information."""
        values, vectors = np.linalg.eigh(self.information)
        return vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]


@dataclass(frozen=True)
class Selection:
    """Selected candidates."""

    chosen: tuple[int, ...]
    """indices, in the order of the selection"""
    value: float
    """objective in nats"""
    bound: float
    """upper bound of the objective of any selection of the same number, for candidates without conflicts"""


def odometry_covariance(
    poses: np.ndarray, metres: float, radians: float, start: tuple[float, float] = (0.01, 0.01)
) -> np.ndarray:
    """Covariance (6 p, 6 p) of camera-to-world poses (p, 4, 4) from odometry, in the cameras' own axes.

    Args:
        metres, radians: standard deviations of each axis after one metre, or one radian of rotation.
        start: those of the first pose.
    """
    count = len(poses)
    out = np.zeros((6 * count, 6 * count))
    out[:6, :6] = np.diag(np.repeat(np.square(start), 3))
    for k in range(1, count):
        step = np.linalg.solve(poses[k - 1], poses[k])
        rotation, shift = step[:3, :3].T, step[:3, 3]
        moved = np.zeros((6, 6))  # adjoint of the inverse step
        moved[:3, :3] = moved[3:, 3:] = rotation
        moved[:3, 3:] = -rotation @ _cross(shift)
        turn = np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))
        share = float(np.linalg.norm(shift) + turn) + 1e-6
        row, before = slice(6 * k, 6 * k + 6), slice(0, 6 * k)
        out[row, before] = moved @ out[6 * k - 6 : 6 * k, before]
        out[before, row] = out[row, before].T
        added = share * np.repeat(np.square((metres, radians)), 3)
        out[row, row] = moved @ out[6 * k - 6 : 6 * k, 6 * k - 6 : 6 * k] @ moved.T + np.diag(added)
    return out


def position_error(covariance: np.ndarray) -> float:
    """Root mean square of the positions' errors in metres, over all poses of a covariance (6 p, 6 p)."""
    return float(np.sqrt(np.diag(covariance).reshape(-1, 6)[:, :3].sum(1).mean()))


def gain(covariance: np.ndarray, sightings: Sightings) -> float:
    """Increase of the log determinant of the information by a tag, in nats."""
    return float(np.linalg.slogdet(_spread(covariance, sightings))[1])


def updated(covariance: np.ndarray, sightings: Sightings) -> np.ndarray:
    """The covariance of the trajectory with the sightings of a tag."""
    k = len(sightings.poses)
    if not k:
        return covariance
    columns = covariance[:, sightings.rows].reshape(-1, k, 6)
    seen = np.einsum("nka,kai->nki", columns, sightings.roots).reshape(-1, 6 * k)
    result = covariance - seen @ np.linalg.solve(_spread(covariance, sightings), seen.T)
    return (result + result.T) / 2


def greedy(
    covariance: np.ndarray,
    candidates: Sequence[Sightings],
    count: int,
    conflicts: np.ndarray | None = None,
    enough: Callable[[np.ndarray], bool] = lambda covariance: False,
) -> Selection:
    """Select candidates one by one, each with the largest gain (lazy evaluation, Minoux 1978).

    Args:
        covariance: (6 p, 6 p) of the trajectory without tags.
        candidates: the sightings of each candidate.
        count: largest number of selected candidates.
        conflicts: (n, n) bool, pairs that exclude each other, such as tags that overlap.
        enough: called with the covariance; the selection ends when it returns True.
    """
    limits = np.array([gain(covariance, one) for one in candidates])
    free = limits > _MORE
    chosen: list[int] = []
    value = 0.0
    while len(chosen) < count and free.any() and not enough(covariance):
        interrupts.check()
        best, most = -1, _MORE
        for k in np.argsort(-np.where(free, limits, -np.inf), kind="stable"):
            if not free[k] or limits[k] <= most:
                break
            limits[k] = gain(covariance, candidates[k])
            if limits[k] > most:
                best, most = int(k), float(limits[k])
        if best < 0:
            break
        chosen.append(best)
        value += most
        covariance = updated(covariance, candidates[best])
        free[best] = False
        if conflicts is not None:
            free &= ~conflicts[best]
    more = sorted((gain(covariance, one) for one in candidates), reverse=True)[: len(chosen)]
    return Selection(tuple(chosen), value, value + sum(more))


def local_search(
    covariance: np.ndarray,
    candidates: Sequence[Sightings],
    selection: Selection,
    conflicts: np.ndarray | None = None,
) -> Selection:
    """Exchange one selected candidate at a time for a better one, until no exchange improves the
    objective."""
    chosen, value = list(selection.chosen), selection.value
    limits = np.array([gain(covariance, one) for one in candidates])
    order = np.argsort(-limits, kind="stable")
    for _ in range(PASSES):
        before = value
        for place in range(len(chosen)):
            interrupts.check()
            others = chosen[:place] + chosen[place + 1 :]
            without = covariance
            for k in others:
                without = updated(without, candidates[k])
            own = gain(without, candidates[chosen[place]])
            best, most = chosen[place], own + _MORE
            for k in order:
                if limits[k] <= most:
                    break
                if k in chosen or (conflicts is not None and conflicts[k, others].any()):
                    continue
                found = gain(without, candidates[k])
                if found > most:
                    best, most = int(k), found
            if best != chosen[place]:
                chosen[place] = best
                value += most - own
        if value <= before + _MORE:
            break
    bound = min(selection.bound, _bound(covariance, candidates, chosen, value))
    return Selection(tuple(chosen), value, bound)


def _bound(covariance: np.ndarray, candidates: Sequence[Sightings], chosen: list[int], value: float) -> float:
    for k in chosen:
        covariance = updated(covariance, candidates[k])
    more = sorted((gain(covariance, one) for one in candidates), reverse=True)[: len(chosen)]
    return value + sum(more)


def _spread(covariance: np.ndarray, sightings: Sightings) -> np.ndarray:
    """I + L^T S L (6 k, 6 k), S being the covariance of the poses of the sightings."""
    k, rows, roots = len(sightings.poses), sightings.rows, sightings.roots
    own = covariance[np.ix_(rows, rows)].reshape(k, 6, k, 6)
    half = np.einsum("kai,kalb->kilb", roots, own)
    return np.eye(6 * k) + np.einsum("kilb,lbj->kilj", half, roots).reshape(6 * k, 6 * k)


def _cross(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
