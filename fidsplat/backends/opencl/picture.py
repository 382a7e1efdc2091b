"""The buffers and launches of one picture: what its stages and its lists of splats share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.batched_views import ViewStack
from fidsplat.backends.opencl.assemble import Source
from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.declare import Argument
from fidsplat.backends.opencl.memory_plan import MemoryPlan
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
        commands: CommandList,
        shape: DeviceShape,
        resident: Resident,
        view: View,
        plan: MemoryPlan,
        queue: cl.CommandQueue | None = None,
        stack: ViewStack | None = None,
        trusted: int = 0,
    ) -> None:
        """
        Args:
            commands: records what is launched.
            queue: where it is drawn without waiting for the device, as one of its kind was drawn before; None
                for the first of its kind.
            stack: many views instead of one, with all in common that they do not say.
            trusted: pairs of splats and tiles for which room is made without asking the device how many there
                are, if there is room for so many anyway (`TiledLists`); 0: it is asked.
        """
        self.workspace, self.commands, self.shape = workspace, commands, shape
        self.resident, self.view, self.plan, self.repeats = resident, view, plan, queue is not None
        self.stack, self.views = stack, 1 if stack is None else len(stack)
        self.queue = workspace.turn_to(workspace.queue) if queue is None else queue
        self.pool = workspace.pool
        workspace.pictures += 1
        self.tiles_x = -(-view.width // shape.tile_width)
        self.tiles_y = -(-view.height // shape.tile_height)
        self.tiles = self.views * self.tiles_x * self.tiles_y
        """of all views, one after the other"""
        self.stride = self.tiles_x * shape.tile_width
        self.rows = self.tiles_y * shape.tile_height
        self._numbers = numbers_of(view)
        self.held: dict[str, Any] = self._numbers | {
            "width": view.width,
            "height": view.height,
            "stride": self.stride,
            "channel_stride": self.views * self.rows * self.stride,
        }
        """buffers and numbers by the names of the arguments that take them"""
        self.events: list[tuple[str, cl.Event]] = []
        self.arrays: dict[str, np.ndarray] = {}
        """what was put on the device for this view"""
        self.uploads: list[cl.Event] = []
        self.leased: list[tuple[str, cl.Buffer]] = []
        self.trusted = trusted
        self.counted: cl.Event | None = None
        """when the device will have counted the pairs, where it was not asked"""
        self.in_bands = False
        """whether its lists were too long for one band"""
        self.pairs = 0
        """of splats and tiles that were listed, where the host has been told; else for which there is room"""
        self.stats: Callable[[], dict[str, int]] = dict
        self._uniforms: dict[str, tuple[Any, ...]] = {}

    @property
    def source(self) -> Source:
        """The source of the program whose kernels are launched."""
        return self.commands.program.source

    def launch(
        self, stage: str, kernel: str, items: int, group: int, views: int = 1, **given: Any
    ) -> cl.Event:
        """Launch of at least `items` work-items, for each of so many views; the kernels check their index.

        Arguments are given here, or held by the picture, or numbers and arrays of its view.
        """
        size = -(-items // group) * group
        if views == 1:
            return self._launch(stage, kernel, (size,), (group,), given)
        return self._launch(stage, kernel, (size, views), (group, 1), given)

    def launch_grid(self, stage: str, kernel: str, width: int, height: int, **given: Any) -> cl.Event:
        """Launch of a work-item for each pixel or sample of each view; the kernel knows how many there are as
        `width` and `height`."""
        size = (-(-width // _GRID[0]) * _GRID[0], -(-height // _GRID[1]) * _GRID[1])
        given |= {"width": width, "height": height}
        if self.views == 1:
            return self._launch(stage, kernel, size, _GRID, given)
        return self._launch(stage, kernel, (*size, self.views), (*_GRID, 1), given)

    def _launch(
        self, stage: str, kernel: str, size: tuple[int, ...], group: tuple[int, ...], given: dict[str, Any]
    ) -> cl.Event:
        arguments = self.source.arguments[kernel]
        values = [given[one.name] if one.name in given else self.value(one) for one in arguments]
        event = self.commands.launch(self.queue, kernel, size, group, values, stage)
        self.events.append((stage, event))
        return event

    def is_of_view(self, argument: Argument) -> bool:
        """Whether an argument is a number that changes with the view."""
        return argument.source == "uniform" or argument.name in self._numbers

    def put_arrays(self) -> None:
        """The view's arrays that kernels take."""
        for arguments in self.source.arguments.values():
            for one in arguments:
                if one.source == "array":
                    self.value(one)

    def value(self, argument: Argument) -> Any:
        """What a kernel is given for an argument that is not given where it is launched."""
        if argument.source == "uniform":
            name, place = argument.uniform
            if name not in self._uniforms:
                self._uniforms[name] = self.view.uniform(name)
            return self._uniforms[name][place]
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
        """A scratch buffer with these contents; does not wait."""
        self.arrays[name] = array
        self.held[name], event = self.pool.put(self.queue, name, array)
        if event is not None:
            self.uploads.append(event)
        return self.held[name]

    def put_view(self, row: int, end: int) -> None:
        """The uniforms of the projection, for rows of samples [row, end), of those that are wanted."""
        view = self.view
        if view.band is not None:
            row, end = max(row, view.band[0]), min(end, view.band[1])
        self.put_rays()
        self.put("view", _kept(self.record(row, end)))
        if view.groups:
            moving = np.array([len(view.groups), *(label for label, _ in view.groups)], np.int32)
            self.put("moving", _kept(moving))
        if self.resident.group_table is not None:
            table, stack = self.resident.group_table, self.stack
            # (groups, views), in memory of its own
            keys = table.keys(view) if stack is None else table.keys_of(stack).T.copy()
            self.put("plane_keys", _kept(keys))

    def record(self, row: int, end: int) -> np.ndarray:
        """The record `View` for rows of samples [row, end)."""
        return packed(self.stack or self.view, row, end, self.source.records["View"])

    def put_rays(self) -> None:
        """What the kernels read of a lens: rays of the samples, and the map of directions."""
        if self.view.raster is not None:
            slopes = any(one.name == "ray_slopes" for one in self.source.arguments["blend"])
            self.held |= self.workspace.ray_buffers.of(self.view.raster, self.rows, self.stride, slopes)


