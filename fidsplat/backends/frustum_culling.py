"""Which boxes of splats a view may see: boxes that it cannot see need not be on the device.

A box that is left out must not have a splat that the picture shows, whatever camera, low-pass or shutter:
what the kernels ask of each splat (`project.cl`) is asked here of all that a box may hold. Where that cannot
be answered for a box as a whole, the box counts as seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fidsplat.backends.view import View
from fidsplat.cameras.lenses import BrownConrady, Equirectangular, Fisheye
from fidsplat.cameras.raster import RayRaster
from fidsplat.effects import FeatureSet

Boxes = Callable[[float], tuple[np.ndarray, np.ndarray]]
"""corners (n, 3) float64 [m], lowest and highest, of boxes around splats to so many standard deviations"""

ROOM = 1.01
"""how much further splats are taken to reach: for rounding, and what bounds are padded with"""
BRIGHTEST = 4.0
"""most opacity, of splats that stand for others (fidsplat/store/merge.py)"""
_ACROSS, _ALONG = 0.5, 1 / 8
"""standard deviations of what a sample sees under the low-pass `pixel`: across its ray in samples, and along
it as a share of the depth (kernels/opencl/slot/lowpass_pixel.cl)"""
_ROUNDING = 1e-5
"""of a coordinate: what a set-up in float32 may be off"""


def seen(view: View, features: FeatureSet, boxes: Boxes, reach: np.ndarray) -> np.ndarray:
    """(n,) bool: the boxes whose splats may show in the picture, or in one of the poses of which it is made.

    Args:
        boxes: of the splats that move with the camera's view and of those that move by themselves alike.
        reach: (n,) metres: largest standard deviation of a box's splats.
    """
    if view.shots:
        made = np.zeros(len(reach), bool)
        for shot in view.shots:
            made |= seen(shot.view, features, boxes, reach)
        return made
    made = _seen_by(view, features, boxes, reach)
    for _, own in view.groups:
        made |= _seen_by(own, features, boxes, reach)
    return made


@dataclass(frozen=True)
class Extent:
    """How far splats show around their centres p, as the camera sees them.

    The low-pass `pixel` adds to a disk, of R standard deviations, an ellipse of its plane: points e that are
    by the derivative at p at most R s samples to the side and R k z further or nearer, z the depth of p, s
    and k `_ACROSS` and `_ALONG`. A side of the picture is a plane through the camera's centre, from which p
    is n . p / z samples away, and with p moved by e these samples times 1 + e_z / z, and those to the side.
    Covariances add: p beyond a side, d = -n . p, reaches over it only if d^2 <= R^2 (E^2 + (k d)^2 + (s z)^2)
    with E the disk's standard deviation along n. That is not so of a disk and a margin larger by
    1 / sqrt(1 - (R k)^2) that lie beyond it. Of depths, z - R k z less the disk's, the bound is the sum's.
    The low-pass leaves splats whose centre lies before the near plane as they are.
    """

    radius: float
    """standard deviations to which disks are taken, to the sides"""
    margin: float
    """samples beside their picture"""
    depths: float
    """standard deviations to which disks are taken, in depth"""
    nearer: float = 1.0
    """by which depths are multiplied then"""

    @staticmethod
    def of(view: View, features: FeatureSet, least: float = 0.0) -> Extent | None:
        """That of a view's splats, to `least` standard deviations at least; None where nothing bounds it:
        under the low-pass `pixel` behind distorted lenses, which stretch without limit at their fold, to
        parallel rays, whose footprint has no end, and at cut-offs as low as 1e-13."""
        radius = max(drawn_to(view), least)
        # a dot of the low-pass, or what EWA widens a splat by
        plain = Extent(radius, radius * view.samples + 2.0, radius)
        if not _widened(features):
            return plain
        # depths along the ray are bounded by spheres around disks, in which their parts to the side are too
        aside = _ACROSS * _turned_by(view) if view.along_ray else 0.0
        nearer = 1.0 - radius * math.hypot(_ALONG, aside)
        if nearer <= 0 or view.parallel or isinstance(view.lens, BrownConrady):
            return None
        larger = 1.0 / math.sqrt(1.0 - (radius * _ALONG) ** 2)
        margin = max(plain.margin, larger * radius * _ACROSS + 2.0)
        return Extent(larger * radius, margin, radius / nearer, nearer)

    def nearest(self, view: View, turned: Turned) -> np.ndarray:
        """(n,) metres: below the depths of all that splats in boxes to `depths` standard deviations show, and
        of their sort keys."""
        nearest = turned.nearest(view)
        return np.minimum(self.nearer * nearest, nearest)


def _widened(features: FeatureSet) -> bool:
    return "lowpass_pixel" in features.names


def drawn_to(view: View) -> float:
    """Standard deviations to which splats are drawn, with room: those that stand for others reach further."""
    return ROOM * math.sqrt(2.0 * (math.log(BRIGHTEST) - view.log_cut))


def ewa_reach(view: View, features: FeatureSet, radius: float, reach: np.ndarray) -> np.ndarray | None:
    """(n,) samples, times the depth [m] where rays meet: how far beside their centres splats are drawn by the
    derivative there, which may be further than they reach, to `radius` of their standard deviations, the
    largest `reach` (n,) [m]; None where splats are not drawn so."""
    if not {"ellipsoid_ewa", "ellipsoid_ewa_antialiased"} & features.names:
        return None
    slope = 1.0 if view.parallel else math.hypot(1.0, max(map(abs, view.slopes)))
    return max(view.focal_x, view.focal_y) * slope * radius * reach


def _seen_by(view: View, features: FeatureSet, boxes: Boxes, reach: np.ndarray) -> np.ndarray:
    extent = Extent.of(view, features)
    if extent is None:
        # nothing of a splat whose centre lies behind the near plane is widened
        whole = Turned(view, *boxes(drawn_to(view)))
        return whole.furthest(view) >= view.near * (1 - _ROUNDING)
    radius, margin = extent.radius, extent.margin
    centers = Turned(view, *boxes(0.0))
    whole = Turned(view, *boxes(radius))
    made = whole.furthest(view) >= view.near * (1 - _ROUNDING)
    deep = whole if extent.depths == radius else Turned(view, *boxes(extent.depths))
    made &= extent.nearest(view, deep) <= view.far * (1 + _ROUNDING)
    if view.raster is None:
        wide = ewa_reach(view, features, radius, reach)
        for normal, offset in _pinhole_sides(view, margin):
            inside = whole.beyond(normal) + offset >= 0
            if wide is not None:
                inside |= centers.beyond(normal) + offset + wide >= 0
            made &= inside
        return made
    lens = view.raster.lens
    if isinstance(lens, Equirectangular):
        return made
    step = view.raster.step * margin
    if isinstance(lens, Fisheye):
        if _widened(features):  # to the side at most that, and at least `nearer` times as far away
            step = _turned_by(view) * max(margin, extent.depths * _ACROSS + 2.0)
            return made & centers.within(_widest(view.raster), step, extent.depths * reach)
        return made & whole.within(_widest(view.raster) + step)
    low, high = _slopes(view.raster)
    for axis in (0, 1):
        for sign, side in ((1.0, low[axis] - step), (-1.0, high[axis] + step)):
            normal = np.zeros(3)
            normal[axis], normal[2] = sign, -sign * side
            made &= whole.beyond(normal) >= 0
    return made


class Turned:
    """Boxes in the camera's frame."""

    def __init__(self, view: View, low: np.ndarray, high: np.ndarray) -> None:
        middle, half = (low + high) / 2, (high - low) / 2
        self.middle = middle @ view.rotation.T + view.translation
        self.half = half @ np.abs(view.rotation.T)
        self._low, self._high, self._view = low, high, view
        # of the sums that make a coordinate
        self.room = _ROUNDING * (np.abs(middle).sum(1) + half.sum(1) + np.abs(view.translation).sum())
        self._half = half

    def beyond(self, normal: np.ndarray) -> np.ndarray:
        """(n,) the largest product of a box's points with a vector (3,) of the camera's frame."""
        reach = self._half @ np.abs(self._view.rotation.T @ normal)
        return self.middle @ normal + reach + self.room * np.abs(normal).sum()

    def nearest(self, view: View) -> np.ndarray:
        """(n,) metres: the least depth of a box, as the view means depth."""
        if view.along_ray:
            return np.maximum(np.linalg.norm(self.middle, axis=1) - self._radius, 0.0)
        return -self.beyond(np.array([0.0, 0.0, -1.0]))

    def furthest(self, view: View) -> np.ndarray:
        """(n,) metres: the largest."""
        if view.along_ray:
            return np.linalg.norm(self.middle, axis=1) + self._radius
        return self.beyond(np.array([0.0, 0.0, 1.0]))

    def off_axis(self) -> np.ndarray:
        """(n,) metres: the least distance from the vertical axis, around which panoramas are stretched."""
        return np.maximum(np.hypot(self.middle[:, 0], self.middle[:, 2]) - self._radius, 0.0)

    @property
    def _radius(self) -> np.ndarray:
        return np.linalg.norm(self._half, axis=1) + self.room

    def within(self, angle: float, step: float = 0.0, further: np.ndarray | None = None) -> np.ndarray:
        """(n,) bool: which may have points at most so far [rad] from the optical axis; or points as far from
        those in the box as a share `step` of their distance from the camera, and `further` (n,) metres."""
        distance = np.linalg.norm(self.middle, axis=1)
        around = np.arcsin(np.minimum(self._radius / np.maximum(distance, 1e-300), 1.0))
        off = np.arctan2(np.hypot(self.middle[:, 0], self.middle[:, 1]), self.middle[:, 2])
        if further is not None:
            aside = step + further / np.maximum(distance - self._radius, 1e-300)
            around = np.where(aside < 1, around + np.arcsin(np.minimum(aside, 1.0)), np.inf)
        return (distance <= self._radius) | (off - around <= angle)


