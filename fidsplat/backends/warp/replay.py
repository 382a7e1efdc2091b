"""The launches of a picture as a graph, launched again for the next of its kind.

A picture of a kind that was drawn before launches the same kernels with the same arguments, but for the
images that it gives away: what the host fills for its views stands in arrays, which are filled before. So all
stages but the last are captured once, as a CUDA graph, and one launch draws them. (On the CPU Warp keeps a
list of what one thread launches, which is how this is tested without a GPU.)
"""

from __future__ import annotations

import warnings
import weakref
from typing import Any

from fidsplat.backends.batched_views import ViewStack
from fidsplat.backends.warp.launch import Launcher
from fidsplat.backends.warp.picture import Picture
from fidsplat.backends.warp.runtime import load
from fidsplat.backends.warp.workspace import Workspace


class Replay:
    """The stages of one picture, captured."""

    def __init__(self, picture: Picture, token: tuple[Any, ...], graph: Any) -> None:
        self.picture, self.token, self._graph = picture, token, graph

    @staticmethod
    def of(picture: Picture, token: tuple[Any, ...], launcher: Launcher) -> Replay | None:
        """Of a picture that was drawn, whose arrays are all there; None where the device captures nothing:
        that is said once, and no more is tried.

        launcher: for one thread, without times.
        """
        workspace, before = picture.workspace, picture.launcher
        picture.launcher = launcher
        try:
            graph = _captured(workspace, picture.draw)
        except RuntimeError as error:
            workspace.replays = False
            warnings.warn(
                f"{workspace.name} captures no graphs ({str(error).strip()}); each picture's kernels are "
                "launched one by one, with the same bits",
                stacklevel=2,
            )
            return None
        finally:
            picture.launcher = before
        # the splats are not kept by what is kept as long as they are
        picture.resident = weakref.proxy(picture.resident)
        return Replay(picture, token, graph)

    def draw(self, stack: ViewStack) -> None:
        """All stages but the last, for these views."""
        if len(stack) > 1 or stack.view is not self.picture.view:
            self.picture.turn_to(stack)
        load().capture_launch(self._graph)


def _captured(workspace: Workspace, draw: Any) -> Any:
    """What `draw` launches, as a graph; nothing is drawn."""
    wp, device = load(), workspace.device
    # a stream of its own: one that a user has set may be one that cannot be captured
    with wp.ScopedStream(workspace.capturing(), sync_enter=False):
        wp.capture_begin(device=device)
        try:
            draw()
        except BaseException:
            _ended(wp, device)
            raise
        return wp.capture_end(device=device)


def _ended(wp: Any, device: Any) -> None:
    """Ends a capture that failed, whatever that says."""
    try:
        wp.capture_end(device=device)
    except RuntimeError:
        return
