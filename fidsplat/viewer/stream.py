"""A stream of pictures to one browser: the newest viewpoint only, smaller while it moves, one exact picture
at rest, nothing while nothing changes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from fidsplat.util.errors import FidsplatError
from fidsplat.viewer.settings import Viewpoint

SMALLEST, STEPS = 1 / 4, 32
"""least scale, and in how many steps it goes to 1: buffers are not made again for every picture"""
REST = 0.15
"""seconds without a change after which the exact picture is drawn"""


@dataclass
class Pace:
    """How large pictures may be for a rate to be held: their time goes with their number of pixels."""

    rate: float = 30.0
    """pictures a second to aim at"""
    scale: float = 0.5

    def took(self, seconds: float, scale: float) -> None:
        """Learn from a picture of that scale."""
        aim = scale * (0.9 / self.rate / max(seconds, 1e-6)) ** 0.5
        # half of the way: one slow picture, when the machine does something else, is no reason for less
        self.scale = min(1.0, max(SMALLEST, (self.scale + aim) / 2))

    @property
    def steps(self) -> float:
        """The scale in whole steps."""
        return max(SMALLEST, int(self.scale * STEPS + 1e-9) / STEPS)


class Stream:
    """Decides what is drawn next for one browser.

    Args:
        moving: draws a picture from a viewpoint, that much smaller than the page, and returns what sends it:
            called in another thread, so that one picture is encoded while the next is drawn.
        rest: draws and sends the exact one, after all others.
        failed: told what went wrong with a picture; the stream goes on.
        rate: pictures a second to aim at while moving.
        clock: seconds.
    """

    def __init__(
        self,
        moving: Callable[[Viewpoint, float], Callable[[], object]],
        rest: Callable[[Viewpoint], object],
        failed: Callable[[str], object] = lambda words: None,
        rate: float = 30.0,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._moving, self._rest, self._failed, self._clock = moving, rest, failed, clock
        self.pace = Pace(rate)
        self._sender = ThreadPoolExecutor(1, "viewer sender")
        self._sending: Future[object] | None = None
        self._wake = threading.Condition()
        self._viewpoint: Viewpoint | None = None
        self._new = self._exact = self._closed = False
        self._since = -1e9

    def look(self, viewpoint: Viewpoint) -> None:
        """The browser looks from there now; what was not drawn yet is forgotten."""
        with self._wake:
            if viewpoint != self._viewpoint:
                self._viewpoint = viewpoint
                self._refresh()

    def refresh(self) -> None:
        """Something else has changed: draw again."""
        with self._wake:
            self._refresh()

    def _refresh(self) -> None:
        self._new, self._exact, self._since = True, False, self._clock()
        self._wake.notify_all()

    def step(self) -> float | None:
        """Draw what is due; returns the seconds until something may be due, None: when something changes."""
        with self._wake:
            viewpoint, new, left = self._viewpoint, self._new, REST - (self._clock() - self._since)
            if viewpoint is None or (not new and self._exact):
                return None
            if not new and left > 0:
                return left
            self._new = False
            self._exact = not new
        begun, scale = self._clock(), self.pace.steps
        try:
            if new:
                send = self._moving(viewpoint, scale)
                self._sent()
                self._sending = self._sender.submit(send)
            else:
                self._sent()
                self._rest(viewpoint)
        except (FidsplatError, MemoryError) as error:
            self._failed(str(error) or "not enough memory for this picture")
            return 0.0
        if new:
            self.pace.took(self._clock() - begun, scale)
        return 0.0

    def _sent(self) -> None:
        """Waits until the picture before is sent; raises what went wrong with it."""
        sending, self._sending = self._sending, None
        if sending is not None:
            sending.result()

    def run(self) -> None:
        """Draw until closed."""
        while True:
            wait = self.step()
            with self._wake:
                if self._closed:
                    self._sender.shutdown(wait=False)
                    return
                if wait is None:
                    self._wake.wait_for(lambda: self._closed or self._new)
                elif wait > 0:
                    self._wake.wait_for(lambda: self._closed or self._new, wait)

    def close(self) -> None:
        """Draw no more."""
        with self._wake:
            self._closed = True
            self._wake.notify_all()
