"""Tag placement by the Fisher information about a trajectory: greedy selection and local search.

The objective is the log determinant of the information about all poses of a trajectory, relative to odometry
alone. It is monotone and submodular (Krause et al. 2008), so the greedy selection reaches at least 1 - 1/e of
the optimum (Nemhauser et al. 1978).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from fidsplat.util import interrupts

PASSES = 5
"""largest number of passes of the local search"""
TILT = 0.005, 0.003
"""standard deviations of roll and pitch [rad] and of the height [m] of a camera on a floor"""
_MORE = 1e-9
"""smallest relative improvement of the objective"""


@dataclass(frozen=True, eq=False)
class Sightings:
    """Sightings of one tag from the poses of a trajectory."""

    poses: np.ndarray
    """(k,) indices of the poses"""
    information: np.ndarray
    """(k, 6, 6) Fisher information about each pose"""

    @cached_property
    def rows(self) -> np.ndarray:
        """Rows (6 k,) of the poses in the covariance of the trajectory."""
        return (6 * self.poses[:, None] + np.arange(6)).ravel()

    @cached_property
    def roots(self) -> np.ndarray:
        """(k, 6, 6) L with L L^T the information."""
        values, vectors = np.linalg.eigh(self.information)
        return vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]


Objective: TypeAlias = Callable[[np.ndarray, Sightings], float]
"""increase of an objective by a tag, for the covariance of a trajectory"""


@dataclass(frozen=True)
class Selection:
    """Selected candidates."""

    chosen: tuple[int, ...]
    """indices, in the order of the selection"""
    value: float
    """objective: nats, or square metres"""
    bound: float
    """upper bound of the objective of any selection of the same number, for candidates without conflicts"""


def odometry_covariance(
    poses: np.ndarray,
    metres: float,
    radians: float,
    start: tuple[float, float] = (0.01, 0.01),
    up: np.ndarray | None = None,
) -> np.ndarray:
    """Covariance (6 p, 6 p) of camera-to-world poses (p, 4, 4) from odometry, in the cameras' own axes.

    Args:
        metres, radians: standard deviations of each axis after one metre, or one radian of rotation.
        start: standard deviations of the first pose.
        up: (3,) vertical, for a camera that moves on a floor without errors of height, roll and pitch; None:
            free motion.
    """
    count = len(poses)
    out = np.zeros((6 * count, 6 * count))
    out[:6, :6] = _drift(poses[0], start, up)
    for k in range(1, count):
        step = np.linalg.solve(poses[k - 1], poses[k])
        rotation, shift = step[:3, :3].T, step[:3, 3]
        moved = np.zeros((6, 6))  # adjoint of the inverse step
        moved[:3, :3] = moved[3:, 3:] = rotation
        moved[:3, 3:] = -rotation @ _cross(shift)
        angle = np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))
        weight = float(np.linalg.norm(shift) + angle) + 1e-6
        row, before = slice(6 * k, 6 * k + 6), slice(0, 6 * k)
        out[row, before] = moved @ out[6 * k - 6 : 6 * k, before]
        out[before, row] = out[row, before].T
        added = weight * _drift(poses[k], (metres, radians), up)
        out[row, row] = moved @ out[6 * k - 6 : 6 * k, 6 * k - 6 : 6 * k] @ moved.T + added
    return out


def planar_information(information: np.ndarray, poses: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Information (k, 6, 6) about cameras on a floor, whose height, roll and pitch have errors of `TILT` that
    are independent in each image.

    Args:
        poses: (k, 4, 4) camera-to-world.
        up: (3,) vertical of the floor.
    """
    vertical = poses[:, :3, :3].transpose(0, 2, 1) @ (up / np.linalg.norm(up))
    others = np.zeros((len(poses), 6, 4))
    others[:, :3, 0] = TILT[1] * vertical
    others[:, 3:, 1:] = TILT[0] * (np.eye(3) - vertical[:, :, None] * vertical[:, None, :])
    coupling = information @ others
    inner = np.eye(4) + others.transpose(0, 2, 1) @ coupling
    return information - coupling @ np.linalg.solve(inner, coupling.transpose(0, 2, 1))


def _drift(pose: np.ndarray, deviations: Sequence[float], up: np.ndarray | None) -> np.ndarray:
    """Covariance (6, 6) of an error of translation and rotation in the camera's axes."""
    out = np.zeros((6, 6))
    level = rotation = np.eye(3)
    if up is not None:
        vertical = pose[:3, :3].T @ (up / np.linalg.norm(up))
        rotation = np.outer(vertical, vertical)
        level = np.eye(3) - rotation
    out[:3, :3], out[3:, 3:] = deviations[0] ** 2 * level, deviations[1] ** 2 * rotation
    return out


def position_error(covariance: np.ndarray) -> float:
    """Root mean square of the positions' errors in metres, over all poses of a covariance (6 p, 6 p)."""
    return float(np.sqrt(np.diag(covariance).reshape(-1, 6)[:, :3].sum(1).mean()))


def gain(covariance: np.ndarray, sightings: Sightings) -> float:
    """Increase of the log determinant of the information by a tag, in nats."""
    return float(np.linalg.slogdet(_spread(covariance, sightings))[1])


def error_gain(covariance: np.ndarray, sightings: Sightings) -> float:
    """Decrease of the mean variance of the positions by a tag, in square metres. It is not submodular."""
    k = len(sightings.poses)
    if not k:
        return 0.0
    positions = covariance[:, sightings.rows].reshape(-1, 6, k, 6)[:, :3].reshape(-1, k, 6)
    projected = np.einsum("nka,kai->nki", positions, sightings.roots).reshape(-1, 6 * k)
    return float(
        (projected * np.linalg.solve(_spread(covariance, sightings), projected.T).T).sum()
        / (len(projected) / 3)
    )


