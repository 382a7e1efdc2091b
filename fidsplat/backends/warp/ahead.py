"""Pictures that are drawn without waiting for what their lists take: they have the room that the cloud's
pictures of that size have taken so far, and some more. Where that was too little, they are drawn again when
they are read. From the third of a kind on their launches are a graph (replay.py).
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

from fidsplat.backends.batched_views import ViewStack
from fidsplat.backends.view import View
from fidsplat.backends.warp.images import WarpImages
from fidsplat.backends.warp.launch import Commands, Launcher
from fidsplat.backends.warp.picture import Into, Picture, Room
from fidsplat.backends.warp.program import Program
from fidsplat.backends.warp.replay import Replay
from fidsplat.backends.warp.resident import Resident
from fidsplat.backends.warp.runtime import load
from fidsplat.backends.warp.workspace import ArrayPool, Workspace

_LEAST = 256
"""room is an eighth more than was taken, and so many more"""
_KINDS = 8
"""of a cloud's pictures that are kept"""


@dataclass(eq=False)
class _Kind:
    """What is known of a cloud's pictures of one size, so many views at once."""

    inputs: ArrayPool
    """what the host fills for them"""
    room: Room
    token: tuple[Any, ...] = ()
    """what the launches of the last depended on"""
    replay: Replay | None = None

    def forget(self) -> None:
        """Lets go of the arrays of its graph."""
        self.replay = None


