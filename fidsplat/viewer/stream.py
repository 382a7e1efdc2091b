"""Image stream to one browser: small images of the newest viewpoint while it moves, and one exact image at
rest."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from fidsplat.util.errors import FidsplatError
from fidsplat.viewer.settings import Viewpoint

MIN_SCALE, SCALE_STEPS = 1 / 4, 32
"""minimum scale, and number of steps up to 1; few different sizes, so that buffers are reused"""
REST_DELAY = 0.15
"""time without a change before the exact image is rendered [s]"""


@dataclass
class Pace:
    """Controller of the image scale for a frame rate; assumes a time proportional to the number of pixels."""

    rate: float = 30.0
    """target frames per second"""
    scale: float = 0.5

    def update(self, seconds: float, scale: float) -> None:
        """Adapt the scale by the measured time of an image. scale: scale of this image."""
        aim = scale * (0.9 / self.rate / max(seconds, 1e-6)) ** 0.5
        # half of the change, since other processes may have slowed this image
        self.scale = min(1.0, max(MIN_SCALE, (self.scale + aim) / 2))

    @property
    def step_scale(self) -> float:
        """The scale rounded down to a step."""
        return max(MIN_SCALE, int(self.scale * SCALE_STEPS + 1e-9) / SCALE_STEPS)


class Stream:
    """Image scheduler of one browser.

    Args:
        moving: renders a viewpoint at a scale and returns a function that sends the image. The function runs
            in another thread, so that one image is encoded while the next one is rendered.
        rest: renders and sends the exact image.
        failed: called with an error message; the stream continues.
        rate: target frames per second while moving.
        clock: time in seconds.
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

    def set_viewpoint(self, viewpoint: Viewpoint) -> None:
        """Set the newest viewpoint; a previous one that is not rendered yet is dropped."""
        with self._wake:
            if viewpoint != self._viewpoint:
                self._viewpoint = viewpoint
                self._refresh()

    def refresh(self) -> None:
        """Render the viewpoint again after a change of the scene or the settings."""
        with self._wake:
            self._refresh()

    def _refresh(self) -> None:
        self._new, self._exact, self._since = True, False, self._clock()
        self._wake.notify_all()

    def step(self) -> float | None:
        """Render the image that is due. Returns the seconds until the next image, or None to wait for a
        change."""
        with self._wake:
            viewpoint, new, left = self._viewpoint, self._new, REST_DELAY - (self._clock() - self._since)
            if viewpoint is None or (not new and self._exact):
                return None
            if not new and left > 0:
                return left
            self._new = False
            self._exact = not new
        begun, scale = self._clock(), self.pace.step_scale
        try:
            if new:
                send = self._moving(viewpoint, scale)
                self._wait_sent()
                self._sending = self._sender.submit(send)
            else:
                self._wait_sent()
                self._rest(viewpoint)
        except (FidsplatError, MemoryError) as error:
            self._failed(str(error) or "not enough memory for this image")
            return 0.0
        if new:
            self.pace.update(self._clock() - begun, scale)
        return 0.0

    def _wait_sent(self) -> None:
        """Wait until the previous image is sent, and raise its error."""
        sending, self._sending = self._sending, None
        if sending is not None:
            sending.result()

    def run(self) -> None:
        """Render until the stream is closed."""
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
        with self._wake:
            self._closed = True
            self._wake.notify_all()
