"""Frame replay: frames are rendered without waiting for their counts, from a captured command list.

The lists of a frame have the largest capacity that earlier frames of the same cloud and size needed, plus an
eighth. A frame that exceeds it is rendered again when it is read. From the third frame of a kind on, all
stages except resolve are one captured command list. Its arguments are constant: values that differ between
views are in input arrays, which the host fills before the replay.
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
"""constant added to a capacity, in addition to an eighth"""
_MAX_KINDS = 8
"""maximum number of kinds of frames that are cached for a cloud"""


class RecordedFrame:
    """A frame with its stages, except resolve, as a command list."""

    def __init__(self, frame: DeviceFrame, token: tuple[Any, ...], commands: CommandList) -> None:
        self.frame, self.token, self._commands = frame, token, commands
        # the cloud caches its recorded frames, so they must not keep it alive
        frame.resident = weakref.proxy(frame.resident)

    @staticmethod
    def of(frame: DeviceFrame, token: tuple[Any, ...], launcher: Launcher) -> RecordedFrame | None:
        """Record the launches of a rendered frame; None if the device cannot capture. launcher: a launcher
        with one thread that does not measure times."""
        before, frame.launcher = frame.launcher, launcher
        commands = CommandList.record(frame.workspace, frame.render)
        frame.launcher = before
        return None if commands is None else RecordedFrame(frame, token, commands)

    def replay(self, stack: ViewBatch) -> None:
        """Replay all stages except resolve for other views."""
        if len(stack) > 1 or stack.view is not self.frame.view:
            self.frame.set_views(stack)
        self._commands.submit()


@dataclass(eq=False)
class _CachedFrame:
    """Cache entry: a kind of frame of a cloud, with one image size and number of views."""

    inputs: ArrayPool
    """pool of the input arrays that the host fills for the views"""
    capacity: Capacity
    token: tuple[Any, ...] = ()
    """result of `_token` for the last frame"""
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
        """Render views and wait for their counts.

        Args:
            into: image arrays to fill.
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
        """Render views; without waiting if a frame of their kind was rendered before."""
        workspace, view = self._workspace, views.view
        # adopted arrays may change before a frame is rendered again, so these frames must wait
        if not workspace.asynchronous or view.sub_frames or resident.adopted or not resident.count:
            return self.render_counted(resident, views, into, reserved)[1]
        cached = self._cached.get(resident, {}).get((view.width, view.height, len(views)))
        if cached is None:
            return self.render_counted(resident, views, into, reserved)[1]
        # after a failure or another kind of frame the inputs are undefined
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
        """A submitted frame whose numbers of splats and pairs are compared with the capacities later."""
        workspace, pool = self._workspace, frame.pool
        counts = pool.lend("totals", 2, load().int64)
        load().copy(counts, frame.named["totals"])
        frame.resolve(into, launcher)
        rendered = Rendered(launcher, {"splats": resident.count, "visible": 0, "pairs": 0})
        # give the array back; a later frame may then use it
        weakref.finalize(rendered, pool.give_back, "totals", counts)
        stats = rendered.counts  # capture only the counts, so that the object can be released

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
        """Record a frame if its launches equal those of the previous frame of its kind."""
        token = self._token(cached, frame.view, reserved)
        workspace = self._workspace
        if workspace.replays and token == cached.token:
            launcher = Launcher(self._launches, timed=False, divided=False)
            cached.recorded = RecordedFrame.of(frame, token, launcher)
            workspace.pool.holders.add(cached)
        cached.token = token

    def _token(self, cached: _CachedFrame, view: View, reserved: int) -> tuple[Any, ...]:
        """Everything on which the launches depend, except the numbers of the views."""
        workspace, labels = self._workspace, tuple(label for label, _ in view.groups)
        budgets = workspace.memory_budget, workspace.pair_budget, reserved
        states = workspace.pool.state, cached.inputs.state
        external = view.external_depth and view.external_depth.depth.shape
        return cached.capacity, budgets, states, view.raster, view.surroundings, labels, external

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
