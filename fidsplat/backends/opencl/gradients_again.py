"""Pictures with derivatives that are launched again: a training draws thousands of one kind, and to plan each
takes the host longer than small ones take a GPU."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Iterable, Mapping, Set
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.counts import read_stats
from fidsplat.backends.opencl.device_frame import DeviceFrame, FrameBuffers
from fidsplat.backends.opencl.program import Program
from fidsplat.backends.opencl.resident import Resident
from fidsplat.backends.opencl.uniforms import scalars_of
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.view import View

_VIEWS = 256
"""whose records stay on the device"""
_ZERO = np.zeros(1, np.uint32)


@dataclass
class _Kind:
    """What one picture left to the next: no buffers, which the pool finds by their names."""

    picture: DeviceFrame
    """its numbers"""
    resident: weakref.ref[Resident]
    budgets: tuple[int, int]
    state: object
    """of the pool"""
    names: list[str]
    """of scratch buffers"""
    leases: list[tuple[str, int]]
    stages: list[str]
    """of the launches"""
    counted: int
    """which launch counts the pairs"""
    slots: np.ndarray


@dataclass
class _Back:
    """How a picture was taken back."""

    kind: _Kind
    given: frozenset[str]
    """outputs whose derivatives were on the device"""
    stages: list[str]


class Again:
    """The launches of the last picture that nobody waited for, and of its way back."""

    def __init__(self, workspace: Workspace, forward: Program, backward: Program) -> None:
        self._workspace = workspace
        self._forward, self._backward = CommandList(forward), CommandList(backward)
        self._kind: _Kind | None = None
        self._back: _Back | None = None
        self._last: tuple[Any, ...] = ()
        self._views: dict[int, tuple[View, cl.Buffer]] = {}
        """with their records on the device; views are held, so that no other is found by its number"""
        self._records: dict[bytes, cl.Buffer] = {}

    def record(self) -> CommandList:
        """An empty command list for the next picture, which `keep` may remember."""
        self._kind = None
        self._forward.clear()
        return self._forward

    def record_back(self) -> CommandList:
        """An empty command list for the next way back, which `keep_back` may remember."""
        self._back = None
        self._backward.clear()
        return self._backward

    def keep(self, picture: DeviceFrame) -> None:
        """Remembers a picture that was drawn, if the next can be launched as it was."""
        self._kind = self._back = None
        last, view = self._last, picture.view
        self._last = view.width, view.height, picture.pair_limit, weakref.ref(picture.resident)
        # what was no other a picture ago may stay so
        if self._last != last or picture.counted is None or picture.arrays.keys() != {"view", "slots"}:
            return
        pool, kernels = self._workspace.pool, self._forward.kernels
        of_views = ("uniform", "array")
        every = [one for name in kernels for one in picture.source.arguments[name]]
        if len(set(kernels)) < len(kernels) or any(one.source in of_views for one in every):
            return
        leased = dict(picture.leased)
        names = [name for name in picture.bound if name not in {"view", *leased}]
        if not self._there(names, picture):
            return
        base = copy(picture)
        base.buffers, base.named = FrameBuffers(), {}
        base.events, base.leased, base.uploads = [], [], []
        base.arrays, base.counted, base.stats = {}, None, dict
        base.resident = None  # pyright: ignore[reportAttributeAccessIssue]
        budgets = self._workspace.memory_budget, self._workspace.pair_budget
        self._kind = _Kind(
            base,
            weakref.ref(picture.resident),
            budgets,
            pool.state,
            names,
            [(name, buffer.size) for name, buffer in picture.leased],
            self._forward.stages,
            kernels.index("tile_starts"),
            picture.arrays["slots"],
        )

    def draw(self, resident: Resident, view: View, pairs: int) -> DeviceFrame | None:
        """The picture of another view, launched as the one that was kept; None where it does not fit."""
        kind, workspace = self._kind, self._workspace
        if kind is None or not self._fits(kind, resident, view, pairs):
            return None
        pool, queue = workspace.pool, workspace.switch_to(workspace.queue)
        workspace.pictures += 1
        picture = copy(kind.picture)
        picture.resident, picture.view = resident, view
        picture.arrays, picture.uploads = {}, []
        picture.leased = [(name, pool.lease(name, size)) for name, size in kind.leases]
        picture.buffers, picture.named = FrameBuffers(), {}
        picture.numbers = kind.picture.numbers | scalars_of(view)
        buffers = {"view": self._record(picture), **dict(picture.leased)}
        for name in kind.names:
            picture.bind(name, self._known(name))
        for name, buffer in buffers.items():
            picture.bind(name, buffer)
        given = buffers | scalars_of(view)
        picture.put("slots", kind.slots)  # pictures of other kinds have theirs in the same buffer
        tallies = pool.scratch("tallies", 0)  # which are not left as zeros
        cl.enqueue_fill_buffer(queue, tallies, _ZERO, 0, tallies.size)
        self._forward.set(given)
        events = self._forward.submit(queue)
        queue.flush()
        picture.events = list(zip(kind.stages, events, strict=True))
        picture.counted = events[kind.counted]
        counts = picture.buffers.counts
        picture.stats = partial(read_stats, workspace.read_queue, counts, events[-1], resident.count)
        return picture

    def keep_back(
        self,
        picture: DeviceFrame,
        given: Mapping[str, Any],
        wanted: Set[str],
    ) -> None:
        """Remembers how a picture was taken back.

        Args:
            given: the outputs' derivatives.
            wanted: names of the arguments that they are.
        """
        self._back, kind = None, self._kind
        on_device = all(isinstance(array, Array) for array in given.values())
        if kind is None or not on_device or not wanted <= {f"by_{name}" for name in given}:
            return
        # the picture's own scratch buffers are where they were, unless somebody has let go of all
        if not self._is_like(kind, picture) or not self._there(kind.names, picture):
            return
        kernels = self._backward.kernels
        if len(set(kernels)) < len(kernels):
            return
        kind.state = self._workspace.pool.state
        self._back = _Back(kind, frozenset(given), self._backward.stages)

    def take_back(self, picture: DeviceFrame, given: Mapping[str, Any], ask: Callable[[], None]) -> bool:
        """Launches the way back of a picture as that which was kept; whether it fits.

        ask: whether there was room for all pairs; called when all is launched.
        """
        back, pool = self._back, self._workspace.pool
        if back is None or back.kind is not self._kind or back.kind.state is not pool.state:
            return False
        if not self._is_like(back.kind, picture) or given.keys() != back.given:
            return False
        if not all(isinstance(array, Array) for array in given.values()):
            return False
        names = ("view", *(name for name, _ in back.kind.leases))
        held: dict[str, Any] = {name: picture.buffer(name) for name in names}
        held |= scalars_of(picture.view) | {"log_ceiling": math.log(picture.view.ceiling)}
        self._backward.set(held | {f"by_{name}": array.data for name, array in given.items()})
        queue = picture.queue
        cl.enqueue_fill_buffer(queue, pool.scratch("reserved", 4), _ZERO, 0, 4)
        events = self._backward.submit(queue)
        picture.events += zip(back.stages, events, strict=True)
        ask()
        return True

    def _fits(self, kind: _Kind, resident: Resident, view: View, pairs: int) -> bool:
        """Whether the picture of a view is launched as the one that was kept."""
        workspace, before = self._workspace, kind.picture.view
        return (
            kind.state is workspace.pool.state
            and kind.resident() is resident
            and pairs == kind.picture.pair_limit
            and (view.width, view.height, view.samples) == (before.width, before.height, before.samples)
            and kind.budgets == (workspace.memory_budget, workspace.pair_budget)
            and not (view.groups or view.sub_frames or view.raster or view.band)
        )

    def _is_like(self, kind: _Kind, picture: DeviceFrame) -> bool:
        """Whether a picture that was drawn is like the one that was kept."""
        same = (
            picture.pairs == kind.picture.pairs
            and picture.numbers["big_capacity"] == kind.picture.numbers["big_capacity"]
        )
        return (
            same
            and picture.counted is not None
            and self._fits(kind, picture.resident, picture.view, picture.pair_limit)
        )

    def _there(self, names: Iterable[str], picture: DeviceFrame) -> bool:
        """Whether a picture's buffers are those that the pool has by these names."""
        return all(picture.buffer(name) is self._workspace.pool.known(name) for name in names)

    def _known(self, name: str) -> cl.Buffer:
        """A scratch buffer that is there."""
        buffer = self._workspace.pool.known(name)
        assert buffer is not None  # while the pool's state is the same
        return buffer

    def _record(self, picture: DeviceFrame) -> cl.Buffer:
        """The record `View` of a picture on the device; those of other views stay there."""
        view = picture.view
        if id(view) not in self._views:
            if len(self._views) >= _VIEWS:
                self._views.clear()
                self._records.clear()
            record = picture.record(0, picture.rows)
            key = record.tobytes()
            if key not in self._records:
                self._records[key] = buffer = self._workspace.pool.fresh("a view", record.nbytes)
                cl.enqueue_copy(picture.queue, buffer, record)
            self._views[id(view)] = view, self._records[key]
        return self._views[id(view)][1]
