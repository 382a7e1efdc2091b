"""Joint adjustment of tags of known size over all photographs: poses of the tags and scale of the model.

Levenberg-Marquardt on the reprojection errors of all corners, with Huber weights. The unknowns are the scale
and a rigid pose for each tag; the cameras are those of structure from motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.util.errors import InputError
from fidsplat.vision.pose import marker_pose

ITERATIONS = 60
HUBER = 2.5
"""residuals above this number of standard deviations have less weight"""
MIN_NOISE = 0.02
"""pixels: minimum standard deviation of a corner in the weights"""
REJECTED = 6.0
"""a detection whose error is above this number of pixels, and of medians, is of something else"""
MAX_ERROR = 0.005
"""largest error of a detection, as a fraction of the image's width"""
MAX_REJECTED = 0.3
"""largest fraction of rejected detections of a tag"""
SAME_SIZE, SIGMAS = 0.05, 5.0
"""scales of two tags contradict each other beyond this relative difference and number of standard errors"""
SIMILAR_SIZE = 0.005
"""relative difference from which a contradiction of less than SAME_SIZE is reported"""
MIN_PARALLAX = 0.02
"""minimum distance of two cameras relative to the distance of the tag"""
_SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) / 2


@dataclass(frozen=True, eq=False)
class TagView:
    """Corners of a tag in a photograph."""

    tag: str
    image: int
    """index of the camera"""
    corners: np.ndarray
    """(4, 2) pixels of the camera, TL, TR, BR, BL as printed"""


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Scale of the model and poses of the tags."""

    scale: float
    """metres for each unit of the model"""
    scale_error: float
    """relative standard error of the scale, for errors that all corners of a photograph share"""
    poses: dict[str, np.ndarray]
    """tag -> (4, 4) rigid pose in the model, in its unit"""
    rms: float
    """pixels: root mean square of the distances between corners and projections"""
    used: tuple[TagView, ...]
    rejected: tuple[TagView, ...]
    """detections far from the tag"""
    scales: dict[str, tuple[float, float]]
    """tag -> scale and relative standard error from this tag alone, where its views determine one"""

    @property
    def disagreements(self) -> list[tuple[str, str, float]]:
        """Pairs of tags with the relative difference of their scales, where it is above SIMILAR_SIZE and
        SIGMAS standard errors."""
        return _differences(self.scales, SIMILAR_SIZE)


def adjust(cameras: Sequence[Camera], views: Sequence[TagView], sizes: Mapping[str, float]) -> Adjustment:
    """Adjust the scale and the poses of tags to their corners in all photographs.

    Args:
        cameras: pinhole cameras in the unit of the model.
        views: detections; at least one tag in photographs from two positions.
        sizes: edge of each tag in metres.

    Raises InputError if no tag is detected from two positions, if a tag has two positions, or if the sizes of
    two tags contradict each other.
    """
    seen = {tag: [view for view in views if view.tag == tag] for tag in sizes}
    relative = {
        tag: np.array([_tag_in_axes_of_world(cameras[view.image], view, sizes[tag]) for view in found])
        for tag, found in seen.items()
        if found
    }
    units = {
        tag: _first_unit(np.array([cameras[view.image].position for view in seen[tag]]), poses[:, :3, 3])
        for tag, poses in relative.items()
    }
    known = [value for value in units.values() if value is not None]
    if not known:
        counts = ", ".join(f"{tag} in {len(found)}" for tag, found in seen.items())
        raise InputError(
            f"a tag must be detected in photographs from at least 2 positions, got {counts}; take more sharp "
            "photographs with the complete tag, and compare its id with that of `fidsplat detect PHOTO`"
        )
    typical, used, rejected, scales, poses = float(np.median(known)), [], [], {}, {}
    for tag, unit in units.items():
        found = seen[tag]
        poses[tag] = _first_pose(_Corners(cameras, found, sizes, [tag]), tag, relative[tag], unit or typical)
        if unit is not None:
            for _ in range(2):
                good = _inliers(cameras, found, sizes, unit, poses)
                if len(found) - len(good) > MAX_REJECTED * len(found) or len(good) < 2:
                    raise InputError(
                        f"{tag} must be at one place in all photographs, got {len(found)} detections that "
                        "contradict each other; remove photographs of a second copy of the tag or in which "
                        "it was moved, and take more photographs if their cameras are wrong"
                    )
                unit, moved, error = _solve(cameras, good, sizes, unit, {tag: poses[tag]})
                poses |= moved
            good = _inliers(cameras, found, sizes, unit, poses)
            scales[tag] = (1 / unit, error)
            rejected += [view for view in found if view not in good]
            found = good
        used += found
    _check_sizes(scales, sizes)
    unit, poses, error = _solve(cameras, used, sizes, typical, poses)
    residuals = _Corners(cameras, used, sizes, list(poses)).residuals(unit, poses)
    rms = float(np.sqrt((residuals**2).sum(-1).mean()))
    return Adjustment(1 / unit, error, poses, rms, tuple(used), tuple(rejected), scales)


def _differences(scales: Mapping[str, tuple[float, float]], smallest: float) -> list[tuple[str, str, float]]:
    """Pairs of tags, and the logarithm of the ratio of their scales, above `smallest` and SIGMAS standard
    errors."""
    return [
        (tag, other, difference)
        for (tag, (a, da)), (other, (b, db)) in combinations(scales.items(), 2)
        if (difference := abs(float(np.log(a / b)))) > max(smallest, SIGMAS * float(np.hypot(da, db)))
    ]


def _check_sizes(scales: Mapping[str, tuple[float, float]], sizes: Mapping[str, float]) -> None:
    for tag, other, _ in _differences(scales, SAME_SIZE):
        raise InputError(
            f"sizes of tags must agree, got {sizes[tag]:g} m for {tag} and {sizes[other]:g} m for {other}, "
            f"which would be {sizes[other] * scales[tag][0] / scales[other][0]:.4g} m if the first is right; "
            "measure their black squares"
        )


def _tag_in_axes_of_world(camera: Camera, view: TagView, size: float) -> np.ndarray:
    """Pose (4, 4) of the tag relative to the camera's position, in metres, in the axes of the world."""
    rotation = np.eye(4)
    rotation[:3, :3] = camera.world_to_camera[:3, :3].T
    return rotation @ marker_pose(view.corners, size, camera)