def numbers_of(view: View) -> dict[str, float]:
    """Numbers of a view that kernels take, beside its uniforms, by the names of their arguments."""
    red, green, blue = view.background
    return {
        **{"log_cut": view.log_cut, "ceiling": view.ceiling, "stop": view.stop},
        **{"filter": 1.0 / view.samples**2},
        **{"background_r": red, "background_g": green, "background_b": blue},
    }


def _kept(array: np.ndarray) -> np.ndarray:
    """The array, which nobody changes any more: what the device has of it need not be copied again."""
    array.flags.writeable = False
    return array


def packed(views: View | ViewStack, row: int, end: int, record: np.dtype) -> np.ndarray:
    """(groups that move + 1, views) of the record `View` (layout.py) for rows of samples [row, end); of one
    view their numbers in one row."""
    real = record[0].base  # all members have one type
    if isinstance(views, View):
        every = [views, *(of for _, of in views.groups)]
        return np.array([number for each in every for number in _numbers(each, row, end, record)], real)
    made = np.empty(views.translation.shape[:2], record)
    made[:] = np.array(_numbers(views.view, row, end, record), real).view(record)
    made["rotation"] = views.rotation.reshape(*made.shape, 9)
    made["translation"], made["eye"] = views.translation, views.eye
    for name, values in views.numbers.items():
        if name in (record.names or ()):
            made[name] = values
    return made


def _numbers(view: View, row: int, end: int, record: np.dtype) -> list[float]:
    """Of the record `View` of one view, in their order."""
    values: dict[str, Any] = {
        **{"rotation": view.rotation.ravel().tolist(), "translation": view.translation.tolist()},
        **{"eye": view.eye.tolist(), "focal_x": view.focal_x, "focal_y": view.focal_y},
        **{"center_x": view.center_x, "center_y": view.center_y, "near": view.near, "far": view.far},
        **{"log_cut": view.log_cut, "width": view.width, "height": view.height},
        **{"filter": 1.0 / view.samples**2, "band": row, "band_end": end, "slopes": view.slopes},
    }
    # of a lens, then of its map, as the record has them behind its own
    lens = iter(() if view.raster is None else view.raster.uniforms)
    flat: list[float] = []
    for name in record.names or ():
        if name in values:
            value = values[name]
            flat += value if isinstance(value, (list, tuple)) else (value,)
        else:
            flat += (next(lens) for _ in range(record[name].shape[0] if record[name].shape else 1))
    return flat