def updated(covariance: np.ndarray, sightings: Sightings, sign: float = 1.0) -> np.ndarray:
    """The covariance of the trajectory with the sightings of a tag, or without them by sign -1."""
    k = len(sightings.poses)
    if not k:
        return covariance
    columns = covariance[:, sightings.rows].reshape(-1, k, 6)
    projected = np.einsum("nka,kai->nki", columns, sightings.roots).reshape(-1, 6 * k)
    result = covariance - sign * projected @ np.linalg.solve(
        _spread(covariance, sightings, sign), projected.T
    )
    return (result + result.T) / 2


def greedy(
    covariance: np.ndarray,
    candidates: Sequence[Sightings],
    count: int,
    conflicts: np.ndarray | None = None,
    enough: Callable[[np.ndarray], bool] = lambda covariance: False,
    objective: Objective = gain,
) -> Selection:
    """Select candidates one by one, each with the largest gain (lazy evaluation, Minoux 1978).

    Args:
        covariance: (6 p, 6 p) of the trajectory without tags.
        candidates: the sightings of each candidate.
        count: largest number of selected candidates.
        conflicts: (n, n) bool, pairs that exclude each other, such as tags that overlap.
        enough: called with the covariance; the selection ends when it returns True.
        objective: `gain`, or `error_gain`, which has no bound.
    """
    limits = np.array([objective(covariance, candidate) for candidate in candidates])
    free = limits > 0
    chosen: list[int] = []
    value = 0.0
    while len(chosen) < count and free.any() and not enough(covariance):
        interrupts.check()
        best, best_gain = -1, 0.0
        for k in np.argsort(-np.where(free, limits, -np.inf), kind="stable"):
            if not free[k] or (objective is gain and limits[k] <= best_gain):
                break
            limits[k] = objective(covariance, candidates[k])
            if limits[k] > best_gain:
                best, best_gain = int(k), float(limits[k])
        if best < 0:
            break
        chosen.append(best)
        value += best_gain
        covariance = updated(covariance, candidates[best])
        free[best] = False
        if conflicts is not None:
            free &= ~conflicts[best]
    return Selection(tuple(chosen), value, _bound(covariance, candidates, chosen, value, objective))


def local_search(
    covariance: np.ndarray,
    candidates: Sequence[Sightings],
    selection: Selection,
    conflicts: np.ndarray | None = None,
    objective: Objective = gain,
) -> Selection:
    """Exchange one selected candidate at a time for a better one, until no exchange improves the
    objective."""
    chosen = list(selection.chosen)
    value, after = _with(covariance, candidates, chosen, objective)
    limits = np.array([objective(covariance, candidate) for candidate in candidates])
    order = np.argsort(-limits, kind="stable")
    for _ in range(PASSES):
        before = value
        for place in range(len(chosen)):
            interrupts.check()
            others = chosen[:place] + chosen[place + 1 :]
            without = updated(after, candidates[chosen[place]], -1.0)
            best, best_gain = chosen[place], objective(without, candidates[chosen[place]]) * (1 + _MORE)
            for k in order:
                if objective is gain and limits[k] <= best_gain:
                    break
                if k in chosen or (conflicts is not None and conflicts[k, others].any()):
                    continue
                candidate_gain = objective(without, candidates[k])
                if candidate_gain > best_gain:
                    best, best_gain = int(k), candidate_gain
            if best == chosen[place]:
                continue
            # computed again, as downdates lose digits after precise tags
            tried = [*chosen[:place], best, *chosen[place + 1 :]]
            exact, moved = _with(covariance, candidates, tried, objective)
            if exact > value:
                chosen, value, after = tried, exact, moved
        if value <= before * (1 + _MORE):
            break
    bound = min(selection.bound, _bound(after, candidates, chosen, value, objective))
    return Selection(tuple(chosen), value, bound)


def _with(
    covariance: np.ndarray, candidates: Sequence[Sightings], chosen: Sequence[int], objective: Objective
) -> tuple[float, np.ndarray]:
    """The objective of selected candidates, and the covariance with them."""
    value = 0.0
    for k in chosen:
        value += objective(covariance, candidates[k])
        covariance = updated(covariance, candidates[k])
    return value, covariance


def _bound(
    covariance: np.ndarray,
    candidates: Sequence[Sightings],
    chosen: list[int],
    value: float,
    objective: Objective,
) -> float:
    """Upper bound of the objective over all selections of the same size, from the gains after the selection.

    It is infinite for an objective that is not submodular.
    """
    if objective is not gain:
        return math.inf
    return value + sum(
        sorted((gain(covariance, candidate) for candidate in candidates), reverse=True)[: len(chosen)]
    )


def _spread(covariance: np.ndarray, sightings: Sightings, sign: float = 1.0) -> np.ndarray:
    """I + L^T S L (6 k, 6 k), S being the covariance of the poses of the sightings."""
    k, rows, roots = len(sightings.poses), sightings.rows, sightings.roots
    block = covariance[np.ix_(rows, rows)].reshape(k, 6, k, 6)
    half = np.einsum("kai,kalb->kilb", roots, block)
    return np.eye(6 * k) + sign * np.einsum("kilb,lbj->kilj", half, roots).reshape(6 * k, 6 * k)


def _cross(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