class Drawing:
    """Draws pictures of one program, ahead where it can."""

    def __init__(self, program: Program, workspace: Workspace, commands: Commands) -> None:
        self.program, self._workspace, self._commands = program, workspace, commands
        workspace.pool.holders.add(commands)
        self._kinds: WeakKeyDictionary[Resident, dict[tuple[int, int, int], _Kind]] = WeakKeyDictionary()

    def picture(
        self, resident: Resident, stack: ViewStack, into: Into | None = None, beside: int = 0
    ) -> tuple[Picture, WarpImages]:
        """Pictures of these views, drawn once their counts are known.

        Args:
            into: where their images go; else a view's are made.
            beside: bytes on the device that belong to the batch of which they are a part.
        """
        launcher, beside = Launcher(self._commands), beside or self._image_bytes(stack.view)
        picture = Picture(self.program, self._workspace, resident, stack, launcher, beside)
        self._workspace.pictures += 1
        picture.draw()
        if not stack.view.sub_frames:
            self._learn(resident, stack, picture.stats["visible"], picture.stats["pairs"])
        return picture, self._resolved(picture, launcher, picture.stats, into)

    def images(
        self, resident: Resident, stack: ViewStack, into: Into | None = None, beside: int = 0
    ) -> WarpImages:
        """The same pictures' images, of which nobody has waited."""
        workspace, view = self._workspace, stack.view
        kind = self._kinds.get(resident, {}).get(_size(stack))
        # arrays that were adopted may be others when the picture has to be drawn again
        if kind is None or not workspace.ahead or view.sub_frames or resident.adopted or not resident.count:
            return self.picture(resident, stack, into, beside)[1]
        beside, room = beside or self._image_bytes(view), kind.room
        # whatever fills the inputs else, or fails while it fills them, leaves others there than it remembers
        replay, kind.replay = kind.replay, None
        if replay is not None and replay.token == self._token(kind, view, beside):
            replay.draw(stack)
            kind.replay = replay
            workspace.pictures += 1
            launcher = Launcher(self._commands, timed=False)
            return self._pending(resident, stack, room, replay.picture, launcher, into)
        launcher = Launcher(self._commands)
        given = {"beside": beside, "room": room, "inputs": kind.inputs}
        picture = Picture(self.program, workspace, resident, stack, launcher, **given)
        if not picture.fits(room):
            return self.picture(resident, stack, into, beside)[1]
        workspace.pictures += 1
        picture.draw()
        images = self._pending(resident, stack, room, picture, launcher, into)
        self._capture(kind, picture, beside)
        return images

    def _pending(
        self,
        resident: Resident,
        stack: ViewStack,
        room: Room,
        picture: Picture,
        launcher: Launcher,
        into: Into | None,
    ) -> WarpImages:
        """The images of a picture that was drawn with this room."""
        workspace, pool = self._workspace, picture.pool
        counts = pool.lend("totals", 2, load().int64)
        load().copy(counts, picture.held["totals"])
        stats = {"splats": resident.count, "visible": 0, "pairs": 0}
        images = self._resolved(picture, launcher, stats, into)
        # whoever has it next is written to later, even if this picture is not drawn yet
        weakref.finalize(images, pool.give_back, "totals", counts)
        where = images.into  # not the images: nobody may ever ask them, and then they go at once

        def settle() -> WarpImages | None:
            with workspace.failing("while drawing"):
                launcher.finish()
            with workspace.working("while drawing"):
                visible, pairs = counts.numpy().tolist()
                stats.update(visible=visible, pairs=pairs)
                self._learn(resident, stack, visible, pairs)
                if visible > room.visible or pairs > room.pairs:
                    return self.picture(resident, stack, where)[1]
            return None

        images.settle = settle
        if not launcher.timed:
            images.timed = self._timed(resident, stack, where)
        return images

    def _timed(self, resident: Resident, stack: ViewStack, where: Into) -> Callable[[], dict[str, float]]:
        """Tells what a picture's stages take, of which a graph says nothing: it is drawn once more, a batch's
        into the same images."""
        into = where if len(stack) > 1 else None

        def timings() -> dict[str, float]:
            with self._workspace.working("while drawing"):
                return self.picture(resident, stack, into)[1].timings

        return timings

    def _capture(self, kind: _Kind, picture: Picture, beside: int) -> None:
        """Captures what the picture has launched if the last of its kind has launched the same."""
        token = self._token(kind, picture.view, beside)
        workspace = self._workspace
        if workspace.replays and token == kind.token:
            launcher = Launcher(self._commands, timed=False, whole=True)
            kind.replay = Replay.of(picture, token, launcher)
            workspace.pool.holders.add(kind)
        kind.token = token

    def _token(self, kind: _Kind, view: View, beside: int) -> tuple[Any, ...]:
        """What launches depend on beside the numbers of the views: another one, others."""
        workspace, labels = self._workspace, tuple(label for label, _ in view.groups)
        budgets = workspace.memory_budget, workspace.pair_budget, beside
        states = workspace.pool.state, kind.inputs.state
        return kind.room, budgets, states, view.raster, view.surroundings, labels

    def _resolved(
        self, picture: Picture, launcher: Launcher, stats: dict[str, int], into: Into | None
    ) -> WarpImages:
        view = picture.view
        size = view.height // view.samples, view.width // view.samples
        into = into or self._fresh(size)
        launcher.stage("resolve")
        picture.resolve(into, launcher)
        launcher.stage(None)
        return WarpImages(self.program.images, into, size, launcher, stats)

    def _fresh(self, size: tuple[int, int]) -> Into:
        """Arrays for the images of one view, which the caller keeps."""
        wp, pool = load(), self._workspace.pool
        arrays = {
            one.name: pool.fresh(one.name, size[0] * size[1] * one.channels, getattr(wp, one.dtype))
            for one in self.program.images
        }
        return Into(arrays, self._workspace.first_slot)

    def _image_bytes(self, view: View) -> int:
        """What the images of one view take."""
        pixels = view.width * view.height // view.samples**2
        return 4 * pixels * sum(output.channels for output in self.program.images)

    def _learn(self, resident: Resident, stack: ViewStack, visible: int, pairs: int) -> None:
        kinds, size = self._kinds.setdefault(resident, {}), _size(stack)
        if size not in kinds and len(kinds) >= _KINDS:
            kinds.clear()
        new = size not in kinds
        kind = kinds.setdefault(size, _Kind(ArrayPool(self._workspace.device), Room(0, 0)))
        before = kind.room
        if new or visible > before.visible or pairs > before.pairs:
            kind.room = Room(
                min(max(visible + visible // 8 + _LEAST, before.visible), len(stack) * resident.count),
                max(pairs + pairs // 8 + _LEAST, before.pairs),
            )


def _size(stack: ViewStack) -> tuple[int, int, int]:
    return stack.view.width, stack.view.height, len(stack)
