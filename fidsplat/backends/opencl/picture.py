"""The buffers and launches of one picture: what its stages and its lists of splats share."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.declare import Argument
from fidsplat.backends.opencl.memory_plan import MemoryPlan
from fidsplat.backends.opencl.program import Program
from fidsplat.backends.opencl.resident import Resident
from fidsplat.backends.opencl.shapes import DeviceShape
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.view import View

_GRID = (16, 4)
"""the work-group of kernels over pixels or samples"""


class Picture:
    """One picture on its way: what its kernels read and write, by the names of their arguments."""

    def __init__(
        self,
        workspace: Workspace,
        program: Program,
        shape: DeviceShape,
        resident: Resident,
        view: View,
        plan: MemoryPlan,
    ) -> None:
        self.workspace, self.program, self.shape = workspace, program, shape
        self.resident, self.view, self.plan = resident, view, plan
        self.queue, self.pool = workspace.queue, workspace.pool
        self.tiles_x = -(-view.width // shape.tile_width)
        self.tiles_y = -(-view.height // shape.tile_height)
        self.tiles = self.tiles_x * self.tiles_y
        self.stride = self.tiles_x * shape.tile_width
        self.rows = self.tiles_y * shape.tile_height
        self.held: dict[str, Any] = {
            "width": view.width,
            "height": view.height,
            "stride": self.stride,
            "plane": self.rows * self.stride,
        }
        """buffers and numbers by the names of the arguments that take them"""
        self.events: list[tuple[str, cl.Event]] = []
        self.uploads: list[cl.Event] = []
        self.leased: list[tuple[str, cl.Buffer]] = []
        self.stats: Callable[[], dict[str, int]] = dict
        self._uniforms = cache(view.uniform)

    def launch(self, stage: str, kernel: str, items: int, group: int, **given: Any) -> cl.Event:
        """One-dimensional launch of at least `items` work-items; the kernels check their index.

        Arguments are given here, or held by the picture, or numbers and arrays of its view.
        """
        return self._launch(stage, kernel, (-(-items // group) * group,), (group,), given)

    def launch_grid(self, stage: str, kernel: str, width: int, height: int, **given: Any) -> cl.Event:
        """Launch of a work-item for each pixel or sample, which the kernel knows as `width` and `height`."""
        size = (-(-width // _GRID[0]) * _GRID[0], -(-height // _GRID[1]) * _GRID[1])
        return self._launch(stage, kernel, size, _GRID, given | {"width": width, "height": height})

    def _launch(
        self, stage: str, kernel: str, size: tuple[int, ...], group: tuple[int, ...], given: dict[str, Any]
    ) -> cl.Event:
        arguments = self.program.source.arguments[kernel]
        values = [given[one.name] if one.name in given else self._value(one) for one in arguments]
        event = self.program.launch(kernel, size, group, values)
        self.events.append((stage, event))
        return event

    def _value(self, argument: Argument) -> Any:
        if argument.source == "uniform":
            name, place = argument.uniform
            return self._uniforms(name)[place]
        if argument.source == "array" and argument.name not in self.held:
            return self.put(argument.name, self.view.array(argument.name))
        return self.held[argument.name]

    def read(self, name: str, dtype: Any, shape: tuple[int, ...]) -> np.ndarray:
        """The contents of a buffer; waits for the device."""
        array = np.empty(shape, dtype)
        if array.size:
            cl.enqueue_copy(self.queue, array, self.held[name])
        return array

    def take(self, name: str, size: int) -> cl.Buffer:
        """A scratch buffer that this picture calls `name`."""
        self.held[name] = buffer = self.pool.scratch(name, size)
        return buffer

    def lease(self, name: str, size: int) -> cl.Buffer:
        """A buffer that is this picture's own until its images are not needed any more."""
        self.held[name] = buffer = self.pool.lease(name, size)
        self.leased.append((name, buffer))
        return buffer

    def put(self, name: str, array: np.ndarray) -> cl.Buffer:
        """A scratch buffer with these contents; does not wait. What the last picture put there and nobody can
        change (a panorama) is not copied again."""
        if (held := self.pool.holding(name, array)) is not None:
            self.held[name] = held
            return held
        buffer = self.take(name, array.nbytes)
        self.uploads.append(cl.enqueue_copy(self.queue, buffer, array, is_blocking=False))
        self.pool.now_holds(name, array)
        return buffer

    def put_view(self, row: int, end: int) -> None:
        """The uniforms of the projection, for rows of samples [row, end)."""
        view, record = self.view, self.program.source.records["View"]
        self.put_rays()
        views = [_uniforms(each, row, end, record) for each in (view, *(of for _, of in view.groups))]
        self.put("view", np.concatenate(views))
        if view.groups:
            self.put("moving", np.array([len(view.groups), *(label for label, _ in view.groups)], np.int32))
        if self.resident.planes is not None:
            self.put("plane_keys", self.resident.planes.keys(view))

    def put_rays(self) -> None:
        """What the kernels read of a lens: rays of the samples, and the map of directions."""
        if self.view.raster is not None:
            slopes = any(one.name == "ray_slopes" for one in self.program.source.arguments["blend"])
            self.held |= self.workspace.ray_buffers.of(self.view.raster, self.rows, self.stride, slopes)


def _uniforms(view: View, row: int, end: int, record: np.dtype) -> np.ndarray:
    """(1,) of the record `View` (layout.py) for rows of samples [row, end)."""
    made = np.zeros(1, record)
    values = {
        **{"rotation": view.rotation.ravel(), "translation": view.translation, "eye": view.eye},
        **{
            "focal_x": view.focal_x,
            "focal_y": view.focal_y,
            "center_x": view.center_x,
            "center_y": view.center_y,
        },
        **{"near": view.near, "far": view.far, "log_cut": view.log_cut},
        **{"width": view.width, "height": view.height, "filter": 1.0 / view.samples**2},
        **{"band": row, "band_end": end},
    }
    if "slopes" in (record.names or ()):
        values["slopes"] = view.slopes
    if view.raster is not None:
        # lens, then map, as the record has them behind its own
        own = [name for name in record.names or () if name not in values]
        numbers = iter(view.raster.uniforms)
        for name in own:
            shape = record[name].shape
            values[name] = [next(numbers) for _ in range(shape[0])] if shape else next(numbers)
    for name, value in values.items():
        made[name] = value
    return made
