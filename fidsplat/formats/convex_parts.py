"""Convex parts of a triangle mesh, for collisions: best-first bisection of its faces."""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from itertools import count

import numpy as np

MAX_PARTS = 512
"""default maximum number of parts"""
TOLERANCE = 2e-3
"""space in front of the surface within a part that needs no further bisection, relative to the mesh's longest
side"""
THICKNESS = 0.01
"""minimum thickness of a part, relative to the mesh's longest side: MuJoCo's hulls need a volume"""
_DIRECTIONS, _NORMALS, _ANGLES = 96, 64, 32
"""numbers of directions that bound the hull of a part: on a sphere, of its own faces, and in its plane"""
_FACING = 0.05
"""minimum cosine between a direction and a normal"""
_BLOCK = 1 << 14
"""vertices per block, for bounded memory"""


@dataclass(frozen=True, eq=False)
class ConvexPart:
    """Convex hull of a part of a surface."""

    vertices: np.ndarray
    """(k, 3) vertices of the hull"""
    gaps: np.ndarray
    """(n,) for each vertex of the part the length of its normal within the hull: space that the hull fills in
    front of the surface [m]"""


def convex_parts(vertices: np.ndarray, faces: np.ndarray, max_parts: int) -> list[ConvexPart]:
    """Divide a surface into at most `max_parts` parts, and return their convex hulls.

    The part whose hull fills most space in front of the surface is bisected by connected components, or by
    the positions or the normals of its faces, whichever leaves least. Hulls are bounded by fixed directions
    and by normals.

    Args:
        vertices: (n, 3).
        faces: (m, 3) indices, counter-clockwise from outside.
    """
    side = float(np.ptp(vertices, axis=0).max())
    corners = vertices[faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    surface = _Surface(vertices, faces, corners.mean(1), crosses, THICKNESS * side)
    every = np.arange(len(faces))
    heap: list[tuple[float, int, np.ndarray, ConvexPart]] = [(-np.inf, 0, every, surface.hull(every))]
    done: list[ConvexPart] = []
    numbers = count(1)  # of equal costs the first one is bisected first
    while heap and len(heap) + len(done) < max_parts:
        negative_cost, _, part, hull = heapq.heappop(heap)
        halves = surface.bisections(part)
        if -negative_cost <= TOLERANCE * side or not halves:
            done.append(hull)
            continue
        hulls = [[(surface.hull(half), half) for half in pair] for pair in halves]
        tried = [[(surface.cost(hull, half), half, hull) for hull, half in pair] for pair in hulls]
        for cost, half, hull in min(tried, key=lambda pair: sum(cost for cost, _, _ in pair)):
            heapq.heappush(heap, (-cost, next(numbers), half, hull))
    return done + [hull for _, _, _, hull in heap]


class _Surface:
    """Faces of a mesh, with centers and normals."""

    def __init__(self, vertices, faces, centers, crosses, thickness: float) -> None:
        self.vertices, self.faces, self.centers, self.crosses = vertices, faces, centers, crosses
        self.thickness = thickness
        self.components = _components(faces, len(vertices))
        self.areas = np.linalg.norm(crosses, axis=1) / 2
        self.normals = crosses / np.maximum(2 * self.areas, 1e-300)[:, None]
        turn = np.arange(_DIRECTIONS) * np.pi * (3 - 5**0.5)  # points of a Fibonacci lattice
        height = 1 - (2 * np.arange(_DIRECTIONS) + 1) / _DIRECTIONS
        radius = np.sqrt(1 - height**2)
        self.sphere = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], 1)

    def hull(self, part: np.ndarray) -> ConvexPart:
        """Hull of faces, and the space that it fills in front of their vertices."""
        used, index = np.unique(self.faces[part], return_inverse=True)
        points = self.vertices[used]
        normals = np.zeros_like(points)
        for corner in index.reshape(-1, 3).T:
            np.add.at(normals, corner, self.crosses[part])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        own = self.normals[part][:: max(1, len(part) // _NORMALS)]
        mean = self.crosses[part].sum(0)
        across = self._in_plane(mean)
        directions = np.concatenate([self.sphere, own, normals[:: max(1, len(normals) // _NORMALS)], across])
        blocks = [slice(first, first + _BLOCK) for first in range(0, len(points), _BLOCK)]
        tops = np.max([(points[block] @ directions.T).max(0) for block in blocks], axis=0)
        gaps = np.empty(len(points))
        for block in blocks:
            facing = normals[block] @ directions.T
            room = (tops - points[block] @ directions.T) / np.where(facing > _FACING, facing, np.nan)
            gaps[block] = np.nan_to_num(np.nanmin(room, axis=1), nan=0.0)
        extremes = np.unique([int(np.argmax(points @ direction)) for direction in directions])
        ends = points[extremes]
        depth = -mean / max(float(np.linalg.norm(mean)), 1e-300)
        if np.ptp(ends @ depth) < self.thickness:
            ends = np.concatenate([ends, ends + self.thickness * depth])
        return ConvexPart(ends, np.maximum(gaps, 0.0))

    def cost(self, hull: ConvexPart, part: np.ndarray) -> float:
        """Space in front of the surface, and width of the holes that the hull fills in the mean plane."""
        mean = self.crosses[part].sum(0)
        length = float(np.linalg.norm(mean))
        if length < 1e-300:
            return float(hull.gaps.max())
        across = self._in_plane(mean)
        axes = across[0], across[_ANGLES // 4]
        flat = np.stack([self.vertices[self.faces[part]] @ axis for axis in axes], -1)
        first, second = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
        covered = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).sum() / 2
        points = flat.reshape(-1, 2)
        angles = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
        outline = points[[int(np.argmax(points @ (np.cos(a), np.sin(a)))) for a in angles]]
        following = np.roll(outline, -1, axis=0)
        area = abs(float((outline[:, 0] * following[:, 1] - outline[:, 1] * following[:, 0]).sum())) / 2
        filled = max(0.0, area - float(covered)) / max(area, 1e-300) ** 0.5
        return max(float(hull.gaps.max()), filled)

    def bisections(self, part: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Bisections of faces by their components, by their positions and by their normals."""
        centers, weights = self.centers[part], self.areas[part]
        _, own, sizes = np.unique(self.components[part], return_inverse=True, return_counts=True)
        of_component = np.stack([np.bincount(own, column) / sizes for column in centers.T], 1)[own]
        split = []
        for positions in (of_component, centers):
            axis = int(np.argmax(np.ptp(positions, axis=0)))
            split.append(positions[:, axis] > (positions[:, axis].min() + positions[:, axis].max()) / 2)
        normals = self.normals[part]
        mean = weights @ normals / max(float(weights.sum()), 1e-300)
        apart = normals - mean
        direction = np.linalg.eigh((apart * weights[:, None]).T @ apart)[1][:, -1]
        split.append(apart @ direction > 0)
        return [(part[side], part[~side]) for side in split if side.any() and not side.all()]

    def _in_plane(self, normal: np.ndarray) -> np.ndarray:
        """Directions (n, 3) perpendicular to a normal."""
        one = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        one = one / max(float(np.linalg.norm(one)), 1e-300)
        other = np.cross(normal / max(float(np.linalg.norm(normal)), 1e-300), one)
        angles = 2 * np.pi * np.arange(_ANGLES)[:, None] / _ANGLES
        return np.cos(angles) * one + np.sin(angles) * other


def _components(faces: np.ndarray, vertices: int) -> np.ndarray:
    """Label of the connected component of each face: the lowest index of the component's vertices."""
    labels = np.arange(vertices)
    while True:
        smallest = labels[faces].min(axis=1)
        new = labels.copy()
        for corner in faces.T:
            np.minimum.at(new, corner, smallest)
            np.minimum.at(new, labels[corner], smallest)
        new = new[new]
        if np.array_equal(new, labels):
            return labels[faces[:, 0]]
        labels = new
