"""Light field of a marker: radiance from panoramas at its points, and the resulting irradiance."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

Neighbour = tuple[tuple[np.ndarray, np.ndarray], np.ndarray]
"""index (row, column) and weight of a cell, for bilinear interpolation"""
_NORMALS_AT_ONCE = 256
"""normals whose irradiance is computed at once, which bounds memory"""
_EQUAL_NORMALS = 1e-4
"""step to which normals are rounded; equal ones have one irradiance"""


def panorama_directions(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """World directions (d, 3) of the pixels of an equirectangular panorama of 2 rows x rows pixels, and their
    solid angles (d,)."""
    columns = 2 * rows
    longitude = (np.arange(columns) + 0.5) / columns * 2 * np.pi - np.pi
    edges = np.arange(rows + 1) / rows * np.pi - np.pi / 2
    latitude = (edges[1:] + edges[:-1]) / 2
    longitudes, latitudes = np.meshgrid(longitude, latitude)
    cosine = np.cos(latitudes)
    directions = np.stack([cosine * np.sin(longitudes), np.sin(latitudes), cosine * np.cos(longitudes)], -1)
    angles = np.repeat(np.diff(np.sin(edges)) * 2 * np.pi / columns, columns)
    return directions.reshape(-1, 3), angles


def cosine_weights(normals: np.ndarray, directions: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Weights (..., d) with which the radiance from directions (d, 3) sums to the irradiance of surfaces with
    normals (..., 3); their sum is pi."""
    weights = np.maximum(normals @ directions.T, 0) * angles
    return weights * (np.pi / weights.sum(axis=-1, keepdims=True))


def neighbours(x: np.ndarray, y: np.ndarray) -> Iterator[Neighbour]:
    """The four cells around each position."""
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    for dy in (0, 1):
        for dx in (0, 1):
            yield (top + dy, left + dx), np.abs(x - left - 1 + dx) * np.abs(y - top - 1 + dy)