def _first_unit(positions: np.ndarray, offsets: np.ndarray) -> float | None:
    """Model units per metre: the weighted median over pairs of photographs; None without a baseline.

    positions: (n, 3) of the cameras, in the unit of the model. offsets: (n, 3) to the tag, in metres.
    """
    i, j = np.triu_indices(len(positions), 1)
    between, moved = offsets[i] - offsets[j], positions[j] - positions[i]
    squares = (between**2).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = (moved * between).sum(1) / squares
    usable = (squares > (MIN_PARALLAX * np.linalg.norm(offsets[i], axis=1)) ** 2) & (ratios > 0)
    if not usable.any():
        return None
    ratios, weights = ratios[usable], np.sqrt(squares[usable])
    order = np.argsort(ratios)
    total = np.cumsum(weights[order])
    return float(ratios[order[np.searchsorted(total, total[-1] / 2)]])


def _first_pose(corners: _Corners, tag: str, relative: np.ndarray, unit: float) -> np.ndarray:
    """Initial pose of a tag: among its poses from single photographs, the one that fits all photographs best.

    relative: (n, 4, 4) poses from each camera's position in metres.
    """
    best, smallest = relative[0], np.inf
    for position, pose in zip(corners.positions, relative.copy(), strict=True):
        pose[:3, 3] = position + unit * pose[:3, 3]
        errors = np.sqrt((corners.residuals(unit, {tag: pose}) ** 2).sum(-1).mean(1))
        error = float(np.median(errors)) if np.isfinite(errors).all() else np.inf
        if error < smallest:
            best, smallest = pose, error
    return best


def _inliers(cameras, views: Sequence[TagView], sizes, unit: float, poses) -> list[TagView]:
    residuals = _Corners(cameras, views, sizes, list(poses)).residuals(unit, poses)
    errors = np.sqrt((residuals**2).sum(-1).mean(1))
    limit = REJECTED * max(1.0, float(np.median(errors)))
    return [
        view
        for view, error in zip(views, errors, strict=True)
        if error <= max(REJECTED, min(limit, MAX_ERROR * cameras[view.image].width))
    ]


