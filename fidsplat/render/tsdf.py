"""Fusion of depth images into a truncated signed distance field (TSDF), and its mesh by surface nets.

The field has blocks of 8 x 8 x 8 voxels where a depth image has a surface (voxel hashing).
"""

from __future__ import annotations

from itertools import product

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.formats.meshes import TriangleMesh
from fidsplat.util import interrupts

SIDE = 8
"""voxels per side of a block"""
TRUNCATION = 2.0
"""voxels"""
GRAZING = 0.2
"""minimum cosine between ray and normal of a used pixel: depths at silhouettes belong to no surface"""
EMPTY = 0.05
"""weight of an observation in front of the truncation band"""
CHUNK = 1024
"""blocks that are processed at once"""
_OFFSET = 1 << 20
_VOXELS = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), -1).reshape(-1, 3)


class DistanceField:
    """A truncated signed distance field, positive outside. voxel: edge [m]. origin: (3,) world position of
    voxel 0."""

    def __init__(self, voxel: float, origin) -> None:
        self.voxel, self.origin = voxel, np.asarray(origin, np.float64)
        self.keys = np.empty(0, np.int64)
        """sorted keys of the blocks"""
        self._sums = np.empty((0, SIDE**3, 6), np.float32)  # weight, distance, colour, colour weight

    def allocate(self, depth: np.ndarray, camera: Camera) -> None:
        """Add the blocks around the surface of a depth image (h, w), 0 where empty."""
        w = depth.shape[1]
        filled = np.flatnonzero(depth.ravel() > 0)
        pixels = np.stack([filled % w + 0.5, filled // w + 0.5], 1)
        depths, band = depth.ravel()[filled].astype(np.float64), TRUNCATION * self.voxel
        found = [self.keys]
        for step in (-band, 0.0, band):
            points = camera.unproject(pixels, depths + step)
            points = points[np.isfinite(points).all(1)]
            blocks = np.floor((points - self.origin) / (SIDE * self.voxel)).astype(np.int64)
            found.append(np.unique(_key(blocks)))
        self.keys = np.unique(np.concatenate(found))

    def integrate(self, depth: np.ndarray, cosine: np.ndarray, rgb: np.ndarray, camera: Camera) -> None:
        """Average a depth image (h, w) and its colours (h, w, 3) into the blocks that exist. cosine: (h, w)
        of the angle between ray and normal, the weight of an observation."""
        if len(self._sums) != len(self.keys):
            self._sums = np.zeros((len(self.keys), SIDE**3, 6), np.float32)
        rotation, size = camera.world_to_camera[:3, :3], SIDE * self.voxel
        along_ray = camera.lens is not None and camera.lens.along_ray
        corners = (_blocks(self.keys) * size + self.origin - camera.position) @ rotation.T
        centres = corners + (size / 2) * rotation.sum(1)
        near = np.flatnonzero((centres[:, 2] > -size) | along_ray)
        steps = (_VOXELS + 0.5) * self.voxel @ rotation.T
        for start in range(0, len(near), CHUNK):
            interrupts.check()
            some = near[start : start + CHUNK]
            local = (corners[some, None] + steps).reshape(-1, 3)
            with np.errstate(invalid="ignore", divide="ignore"):
                if camera.lens is None:
                    image = local[:, :2] / np.where(local[:, 2:] > 0, local[:, 2:], np.nan)
                else:
                    image = camera.lens.image(local)
                x, y = image[:, 0] * camera.fx + camera.cx, image[:, 1] * camera.fy + camera.cy
                rows = np.flatnonzero((x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height))
            x, y = x[rows].astype(np.int64), y[rows].astype(np.int64)
            away = np.linalg.norm(local[rows], axis=1) if along_ray else local[rows, 2]
            measured, slope = depth[y, x].astype(np.float64), cosine[y, x]
            distance = (measured - away) / (TRUNCATION * self.voxel)
            used = (measured > 0) & (distance > -1) & (slope >= GRAZING)
            rows, x, y, distance, slope = rows[used], x[used], y[used], distance[used], slope[used]
            near_surface = distance < 1
            distance = np.minimum(distance, 1.0)
            weight = np.where(near_surface, slope, EMPTY)
            values = np.empty((len(rows), 6), np.float32)
            values[:, 0], values[:, 1] = weight, weight * distance
            values[:, 5] = weight * near_surface
            values[:, 2:5] = rgb[y, x] * values[:, 5:]
            block, voxel = np.divmod(rows, SIDE**3)
            self._sums[some[block], voxel] += values

    def mesh(self) -> TriangleMesh:
        """The zero level of the field by surface nets: a vertex for each cell that the surface crosses, the
        mean of the crossings of its edges."""
        cells, vertices, colors, quads = [], [], [], []
        for start in range(0, len(self.keys), CHUNK):
            interrupts.check()
            keys = self.keys[start : start + CHUNK]
            sums = self._padded(keys)
            weight = sums[..., 0]
            value = np.where(weight > 0, sums[..., 1] / np.maximum(weight, 1e-9), np.nan)
            first = _blocks(keys) * SIDE
            self._vertices(value, sums, first, cells, vertices, colors)
            _edges(value, first, quads)
        if not cells or not sum(map(len, cells)):
            return TriangleMesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
        known = np.concatenate(cells)
        order = np.argsort(known)
        known = known[order]
        points = np.concatenate(vertices)[order] * self.voxel + self.origin
        wanted = np.concatenate(quads)
        found = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
        found = found[(known[found] == wanted).all(1)]
        shorter = np.linalg.norm(points[found[:, 0]] - points[found[:, 2]], axis=1) <= np.linalg.norm(
            points[found[:, 1]] - points[found[:, 3]], axis=1
        )
        first = np.where(shorter[:, None], found[:, [0, 1, 2]], found[:, [0, 1, 3]])
        second = np.where(shorter[:, None], found[:, [0, 2, 3]], found[:, [1, 2, 3]])
        faces = np.concatenate([first, second]).astype(np.int32)
        used, inverse = np.unique(faces, return_inverse=True)
        return TriangleMesh(
            points[used], inverse.reshape(-1, 3).astype(np.int32), np.concatenate(colors)[order][used]
        )

    def _padded(self, keys: np.ndarray) -> np.ndarray:
        """Sums (n, 9, 9, 9, 6) of blocks with the first voxels of their upper neighbours, 0 outside."""
        out = np.zeros((len(keys), SIDE + 1, SIDE + 1, SIDE + 1, 6), np.float32)
        for step in product((0, 1), repeat=3):
            near = _key(_blocks(keys) + step)
            at = np.minimum(np.searchsorted(self.keys, near), len(self.keys) - 1)
            there = np.flatnonzero(self.keys[at] == near)
            block = self._sums[at[there]].reshape(-1, SIDE, SIDE, SIDE, 6)
            to = tuple(slice(SIDE, None) if s else slice(0, SIDE) for s in step)
            of = tuple(slice(0, 1) if s else slice(None) for s in step)
            out[(there, *to)] = block[(slice(None), *of)]
        return out

    def _vertices(self, value, sums, first, cells, vertices, colors) -> None:
        corner = np.stack([value[_at(step)] for step in product((0, 1), repeat=3)], -1)
        below = corner < 0
        crossed = np.isfinite(corner).all(-1) & below.any(-1) & ~below.all(-1)
        block, *place = np.nonzero(crossed)
        corner, at = corner[crossed], np.stack(place, 1)
        total, count = np.zeros((len(at), 3)), np.zeros((len(at), 1))
        steps = np.array(list(product((0, 1), repeat=3)))
        for a in range(8):
            for b in range(a + 1, 8):
                if np.abs(steps[a] - steps[b]).sum() != 1:
                    continue
                one, other = corner[:, a].astype(np.float64), corner[:, b].astype(np.float64)
                cut = ((one < 0) != (other < 0))[:, None]
                share = (one / np.where(one == other, 1.0, one - other))[:, None]
                total += np.where(cut, steps[a] + share * (steps[b] - steps[a]), 0.0)
                count += cut
        cells.append(_key(first[block] + at))
        vertices.append(first[block] + at + 0.5 + total / count)
        near = [sums[(*_at(step), slice(None))][crossed] for step in product((0, 1), repeat=3)]
        shades = sum(one[:, 2:5] for one in near)
        weights = sum(one[:, 5:] for one in near)
        colors.append(np.asarray(shades) / np.maximum(np.asarray(weights), 1e-9))


def _edges(value: np.ndarray, first: np.ndarray, quads: list[np.ndarray]) -> None:
    """Append the cells (n, 4) around each voxel edge that the surface crosses, as counter-clockwise faces."""
    own = value[:, :SIDE, :SIDE, :SIDE]
    for axis in range(3):
        step = np.eye(3, dtype=int)[axis]
        other = value[_at(tuple(step))]
        with np.errstate(invalid="ignore"):
            cut = np.isfinite(own) & np.isfinite(other) & ((own < 0) != (other < 0))
        block, *place = np.nonzero(cut)
        at = first[block] + np.stack(place, 1)
        u, v = np.eye(3, dtype=np.int64)[(axis + 1) % 3], np.eye(3, dtype=np.int64)[(axis + 2) % 3]
        around = _key(np.stack([at, at - u, at - u - v, at - v], 1))
        outwards = (own[cut] < 0)[:, None]
        quads.append(np.where(outwards, around, around[:, ::-1]))


def _at(step: tuple[int, ...]) -> tuple[slice, ...]:
    return (slice(None), *(slice(s, s + SIDE) for s in step))


def _key(cells: np.ndarray) -> np.ndarray:
    """Keys of integer coordinates (..., 3) within +-2^20."""
    x, y, z = np.moveaxis(cells + _OFFSET, -1, 0)
    return (x << 42) | (y << 21) | z


def _blocks(keys: np.ndarray) -> np.ndarray:
    mask = (1 << 21) - 1
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], -1) - _OFFSET
