"""Pictures that are drawn without waiting for what their lists take: they have the room that the cloud's
pictures of that size have taken so far, and some more. Where that was too little, they are drawn again when
they are read.
"""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

from fidsplat.backends.view import View
from fidsplat.backends.warp.launch import Commands, Launcher
from fidsplat.backends.warp.picture import Picture, Room, WarpImages
from fidsplat.backends.warp.program import Program
from fidsplat.backends.warp.resident import Resident
from fidsplat.backends.warp.workspace import Workspace

_LEAST = 256
"""room is an eighth more than was taken, and so many more"""


class Drawing:
    """Draws pictures of one program, ahead where it can."""

    def __init__(self, program: Program, workspace: Workspace, commands: Commands) -> None:
        self.program, self._workspace, self._commands = program, workspace, commands
        self._rooms: WeakKeyDictionary[Resident, dict[tuple[int, int], Room]] = WeakKeyDictionary()

    def picture(self, resident: Resident, view: View, **given: Any) -> tuple[Picture, WarpImages]:
        """One picture, drawn once its counts are known; given: further arguments of `Picture`."""
        launcher = Launcher(self._commands)
        picture = Picture(self.program, self._workspace, resident, view, launcher, **given)
        images = picture.draw()
        if not view.shots:
            self._learn(resident, view, picture.stats["visible"], picture.stats["pairs"])
        return picture, images

    def images(self, resident: Resident, view: View, **given: Any) -> WarpImages:
        """The same picture's images, of which nobody has waited."""
        room = self._rooms.get(resident, {}).get((view.width, view.height))
        # arrays that were adopted may be others when the picture has to be drawn again
        if room is None or not self._workspace.ahead or view.shots or resident.adopted:
            return self.picture(resident, view, **given)[1]
        launcher = Launcher(self._commands)
        picture = Picture(self.program, self._workspace, resident, view, launcher, **given, room=room)
        if not picture.fits(room):
            return self.picture(resident, view, **given)[1]
        images = picture.draw()
        arrays = images.arrays  # not the images: nobody may ever ask them, and then they go at once

        def settle() -> WarpImages | None:
            with self._workspace.working("while drawing"):
                stats = picture.settle()
                self._learn(resident, view, stats["visible"], stats["pairs"])
                if stats["visible"] > room.visible or stats["pairs"] > room.pairs:
                    return self.picture(resident, view, **given | {"into": arrays})[1]
            return None

        images.settle = settle
        return images

    def _learn(self, resident: Resident, view: View, visible: int, pairs: int) -> None:
        rooms, size = self._rooms.setdefault(resident, {}), (view.width, view.height)
        before = rooms.get(size, Room(0, 0))
        if size not in rooms or visible > before.visible or pairs > before.pairs:
            rooms[size] = Room(
                min(max(visible + visible // 8 + _LEAST, before.visible), resident.count),
                max(pairs + pairs // 8 + _LEAST, before.pairs),
            )
