"""Frames that are rendered without waiting for the counts of their splats and pairs, and replayed.

The lists of a frame get the capacity that frames of this size of the cloud have needed so far, and an eighth
more. A frame that exceeds it is rendered again when it is read. From the third frame of a kind on, all stages
but the last are one captured command list: they have the same arguments, and what the host fills for their
views is in arrays that are filled before the replay.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.view import View
from fidsplat.backends.warp.command_list import CommandList, LaunchCache, Launcher
from fidsplat.backends.warp.frame import Capacity, DeviceFrame, ImageArrays
from fidsplat.backends.warp.images import Rendered
from fidsplat.backends.warp.memory_plan import MemoryPlanner
from fidsplat.backends.warp.program import Program
from fidsplat.backends.warp.resident import Resident
from fidsplat.backends.warp.runtime import load
from fidsplat.backends.warp.workspace import ArrayPool, Workspace

_SPARE = 256
"""added to a capacity, in addition to an eighth"""
_MAX_KINDS = 8
"""of frames of a cloud, that are cached"""


class RecordedFrame:
    """A frame whose stages but the last are a command list."""

    def __init__(self, frame: DeviceFrame, token: tuple[Any, ...], commands: CommandList) -> None:
        self.frame, self.token, self._commands = frame, token, commands
        # a cloud caches its recorded frames, and must not be kept alive by them
        frame.resident = weakref.proxy(frame.resident)

    @staticmethod
    def of(frame: DeviceFrame, token: tuple[Any, ...], launcher: Launcher) -> RecordedFrame | None:
        """Record a frame that was rendered; None where the device cannot capture. launcher: of one thread,
        without times."""
        before, frame.launcher = frame.launcher, launcher
        commands = CommandList.record(frame.workspace, frame.render)
        frame.launcher = before
        return None if commands is None else RecordedFrame(frame, token, commands)

    def replay(self, stack: ViewBatch) -> None:
        """Run all stages but the last for other views."""
        if len(stack) > 1 or stack.view is not self.frame.view:
            self.frame.set_views(stack)
        self._commands.submit()


@dataclass(eq=False)
class _CachedFrame:
    """A kind of frame of a cloud: of one size and number of views."""

    inputs: ArrayPool
    """filled by the host for the views"""
    capacity: Capacity
    token: tuple[Any, ...] = ()
    """dependencies of the last frame's launches"""
    recorded: RecordedFrame | None = None

    def release_arrays(self) -> None:
        """Release the arrays of the recorded frame."""
        self.recorded = None