def _pinhole_sides(view: View, margin: float) -> list[tuple[np.ndarray, float]]:
    """The sides of the picture as half spaces of the camera's frame, normal . p + offset >= 0 within, wider
    by `margin` samples."""
    sides = []
    rows = (0, view.height) if view.band is None else view.band
    grid = ((0, view.focal_x, view.center_x, (0, view.width)), (1, view.focal_y, view.center_y, rows))
    for axis, focal, center, (first, end) in grid:
        for sign, side in ((1.0, first - margin), (-1.0, end + margin)):
            # sign (focal x / z + center - side) >= 0, times z where rays meet
            normal = np.zeros(3)
            normal[axis] = sign * focal
            if view.parallel:
                sides.append((normal, sign * (center - side)))
                continue
            normal[2] = sign * (center - side)
            sides.append((normal, 0.0))
    return sides


def _turned_by(view: View) -> float:
    """The largest angle [rad] by which rays of a fisheye or a panorama turn in a sample, wherever it sees;
    infinite for a fisheye that folds."""
    lens = view.lens
    if not isinstance(lens, Fisheye):
        return 1.0 / min(view.focal_x, view.focal_y)
    angles = np.linspace(1e-6, lens.limit, 4096)
    slopes = lens.distance(angles + 1e-6) - lens.distance(angles - 1e-6)
    least = min(float(slopes.min()) / 2e-6, float((lens.distance(angles) / np.sin(angles)).min()))
    # between these angles it changes less than that
    return math.inf if least < 0.05 else 1.05 / (least * min(view.focal_x, view.focal_y))


