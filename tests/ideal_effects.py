"""A perfectly printed marker under any lens, shutter, surroundings and sensor, in float64: how well a tag can
be localised there at all. No splats; poses, rays and the sensor's steps are those of the reference."""

from __future__ import annotations

from typing import Any

import numpy as np

import fidsplat as fs
from fidsplat.backends.prepare import view_of
from fidsplat.backends.reference.optics import ray_lengths, rays_of
from fidsplat.backends.reference.post import apply_sensor, background_at
from fidsplat.backends.view import View
from fidsplat.scenes import PlacedMarker


def ideal_image(
    placed: PlacedMarker,
    camera: fs.Camera,
    samples: int,
    background: Any = (0.0, 0.0, 0.0),
    *,
    motion: fs.Motion | None = None,
    shutter: fs.Shutter | None = None,
    sensor: fs.Sensor | None = None,
    fog: fs.Fog | None = None,
) -> np.ndarray:
    """(h, w, 3) float64 of the texture, quiet zone included; a pixel is the mean of samples x samples points.

    motion: groups by the marker's label.
    """
    quality = fs.Quality(samples=samples)
    motion, shutter = motion or fs.Motion(), shutter or fs.Shutter()
    view = view_of(
        fs.Capture(
            camera,
            quality=quality,
            background=background,
            motion=motion,
            shutter=shutter,
            sensor=sensor,
            fog=fog,
        ),
        np.zeros(3),
    )
    light = np.zeros((view.height, view.width, 3))
    for sub_frame in view.sub_frames:
        light[sub_frame.top : sub_frame.top + sub_frame.view.height] += sub_frame.weight * _samples(
            placed, sub_frame.view
        )
    if not view.sub_frames:
        light = _samples(placed, view)
    height, width = camera.height, camera.width
    pixels = light.reshape(height, samples, width, samples, 3).mean((1, 3)).reshape(-1, 3)
    y, x = (grid.ravel() for grid in np.mgrid[:height, :width])
    steps = () if sensor is None else sensor.steps
    return apply_sensor(pixels, np.zeros(len(x)), steps, view, x, y)[0].reshape(height, width, 3)


def assert_as_good(error, ideal, distance):
    """Within 1 % of the distance wherever the ideal plane is (errors in metres; inf: not found)."""
    assert error < 0.01 * distance or ideal >= 0.01 * distance, (error, ideal, distance)


_COARSE = 8
"""samples between those at which a window is looked for"""
_MARGIN = 8
"""modules around the texture that a window has besides: more than lie between two such samples"""


def _samples(placed: PlacedMarker, view: View) -> np.ndarray:
    """Values of the samples of one pose, (h, w, 3)."""
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    light = np.empty((view.height, view.width, 3))
    light[:] = view.background
    if view.environment_map is not None:
        light = background_at(view, x.ravel(), y.ravel())[0].reshape(light.shape)
    window = _window(placed, view)
    x, y = x[window].ravel(), y[window].ravel()
    place, along = _printed(placed, view, x, y)
    grid = placed.marker.grid
    column, row = np.floor(place[:, 0] + grid.shape[1] / 2), np.floor(place[:, 1] + grid.shape[0] / 2)
    on = (along > 0) & (column >= 0) & (row >= 0) & (column < grid.shape[1]) & (row < grid.shape[0])
    value = 1.0 - grid[row[on].astype(int), column[on].astype(int), None]
    left = np.exp(-view.fog_density * along[on] * ray_lengths(x[on], y[on], view))[:, None]
    light[window][on.reshape(light[window].shape[:2])] = left * value + (1 - left) * view.background
    return light


def _window(placed: PlacedMarker, view: View) -> tuple[slice, slice]:
    """Rows and columns outside which no sample sees the texture: a small part of a panorama."""
    y, x = np.mgrid[: view.height : _COARSE, : view.width : _COARSE] + 0.5
    place, along = _printed(placed, view, x.ravel(), y.ravel())
    near = (along > 0) & (np.abs(place) < np.array(placed.marker.grid.shape[::-1]) / 2 + _MARGIN).all(1)
    if not near.any():  # a band of rows that sees nothing of it
        return slice(0), slice(0)
    ends = [axes.ravel()[near] for axes in (y, x)]
    return tuple(slice(max(int(one.min()) - _COARSE, 0), int(one.max()) + _COARSE) for one in ends)


def _printed(placed: PlacedMarker, view: View, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays of samples x, y (n,) meet the texture's plane: (n, 2) in modules from its middle, and
    (n,) how far along the rays; NaN where a sample has no ray."""
    rays, seen = rays_of(view, x, y)
    moved = dict(view.groups).get(placed.label, view)
    rotation = moved.rotation @ placed.pose[:3, :3]
    middle = moved.rotation @ placed.pose[:3, 3] + moved.translation
    start = np.zeros_like(rays)
    if view.parallel:
        start[:, 0], start[:, 1] = (x - view.center_x) / view.focal_x, (y - view.center_y) / view.focal_y
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (middle - start) @ rotation[:, 2] / (rays @ rotation[:, 2])
        place = (start + along[:, None] * rays - middle) @ rotation[:, :2] / placed.marker.module
    return place, np.where(seen, along, np.nan)