class FrameRenderer:
    """Renders frames of one program, with cached capacities and command lists."""

    def __init__(self, program: Program, workspace: Workspace, launches: LaunchCache) -> None:
        self.program, self._workspace, self._launches = program, workspace, launches
        self.planner = MemoryPlanner(program, workspace)
        workspace.pool.holders.add(launches)
        self._cached: WeakKeyDictionary[Resident, dict[tuple[int, int, int], _CachedFrame]] = (
            WeakKeyDictionary()
        )

    def render_counted(
        self, resident: Resident, views: ViewBatch, into: ImageArrays, reserved: int
    ) -> tuple[DeviceFrame, Rendered]:
        """Render views, waiting for their counts.

        Args:
            into: arrays of the images.
            reserved: bytes on the device of the images of all views.
        """
        launcher = Launcher(self._launches)
        frame = DeviceFrame(self.program, self.planner, resident, views, launcher, reserved)
        self._workspace.frames += 1
        frame.render()
        if not views.view.sub_frames:
            self._update_capacity(resident, views, frame.stats["visible"], frame.stats["pairs"])
        frame.resolve(into, launcher)
        return frame, Rendered(launcher, frame.stats)

    def render(self, resident: Resident, views: ViewBatch, into: ImageArrays, reserved: int) -> Rendered:
        """Render views without waiting where a frame of their kind was rendered before."""
        workspace, view = self._workspace, views.view
        # adopted arrays may have changed by the time that a frame must be rendered again
        if not workspace.asynchronous or view.sub_frames or resident.adopted or not resident.count:
            return self.render_counted(resident, views, into, reserved)[1]
        cached = self._cached.get(resident, {}).get((view.width, view.height, len(views)))
        if cached is None:
            return self.render_counted(resident, views, into, reserved)[1]
        # other frames overwrite the inputs, and a failure leaves them undefined
        capacity, recorded, cached.recorded = cached.capacity, cached.recorded, None
        if recorded is not None and recorded.token == self._token(cached, view, reserved):
            recorded.replay(views)
            cached.recorded = recorded
            workspace.frames += 1
            launcher = Launcher(self._launches, timed=False)
            return self._pending(resident, views, capacity, recorded.frame, launcher, into, reserved)
        launcher = Launcher(self._launches)
        given = {"capacity": capacity, "inputs": cached.inputs}
        frame = DeviceFrame(self.program, self.planner, resident, views, launcher, reserved, **given)
        if not frame.fits(capacity):
            return self.render_counted(resident, views, into, reserved)[1]
        workspace.frames += 1
        frame.render()
        rendered = self._pending(resident, views, capacity, frame, launcher, into, reserved)
        self._record(cached, frame, reserved)
        return rendered

    def _pending(
        self,
        resident: Resident,
        views: ViewBatch,
        capacity: Capacity,
        frame: DeviceFrame,
        launcher: Launcher,
        into: ImageArrays,
        reserved: int,
    ) -> Rendered:
        """A frame whose counts are not known yet."""
        workspace, pool = self._workspace, frame.pool
        counts = pool.lend("totals", 2, load().int64)
        load().copy(counts, frame.named["totals"])
        frame.resolve(into, launcher)
        rendered = Rendered(launcher, {"splats": resident.count, "visible": 0, "pairs": 0})
        # a later frame may write there, even if this one is still running
        weakref.finalize(rendered, pool.give_back, "totals", counts)
        stats = rendered.counts  # not the object, which is freed at once if nothing reads the images

        def complete() -> Rendered | None:
            with workspace.failing("while rendering"):
                launcher.finish()
            with workspace.working("while rendering"):
                visible, pairs = counts.numpy().tolist()
                stats.update(visible=visible, pairs=pairs)
                self._update_capacity(resident, views, visible, pairs)
                if visible > capacity.visible or pairs > capacity.pairs:
                    return self.render_counted(resident, views, into, reserved)[1]
            return None

        def profile() -> Mapping[str, float]:
            """Measure the stages by rendering into other arrays, or into those of a batch."""
            with workspace.working("while rendering"):
                own = into
                if len(views) == 1:
                    own = ImageArrays({n: load().empty_like(a) for n, a in into.arrays.items()}, into.indices)
                return self.render_counted(resident, views, own, reserved)[1].timings()

        rendered.complete = complete
        if not launcher.timed:
            rendered.profile = profile
        return rendered

    def _record(self, cached: _CachedFrame, frame: DeviceFrame, reserved: int) -> None:
        """Record a frame whose launches equal those of the last of its kind."""
        token = self._token(cached, frame.view, reserved)
        workspace = self._workspace
        if workspace.replays and token == cached.token:
            launcher = Launcher(self._launches, timed=False, divided=False)
            cached.recorded = RecordedFrame.of(frame, token, launcher)
            workspace.pool.holders.add(cached)
        cached.token = token

    def _token(self, cached: _CachedFrame, view: View, reserved: int) -> tuple[Any, ...]:
        """Dependencies of launches, except the numbers of the views."""
        workspace, labels = self._workspace, tuple(label for label, _ in view.groups)
        budgets = workspace.memory_budget, workspace.pair_budget, reserved
        states = workspace.pool.state, cached.inputs.state
        return cached.capacity, budgets, states, view.raster, view.surroundings, labels

    def _update_capacity(self, resident: Resident, views: ViewBatch, visible: int, pairs: int) -> None:
        kinds, kind = self._cached.setdefault(resident, {}), (views.view.width, views.view.height, len(views))
        cached = kinds.get(kind)
        if cached is None:
            if len(kinds) >= _MAX_KINDS:
                kinds.clear()
            cached = kinds[kind] = _CachedFrame(ArrayPool(self._workspace.device), Capacity(-1, -1))
        before = cached.capacity
        if visible > before.visible or pairs > before.pairs:
            cached.capacity = Capacity(
                min(max(visible + visible // 8 + _SPARE, before.visible), len(views) * resident.count),
                max(pairs + pairs // 8 + _SPARE, before.pairs),
            )