@lru_cache(maxsize=8)
def _widest(raster: RayRaster) -> float:
    """The largest angle [rad] of a sample's ray from the optical axis."""
    rays = raster.rays.astype(np.float64)
    return float(np.nanmax(np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])))


@lru_cache(maxsize=8)
def _slopes(raster: RayRaster) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest x / z and y / z, (2,) each, of the samples' rays."""
    rays = raster.rays.astype(np.float64)
    slopes = rays[..., :2] / rays[..., 2:]
    return np.nanmin(slopes, axis=(0, 1)), np.nanmax(slopes, axis=(0, 1))


def sizes(view: View, boxes: Boxes, edges: np.ndarray) -> np.ndarray:
    """(n,) samples: how large lengths (n,) [m] are at most on the picture where a box is nearest. Shutters
    and splats that move by themselves count, and infinity where a box reaches to the camera."""
    if view.shots:
        return np.max([sizes(shot.view, boxes, edges) for shot in view.shots], axis=0)
    made = np.zeros(len(edges))
    for one in (view, *(own for _, own in view.groups)):
        focal = max(one.focal_x, one.focal_y)
        if one.parallel:
            made = np.maximum(made, edges * focal)
            continue
        turned = Turned(one, *boxes(0.0))
        panorama = one.raster is not None and isinstance(one.raster.lens, Equirectangular)
        nearest = turned.off_axis() if panorama else turned.nearest(one)
        with np.errstate(divide="ignore", invalid="ignore"):
            size = np.where(nearest > 0, edges * focal / np.maximum(nearest, 1e-300), np.inf)
        made = np.maximum(made, np.where(edges > 0, size, 0.0))
    return made
