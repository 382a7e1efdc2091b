"""Fusion of depth images into a truncated signed distance field (TSDF), and its mesh by surface nets.

The field has blocks of 8 x 8 x 8 voxels where a depth image has a surface (voxel hashing).
"""

from __future__ import annotations

from itertools import product

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.formats.meshes import TriangleMesh
from fidsplat.util import interrupts

BLOCK_SIDE = 8
"""voxels per side of a block"""
TRUNCATION = 2.0
"""truncation distance in voxels"""
MIN_COSINE = 0.2
"""minimum cosine between ray and normal of a fused pixel: depths at silhouettes belong to no surface"""
FREE_SPACE_WEIGHT = 0.05
"""weight of an observation of free space in front of the truncation band"""
BLOCKS_AT_ONCE = 1024
"""blocks that are processed at once, which bounds memory"""
_KEY_OFFSET = 1 << 20
_VOXELS = np.stack(np.meshgrid(*[np.arange(BLOCK_SIDE)] * 3, indexing="ij"), -1).reshape(-1, 3)


class DistanceField:
    """A truncated signed distance field, positive outside. voxel: edge [m]. origin: (3,) world position of
    the lower corner of voxel (0, 0, 0)."""

    def __init__(self, voxel: float, origin) -> None:
        self.voxel, self.origin = voxel, np.asarray(origin, np.float64)
        self.keys = np.empty(0, np.int64)
        """sorted keys of the blocks"""
        self._sums = np.empty((0, BLOCK_SIDE**3, 6), np.float32)
        """(n, voxels, 6) sums of weight, weighted distance, weighted colour (3), and colour weight"""

    def allocate(self, depth: np.ndarray, camera: Camera) -> None:
        """Add the blocks around the surface of a depth image (h, w), 0 where empty. Call it for all images
        before the first `integrate`."""
        w = depth.shape[1]
        filled = np.flatnonzero(depth.ravel() > 0)
        pixels = np.stack([filled % w + 0.5, filled // w + 0.5], 1)
        depths, truncation = depth.ravel()[filled].astype(np.float64), TRUNCATION * self.voxel
        keys = [self.keys]
        for offset in (-truncation, 0.0, truncation):
            points = camera.unproject(pixels, depths + offset)
            points = points[np.isfinite(points).all(1)]
            blocks = np.floor((points - self.origin) / (BLOCK_SIDE * self.voxel)).astype(np.int64)
            keys.append(np.unique(_key(blocks)))
        self.keys = np.unique(np.concatenate(keys))

    def integrate(self, depth: np.ndarray, cosine: np.ndarray, rgb: np.ndarray, camera: Camera) -> None:
        """Average a depth image (h, w) and its colours (h, w, 3) into the blocks that exist. cosine: (h, w)
        of the angle between ray and normal, the weight of an observation."""
        if len(self._sums) != len(self.keys):
            self._sums = np.zeros((len(self.keys), BLOCK_SIDE**3, 6), np.float32)
        rotation, size = camera.world_to_camera[:3, :3], BLOCK_SIDE * self.voxel
        along_ray = camera.lens is not None and camera.lens.along_ray
        corners = (_blocks(self.keys) * size + self.origin - camera.position) @ rotation.T
        centers = corners + (size / 2) * rotation.sum(1)
        in_front = np.flatnonzero((centers[:, 2] > -size) | along_ray)
        steps = (_VOXELS + 0.5) * self.voxel @ rotation.T
        for start in range(0, len(in_front), BLOCKS_AT_ONCE):
            interrupts.check()
            batch = in_front[start : start + BLOCKS_AT_ONCE]
            local = (corners[batch, None] + steps).reshape(-1, 3)
            with np.errstate(invalid="ignore", divide="ignore"):
                if camera.lens is None:
                    image = local[:, :2] / np.where(local[:, 2:] > 0, local[:, 2:], np.nan)
                else:
                    image = camera.lens.image(local)
                x, y = image[:, 0] * camera.fx + camera.cx, image[:, 1] * camera.fy + camera.cy
                rows = np.flatnonzero((x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height))
            x, y = x[rows].astype(np.int64), y[rows].astype(np.int64)
            distances = np.linalg.norm(local[rows], axis=1) if along_ray else local[rows, 2]
            measured, pixel_cosine = depth[y, x].astype(np.float64), cosine[y, x]
            distance = (measured - distances) / (TRUNCATION * self.voxel)
            used = (measured > 0) & (distance > -1) & (pixel_cosine >= MIN_COSINE)
            rows, x, y, distance, pixel_cosine = (
                array[used] for array in (rows, x, y, distance, pixel_cosine)
            )
            near_surface = distance < 1
            distance = np.minimum(distance, 1.0)
            weight = np.where(near_surface, pixel_cosine, FREE_SPACE_WEIGHT)
            values = np.empty((len(rows), 6), np.float32)
            values[:, 0], values[:, 1] = weight, weight * distance
            values[:, 5] = weight * near_surface
            values[:, 2:5] = rgb[y, x] * values[:, 5:]
            block, voxel = np.divmod(rows, BLOCK_SIDE**3)
            self._sums[batch[block], voxel] += values

    def mesh(self) -> TriangleMesh:
        """The zero level of the field by surface nets: a vertex for each cell that the surface crosses, the
        mean of the crossings of its edges."""
        cells, vertices, colors, quads = [], [], [], []
        for start in range(0, len(self.keys), BLOCKS_AT_ONCE):
            interrupts.check()
            keys = self.keys[start : start + BLOCKS_AT_ONCE]
            sums = self._sums_with_border(keys)
            weight = sums[..., 0]
            value = np.where(weight > 0, sums[..., 1] / np.maximum(weight, 1e-9), np.nan)
            first = _blocks(keys) * BLOCK_SIDE
            self._append_vertices(value, sums, first, cells, vertices, colors)
            _append_faces(value, first, quads)
        if not cells or not sum(map(len, cells)):
            return TriangleMesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
        cell_keys = np.concatenate(cells)
        order = np.argsort(cell_keys)
        cell_keys = cell_keys[order]
        points = np.concatenate(vertices)[order] * self.voxel + self.origin
        quad_keys = np.concatenate(quads)
        corners = np.minimum(np.searchsorted(cell_keys, quad_keys), len(cell_keys) - 1)
        corners = corners[(cell_keys[corners] == quad_keys).all(1)]
        diagonals = points[corners[:, :2]] - points[corners[:, 2:]]
        shorter = np.less_equal(*np.linalg.norm(diagonals, axis=2).T)
        first = np.where(shorter[:, None], corners[:, [0, 1, 2]], corners[:, [0, 1, 3]])
        second = np.where(shorter[:, None], corners[:, [0, 2, 3]], corners[:, [1, 2, 3]])
        faces = np.concatenate([first, second]).astype(np.int32)
        used, inverse = np.unique(faces, return_inverse=True)
        return TriangleMesh(
            points[used], inverse.reshape(-1, 3).astype(np.int32), np.concatenate(colors)[order][used]
        )

    def _sums_with_border(self, keys: np.ndarray) -> np.ndarray:
        """Sums (n, 9, 9, 9, 6) of blocks, each with the first voxels of its upper neighbours; 0 outside."""
        out = np.zeros((len(keys), BLOCK_SIDE + 1, BLOCK_SIDE + 1, BLOCK_SIDE + 1, 6), np.float32)
        for step in product((0, 1), repeat=3):
            neighbours = _key(_blocks(keys) + step)
            rows = np.minimum(np.searchsorted(self.keys, neighbours), len(self.keys) - 1)
            known = np.flatnonzero(self.keys[rows] == neighbours)
            block = self._sums[rows[known]].reshape(-1, BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE, 6)
            target = tuple(slice(BLOCK_SIDE, None) if s else slice(0, BLOCK_SIDE) for s in step)
            source = tuple(slice(0, 1) if s else slice(None) for s in step)
            out[(known, *target)] = block[(slice(None), *source)]
        return out

    def _append_vertices(self, value, sums, first, cells, vertices, colors) -> None:
        """Append keys, vertices and colours of the cells that the surface crosses."""
        corner = np.stack([value[_cells_from(step)] for step in product((0, 1), repeat=3)], -1)
        below = corner < 0
        crossed = np.isfinite(corner).all(-1) & below.any(-1) & ~below.all(-1)
        block, *position = np.nonzero(crossed)
        corner, cell = corner[crossed], np.stack(position, 1)
        total, count = np.zeros((len(cell), 3)), np.zeros((len(cell), 1))
        steps = np.array(list(product((0, 1), repeat=3)))
        for a in range(8):
            for b in range(a + 1, 8):
                if np.abs(steps[a] - steps[b]).sum() != 1:
                    continue
                av, bv = corner[:, a].astype(np.float64), corner[:, b].astype(np.float64)
                crosses = ((av < 0) != (bv < 0))[:, None]
                fraction = (av / np.where(av == bv, 1.0, av - bv))[:, None]
                total += np.where(crosses, steps[a] + fraction * (steps[b] - steps[a]), 0.0)
                count += crosses
        cells.append(_key(first[block] + cell))
        vertices.append(first[block] + cell + 0.5 + total / count)
        neighbours = [sums[(*_cells_from(step), slice(None))][crossed] for step in product((0, 1), repeat=3)]
        color_sums = sum(sums[:, 2:5] for sums in neighbours)
        weights = sum(sums[:, 5:] for sums in neighbours)
        colors.append(np.asarray(color_sums) / np.maximum(np.asarray(weights), 1e-9))


def _append_faces(value: np.ndarray, first: np.ndarray, quads: list[np.ndarray]) -> None:
    """Append the cells (n, 4) around each voxel edge that the surface crosses, as counter-clockwise faces."""
    values = value[:, :BLOCK_SIDE, :BLOCK_SIDE, :BLOCK_SIDE]
    for axis in range(3):
        step = np.eye(3, dtype=int)[axis]
        next_values = value[_cells_from(tuple(step))]  # of the neighbours along the axis
        with np.errstate(invalid="ignore"):
            crosses = np.isfinite(values) & np.isfinite(next_values) & ((values < 0) != (next_values < 0))
        block, *position = np.nonzero(crosses)
        cell = first[block] + np.stack(position, 1)
        u, v = np.eye(3, dtype=np.int64)[(axis + 1) % 3], np.eye(3, dtype=np.int64)[(axis + 2) % 3]
        around = _key(np.stack([cell, cell - u, cell - u - v, cell - v], 1))
        outwards = (values[crosses] < 0)[:, None]
        quads.append(np.where(outwards, around, around[:, ::-1]))


def _cells_from(step: tuple[int, ...]) -> tuple[slice, ...]:
    """Index of the voxels of blocks with a border, shifted by a step (3,) of 0 or 1."""
    return (slice(None), *(slice(s, s + BLOCK_SIDE) for s in step))


def _key(cells: np.ndarray) -> np.ndarray:
    """Keys of integer coordinates (..., 3) within +-2^20."""
    x, y, z = np.moveaxis(cells + _KEY_OFFSET, -1, 0)
    return (x << 42) | (y << 21) | z


def _blocks(keys: np.ndarray) -> np.ndarray:
    """Integer coordinates (n, 3) of keys, the inverse of `_key`."""
    mask = (1 << 21) - 1
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], -1) - _KEY_OFFSET