class _Corners:
    """Corners of tags in photographs, with residuals and their derivatives."""

    def __init__(
        self, cameras: Sequence[Camera], views: Sequence[TagView], sizes: Mapping[str, float], tags: list[str]
    ) -> None:
        used = [cameras[view.image] for view in views]
        self.tags, self.images = tags, np.array([view.image for view in views])
        self._of = np.array([tags.index(view.tag) for view in views])
        self._rotations = np.array([camera.world_to_camera[:3, :3] for camera in used])
        self.positions = np.array([camera.position for camera in used])
        self._focal = np.array([(camera.fx, camera.fy) for camera in used])[:, None]
        self._middle = np.array([(camera.cx, camera.cy) for camera in used])[:, None]
        self._observed = np.array([view.corners for view in views])
        self._edges = np.array([sizes[tag] for tag in tags])

    def residuals(self, unit: float, poses: Mapping[str, np.ndarray]) -> np.ndarray:
        """Projection minus observation, (views, 4, 2) pixels."""
        return self._project(unit, poses)[0]

    def _project(self, unit: float, poses: Mapping[str, np.ndarray]):
        matrices = np.array([poses[tag] for tag in self.tags])[self._of]
        arms = unit * self._edges[self._of, None, None] * (_SQUARE @ matrices[:, :3, :3].swapaxes(1, 2))
        points = arms + (matrices[:, :3, 3] - self.positions)[:, None]
        local = points @ self._rotations.swapaxes(1, 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = local[..., :2] / local[..., 2:]
        return flat * self._focal + self._middle - self._observed, arms, local

    def linearised(self, unit: float, poses: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (views, 4, 2) and derivatives (views, 4, 2, 1 + 6 tags) by the logarithm of the unit, and
        each tag's rotation vector and translation."""
        residuals, arms, local = self._project(unit, poses)
        # derivative of a pixel with respect to a point in the camera's frame, then in the world's
        x, y, z = np.moveaxis(local, -1, 0)
        zero = np.zeros_like(x)
        rows = [np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)]
        by_point = (np.stack(rows, -2) * self._focal[..., None]) @ self._rotations[:, None]
        result = np.zeros((*residuals.shape, 1 + 6 * len(self.tags)))
        result[..., 0] = (by_point @ arms[..., None])[..., 0]
        # a rotation by w moves a point by w x arm, so that g . (w x arm) = w . (arm x g)
        turning = np.cross(arms[..., None, :], by_point)
        for number, tag in enumerate(self._of):
            at = 1 + 6 * tag
            result[number, ..., at : at + 3] = turning[number]
            result[number, ..., at + 3 : at + 6] = by_point[number]
        return residuals, result


def _solve(
    cameras: Sequence[Camera],
    views: Sequence[TagView],
    sizes: Mapping[str, float],
    unit: float,
    poses: Mapping[str, np.ndarray],
) -> tuple[float, dict[str, np.ndarray], float]:
    """Model units per metre, poses of the tags, and the relative standard error of the unit."""
    tags = list(dict.fromkeys(view.tag for view in views))
    corners, poses = _Corners(cameras, views, sizes, tags), {tag: poses[tag] for tag in tags}
    noise, damping = np.inf, 1e-4
    residuals, derivatives = corners.linearised(unit, poses)
    for _ in range(ITERATIONS):
        sizes_of = np.linalg.norm(residuals, axis=-1)
        noise = max(float(np.median(sizes_of)) / 1.177, MIN_NOISE)  # of one coordinate
        weights = np.minimum(1, HUBER * noise / np.maximum(sizes_of, 1e-12))
        weighted = derivatives * weights[..., None, None]
        normal = np.einsum("nkci,nkcj->ij", weighted, derivatives)
        gradient = np.einsum("nkci,nkc->i", weighted, residuals)
        before = _huber(sizes_of, HUBER * noise)
        done = False
        while True:
            step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            tried = unit * float(np.exp(step[0])), _moved(poses, tags, step[1:])
            after = _huber(np.linalg.norm(corners.residuals(*tried), axis=-1), HUBER * noise)
            if after <= before:
                (unit, poses), damping = tried, max(damping / 5, 1e-9)
                done = before - after <= 1e-10 * before
                break
            damping *= 5
            if damping > 1e8:
                done = True
                break
        residuals, derivatives = corners.linearised(unit, poses)
        if done:
            break
    return unit, poses, _unit_error(corners.images, residuals, derivatives, noise)


def _huber(sizes: np.ndarray, limit: float) -> float:
    cost = np.where(sizes <= limit, sizes**2, 2 * limit * sizes - limit**2).sum()
    return float(cost) if np.isfinite(cost) else np.inf


def _moved(poses: Mapping[str, np.ndarray], tags: list[str], step: np.ndarray) -> dict[str, np.ndarray]:
    moved = {}
    for tag, part in zip(tags, step.reshape(-1, 6), strict=True):
        angle = float(np.linalg.norm(part[:3]))
        sine = np.sinc(angle / (2 * np.pi)) / 2  # sin(angle / 2) / angle
        pose = poses[tag].copy()
        pose[:3, :3] = quaternion_to_matrix(np.array([np.cos(angle / 2), *(sine * part[:3])])) @ pose[:3, :3]
        pose[:3, 3] += part[3:]
        moved[tag] = pose
    return moved


def _unit_error(images: np.ndarray, residuals: np.ndarray, derivatives: np.ndarray, noise: float) -> float:
    """Standard error of the logarithm of the unit: the larger of the estimate for independent corners and the
    cluster-robust sandwich estimate with photographs as clusters."""
    sizes = np.linalg.norm(residuals, axis=-1)
    weights = np.minimum(1, HUBER * noise / np.maximum(sizes, 1e-12))
    weighted = derivatives * weights[..., None, None]
    inverse = np.linalg.pinv(np.einsum("nkci,nkcj->ij", weighted, derivatives))
    count, unknowns = residuals.size, derivatives.shape[-1]
    freedom = max(1, count - unknowns)
    variance = float((weights[..., None] * residuals**2).sum()) / freedom
    gradients = np.einsum("nkci,nkc->ni", weighted, residuals)
    groups = [gradients[images == image].sum(0) for image in np.unique(images)]
    shared = np.array(groups) @ inverse[0]
    clusters = len(groups) / max(1, len(groups) - 1) * (count - 1) / freedom
    return float(np.sqrt(max(variance * inverse[0, 0], clusters * float(shared @ shared))))
