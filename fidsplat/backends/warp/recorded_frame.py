"""Frames that are rendered without waiting for the counts of their splats and pairs, and replayed.

The lists of a frame get the capacity that frames of this size of the cloud have needed so far, and an eighth
more. A frame that exceeds it is rendered again when it is read. From the third frame of a kind on, all stages
but the last are one captured command list: they have the same arguments, and what the host fills for their
views is in arrays that are filled before the replay.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.view import View
from fidsplat.backends.warp.command_list import CommandList, LaunchCache, Launcher
from fidsplat.backends.warp.frame import Capacity, DeviceFrame, ImageArrays
from fidsplat.backends.warp.images import WarpImages
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
        workspace.pool.holders.add(launches)
        self._cached: WeakKeyDictionary[Resident, dict[tuple[int, int, int], _CachedFrame]] = (
            WeakKeyDictionary()
        )

    def render_counted(
        self, resident: Resident, stack: ViewBatch, into: ImageArrays | None = None, reserved: int = 0
    ) -> tuple[DeviceFrame, WarpImages]:
        """Render views, waiting for their counts.

        Args:
            into: arrays of the images; by default new ones for one view.
            reserved: bytes on the device of the batch of which they are a part.
        """
        launcher, reserved = Launcher(self._launches), reserved or self._image_bytes(stack.view)
        frame = DeviceFrame(self.program, self._workspace, resident, stack, launcher, reserved)
        self._workspace.frames += 1
        frame.render()
        if not stack.view.sub_frames:
            self._update_capacity(resident, stack, frame.stats["visible"], frame.stats["pairs"])
        return frame, self._resolved(frame, launcher, frame.stats, into)

    def render(
        self, resident: Resident, stack: ViewBatch, into: ImageArrays | None = None, reserved: int = 0
    ) -> WarpImages:
        """Render views without waiting where a frame of their kind was rendered before."""
        workspace, view = self._workspace, stack.view
        cached = self._cached.get(resident, {}).get(_kind(stack))
        # adopted arrays may have changed by the time that a frame must be rendered again
        adopted = resident.adopted or not resident.count
        if cached is None or not workspace.asynchronous or view.sub_frames or adopted:
            return self.render_counted(resident, stack, into, reserved)[1]
        reserved, capacity = reserved or self._image_bytes(view), cached.capacity
        # other frames overwrite the inputs, and a failure leaves them undefined
        recorded, cached.recorded = cached.recorded, None
        if recorded is not None and recorded.token == self._token(cached, view, reserved):
            recorded.replay(stack)
            cached.recorded = recorded
            workspace.frames += 1
            launcher = Launcher(self._launches, timed=False)
            return self._pending(resident, stack, capacity, recorded.frame, launcher, into)
        launcher = Launcher(self._launches)
        given = {"reserved": reserved, "capacity": capacity, "inputs": cached.inputs}
        frame = DeviceFrame(self.program, workspace, resident, stack, launcher, **given)
        if not frame.fits(capacity):
            return self.render_counted(resident, stack, into, reserved)[1]
        workspace.frames += 1
        frame.render()
        images = self._pending(resident, stack, capacity, frame, launcher, into)
        self._record(cached, frame, reserved)
        return images

    def _pending(
        self,
        resident: Resident,
        stack: ViewBatch,
        capacity: Capacity,
        frame: DeviceFrame,
        launcher: Launcher,
        into: ImageArrays | None,
    ) -> WarpImages:
        """Images of a frame whose counts are not known yet."""
        workspace, pool = self._workspace, frame.pool
        counts = pool.lend("totals", 2, load().int64)
        load().copy(counts, frame.named["totals"])
        stats = {"splats": resident.count, "visible": 0, "pairs": 0}
        images = self._resolved(frame, launcher, stats, into)
        # a later frame may write there, even if this one is still running
        weakref.finalize(images, pool.give_back, "totals", counts)
        arrays = images.into  # not the images, which are freed at once if nothing reads them

        def settle() -> WarpImages | None:
            with workspace.failing("while rendering"):
                launcher.finish()
            with workspace.working("while rendering"):
                visible, pairs = counts.numpy().tolist()
                stats.update(visible=visible, pairs=pairs)
                self._update_capacity(resident, stack, visible, pairs)
                if visible > capacity.visible or pairs > capacity.pairs:
                    return self.render_counted(resident, stack, arrays)[1]
            return None

        images.settle = settle
        if not launcher.timed:
            images.profile = self._profiler(resident, stack, arrays)
        return images

    def _profiler(
        self, resident: Resident, stack: ViewBatch, arrays: ImageArrays
    ) -> Callable[[], dict[str, float]]:
        """A function that measures the stages of a replayed frame by rendering it again, a batch into the
        same images."""
        into = arrays if len(stack) > 1 else None

        def timings() -> dict[str, float]:
            with self._workspace.working("while rendering"):
                return self.render_counted(resident, stack, into)[1].timings

        return timings

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

    def _resolved(
        self, frame: DeviceFrame, launcher: Launcher, stats: dict[str, int], into: ImageArrays | None
    ) -> WarpImages:
        view = frame.view
        size = view.height // view.samples, view.width // view.samples
        into = into or self._new_arrays(size)
        launcher.stage("resolve")
        frame.resolve(into, launcher)
        launcher.stage(None)
        return WarpImages(self.program.images, into, size, launcher, stats)

    def _new_arrays(self, size: tuple[int, int]) -> ImageArrays:
        """New arrays for the images of one view."""
        wp, pool = load(), self._workspace.pool
        arrays = {
            one.name: pool.fresh(one.name, size[0] * size[1] * one.channels, getattr(wp, one.dtype))
            for one in self.program.images
        }
        return ImageArrays(arrays, self._workspace.first_index)

    def _image_bytes(self, view: View) -> int:
        """Bytes of the images of one view."""
        pixels = view.width * view.height // view.samples**2
        return 4 * pixels * sum(output.channels for output in self.program.images)

    def _update_capacity(self, resident: Resident, stack: ViewBatch, visible: int, pairs: int) -> None:
        kinds, kind = self._cached.setdefault(resident, {}), _kind(stack)
        if kind not in kinds and len(kinds) >= _MAX_KINDS:
            kinds.clear()
        new = kind not in kinds
        cached = kinds.setdefault(kind, _CachedFrame(ArrayPool(self._workspace.device), Capacity(0, 0)))
        before = cached.capacity
        if new or visible > before.visible or pairs > before.pairs:
            cached.capacity = Capacity(
                min(max(visible + visible // 8 + _SPARE, before.visible), len(stack) * resident.count),
                max(pairs + pairs // 8 + _SPARE, before.pairs),
            )


def _kind(stack: ViewBatch) -> tuple[int, int, int]:
    return stack.view.width, stack.view.height, len(stack)