def normal_groups(normals: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Group normals (n, 3) that round to the same multiple of `step`: the index of the first member of each
    group, and the group (n,) of each normal."""
    _, first, group = np.unique(np.rint(normals / step), axis=0, return_index=True, return_inverse=True)
    return first, group.ravel()


class LightField:
    """Radiance from all directions, measured on a grid over a marker and interpolated between its points."""

    def __init__(self, directions: np.ndarray, angles: np.ndarray) -> None:
        self.directions, self.angles = directions, angles
        self.low, self.high = np.zeros(2), np.ones(2)
        self.radiance = np.zeros((1, 1, len(angles), 3))
        """(rows, columns, d, 3) radiance from each direction at each grid point"""

    @staticmethod
    def uniform(radiance: tuple[float, float, float]) -> LightField:
        """Equal radiance from all directions."""
        field = LightField(*panorama_directions(8))
        field.radiance[:] = radiance
        return field

    @staticmethod
    def measured(
        rows: int,
        levels: tuple[int, ...],
        positions: np.ndarray,
        radiance_at: Callable[[np.ndarray], np.ndarray],
        normal: np.ndarray,
        tolerance: float,
    ) -> LightField:
        """Measure radiance on a grid that is refined until its interpolated irradiance is within a tolerance.

        levels: numbers of panoramas along a side, ascending; the last is accepted without a check.
        positions: (m, 2) on the marker. radiance_at: function of positions (k, 2) that returns
        radiance (k, d, 3). normal: (3,) surface normal of the compared irradiance. tolerance: fraction of
        the maximum irradiance.
        """
        field = LightField(*panorama_directions(rows))
        field.low, field.high = positions.min(axis=0), positions.max(axis=0)
        weights = cosine_weights(normal, field.directions, field.angles)
        measured: dict[tuple[float, float], np.ndarray] = {}
        for level in levels:
            coordinates = np.linspace(0, 1, level) if level > 1 else [0.5]
            points = [(x, y) for y in coordinates for x in coordinates]
            new_points = [point for point in points if point not in measured]
            new_positions = field.low + np.array(new_points) * (field.high - field.low)
            measured |= dict(zip(new_points, radiance_at(new_positions), strict=True))
            field.radiance = np.stack([measured[point] for point in points]).reshape(level, level, -1, 3)
            if level == levels[-1]:
                break
            irradiance = np.einsum("d,yxdc->yxc", weights, field.radiance)
            coarse = irradiance[::2, ::2]
            error = max(
                _difference(irradiance[::2, 1::2], (coarse[:, 1:] + coarse[:, :-1]) / 2),
                _difference(irradiance[1::2, ::2], (coarse[1:] + coarse[:-1]) / 2),
            )
            # `error` is the interpolation error of the coarser grid; the error of this grid, with half the
            # spacing, is at most half of it
            if error <= tolerance * irradiance.max():
                break
        return field

    def _grid_neighbours(self, positions: np.ndarray) -> Iterator[Neighbour]:
        """The four grid points around each position (m, 2)."""
        size = np.array(self.radiance.shape[1::-1]) - 1
        span = np.where(self.high > self.low, self.high - self.low, 1)
        for (y, x), weight in neighbours(*(np.clip((positions - self.low) / span, 0, 1) * size).T):
            yield (np.minimum(y, size[1]), np.minimum(x, size[0])), weight

    def interpolated(self, values: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Interpolate values (rows, columns, ...) of the grid at positions (m, 2)."""
        return sum(  # type: ignore[return-value]
            values[index] * weight.reshape(-1, *[1] * (values.ndim - 2))
            for index, weight in self._grid_neighbours(positions)
        )

    @property
    def _images(self) -> np.ndarray:
        """Panoramas (rows, columns, h, w, 3)."""
        rows = round(np.sqrt(len(self.angles) / 2))
        return self.radiance.reshape(*self.radiance.shape[:2], rows, 2 * rows, 3)

    def _pixel_neighbours(self, directions: np.ndarray) -> Iterator[Neighbour]:
        """The four pixels of a panorama around each direction (..., 3)."""
        rows, columns = self._images.shape[2:4]
        x, y, z = np.moveaxis(directions, -1, 0)
        u = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * columns - 0.5
        v = (np.arcsin(np.clip(y, -1, 1)) / np.pi + 0.5) * rows - 0.5
        for (row, column), weight in neighbours(u, v):
            yield (np.clip(row, 0, rows - 1), column % columns), weight

    def incoming_radiance(self, directions: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Radiance (m, k, 3) from directions (m, k, 3) at positions (m, 2), interpolated in both."""
        radiance = np.zeros(directions.shape)
        for pixel, weight in self._pixel_neighbours(directions):
            for (row, column), grid_weight in self._grid_neighbours(positions):
                values = self._images[row[:, None], column[:, None], *pixel]
                radiance += values * (weight * grid_weight[:, None])[..., None]
        return radiance

    def reflected(self, directions: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Weighted sums (rows, columns, v, 3) of the radiance from directions (v, k, 3): v viewers, k samples
        each."""
        return sum(  # type: ignore[return-value]
            np.einsum("vk,yxvkc->yxvc", weights * weight, self._images[:, :, *pixel])
            for pixel, weight in self._pixel_neighbours(directions)
        )

    def irradiance(self, normals: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Irradiance (m, 3) of surfaces with normals (m, 3) at positions (m, 2)."""
        first, group = normal_groups(normals, _EQUAL_NORMALS)
        rows, columns, directions, _ = self.radiance.shape
        radiance = np.moveaxis(self.radiance, 2, 0).reshape(directions, -1)
        distinct = normals[first]
        grids = [
            cosine_weights(distinct[start : start + _NORMALS_AT_ONCE], self.directions, self.angles)
            @ radiance
            for start in range(0, len(first), _NORMALS_AT_ONCE)
        ]
        irradiance = np.concatenate(grids).reshape(-1, rows, columns, 3)
        return sum(  # type: ignore[return-value]
            irradiance[group, row, column] * weight[:, None]
            for (row, column), weight in self._grid_neighbours(positions)
        )


def _difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).max(initial=0.0))
