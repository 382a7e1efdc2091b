"""One picture by several devices: each draws a band of its rows, from the splats that the band sees."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import cycle, pairwise
from queue import SimpleQueue
from threading import Thread
from typing import Any

import numpy as np

from fidsplat.backends.interface import Images
from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture, output_names
from fidsplat.capture.quality import Quality
from fidsplat.render.frame import Frame
from fidsplat.render.renderer import Renderer
from fidsplat.render.resident import ResidentCloud
from fidsplat.scenes import Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.store.store import Store
from fidsplat.util.arguments import invalid, items
from fidsplat.util.errors import InputError

_UNEVEN = 1.1
"""how many times as long as the mean the slowest band may take before the bands are cut again"""

_AHEAD = 3
"""pictures that each device is asked for before the first of them is waited for: one that is brought to the
host, one that is drawn, and one whose chunks are fetched"""


class SeveralDevices:
    """Draws pictures with several devices of one kind, each a band of rows; a picture has the bits that one
    device gives it.

    Bands are cut so that all take as long, by the time that those of the last picture took. Of a store a
    device holds the chunks that its band sees; of a cloud in memory each holds all.

    Args:
        devices: names as of `fs.Renderer`, e.g. ["opencl:nvidia", "opencl:nvidia-2"]; one may stand there
            twice.
        memory_budget: bytes, of each device.

    Raises:
        InputError: no device, or devices of different kinds, whose pictures differ in their last bits.
        DeviceError: as `fs.Renderer`.
    """

    def __init__(self, devices: Iterable[str], memory_budget: int | None = None) -> None:
        names = items("devices", [devices] if isinstance(devices, str) else devices, str, "names of devices")
        if not names:
            raise InputError("devices is empty; name one device at least, e.g. ['opencl']")
        self.renderers = [Renderer(name, memory_budget) for name in names]
        titles = {renderer.device.title for renderer in self.renderers}
        if len(titles) > 1:
            raise InputError(
                f"devices are of different kinds ({', '.join(sorted(titles))}), whose pictures differ in "
                "their last bits; name devices of one kind"
            )
        self._shares = np.linspace(0.0, 1.0, len(names) + 1)
        """where bands end, in parts of the picture's height"""
        self._pool = ThreadPoolExecutor(len(names), "fidsplat-device")

    def upload(self, scene: Scene | SplatCloud | Store) -> list[ResidentCloud]:
        """A scene on all devices, for `render`."""
        return list(self._pool.map(lambda renderer: renderer.upload(scene), self.renderers))

    def render(
        self,
        scene: Scene | SplatCloud | Store | Sequence[ResidentCloud],
        capture: Capture | Camera | None = None,
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
    ) -> Frame:
        """Draw one picture. Arguments and errors as those of `Renderer.render`; scene: also what `upload` has
        returned."""
        if capture is not None and not isinstance(capture, Capture | Camera):
            raise invalid("capture", "a Capture or a Camera", capture)
        given = self._given(scene)
        camera = capture.camera if isinstance(capture, Capture) else capture
        camera = camera or given[0].capture.camera
        if camera is None:
            raise InputError("no camera; give a Camera, or a Capture with one")
        names = None if outputs is None else output_names(outputs)
        bands = self._bands(camera.height)

        def draw(number: int) -> tuple[Frame, float]:
            begun = time.perf_counter()
            frame = self.renderers[number].render_band(bands[number], given[number], capture, names, quality)
            return frame.wait(), time.perf_counter() - begun

        made = list(self._pool.map(draw, range(len(bands))))
        self._cut_anew([end - first for first, end in bands], [seconds for _, seconds in made])
        frames = [frame for frame, _ in made]
        return Frame(_Banded(frames, bands, self._pool), frames[0].capture)

    def render_views(
        self,
        scene: Scene | SplatCloud | Store | Sequence[ResidentCloud],
        captures: Iterable[Capture | Camera],
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
    ) -> Iterator[Frame]:
        """Draw many pictures, each whole by one device, in their order: device k draws pictures k, k + n and
        so on, of n devices, and brings each to the host while it draws the next. Arguments and errors as
        those of `render`; an error, of `captures` too, comes after the pictures of the captures before it."""
        given = self._given(scene)
        names = None if outputs is None else output_names(outputs)
        try:
            rest = iter(captures)
        except TypeError:
            raise InputError(f"captures is {captures!r}; it must be a list of Capture or Camera") from None
        lines = [
            _Line(partial(renderer.render_views, one, outputs=names, quality=quality))
            for renderer, one in zip(self.renderers, given, strict=True)
        ]
        waiting: deque[_Line] = deque()
        failure: Exception | None = None
        try:
            for line in cycle(lines):
                try:
                    line.ask(next(rest))
                except StopIteration:
                    break
                except Exception as error:
                    failure = error
                    break
                waiting.append(line)
                if len(waiting) > _AHEAD * len(lines):
                    yield waiting.popleft().result()
            for line in lines:
                line.end()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for line in lines:
                line.stop()
        if failure is not None:
            raise failure

    def _given(self, scene: Scene | SplatCloud | Store | Sequence[ResidentCloud]) -> Sequence[ResidentCloud]:
        """A scene on all devices."""
        if isinstance(scene, Sequence):
            given = items("scene", scene, ResidentCloud, "a scene, or what `upload` has returned")
        else:
            given = self.upload(scene)
        if len(given) != len(self.renderers):
            raise InputError(f"a scene on {len(given)} devices was given to {len(self.renderers)}")
        return given

    def _bands(self, height: int) -> list[tuple[int, int]]:
        """Rows of each device, one at least; devices that find none draw none."""
        devices = min(len(self.renderers), height)
        shares = self._shares if devices == len(self.renderers) else np.linspace(0, 1, devices + 1)
        cuts = np.round(shares * height).astype(int)
        for number in range(1, devices):
            cuts[number] = min(max(cuts[number], cuts[number - 1] + 1), height - devices + number)
        return list(pairwise(cuts.tolist()))

    def _cut_anew(self, rows: list[int], seconds: list[float]) -> None:
        """Bands that would have taken as long as each other, if rows of a band take the same."""
        if len(rows) < len(self.renderers) or max(seconds) <= _UNEVEN * np.mean(seconds):
            return
        spent = np.concatenate([[0.0], np.cumsum(seconds)])
        ends = np.concatenate([[0.0], np.cumsum(rows)]) / sum(rows)
        self._shares = np.interp(np.linspace(0.0, spent[-1], len(spent)), spent, ends)


class _Line:
    """One device's part of many pictures, on a thread of its own."""

    _END = object()

    def __init__(self, draw: Callable[[Iterator[Any]], Iterator[Frame]]) -> None:
        """draw: the pictures of captures, as `Renderer.render_views`."""
        self._asked: SimpleQueue[Any] = SimpleQueue()
        self._made: SimpleQueue[Frame | BaseException] = SimpleQueue()
        self._stopped = False
        self._thread = Thread(target=self._run, args=(draw,), name="fidsplat-device", daemon=True)
        self._thread.start()

    def ask(self, capture: Any) -> None:
        """For a picture; what is no capture is told by its `result`."""
        self._asked.put(capture)

    def end(self) -> None:
        """No more is asked for."""
        self._asked.put(self._END)

    def result(self) -> Frame:
        """The next picture, once it is on the host. Raises what drawing it has raised."""
        made = self._made.get()
        if isinstance(made, BaseException):
            raise made
        return made

    def stop(self) -> None:
        """Draw nothing more, and wait for what is being drawn."""
        self._stopped = True
        self.end()
        self._thread.join()

    def _captures(self) -> Iterator[Any]:
        while (capture := self._asked.get()) is not self._END:
            if self._stopped:
                return
            yield capture

    def _run(self, draw: Callable[[Iterator[Any]], Iterator[Frame]]) -> None:
        try:
            for frame in draw(self._captures()):
                for name in frame.outputs:
                    _ = frame[name]
                self._made.put(frame)
        except BaseException as error:
            self._made.put(error)


@dataclass(frozen=True)
class _Banded(Images):
    """Images of bands as those of one picture."""

    frames: list[Frame]
    bands: list[tuple[int, int]]
    pool: ThreadPoolExecutor

    def read(self, name: str, index: int | None = None) -> np.ndarray:
        """The rows of all bands, one below the other."""
        whole = self.frames[0].read_rows(name, 0, 0)
        list(self.pool.map(lambda frame, band: frame.read_rows(name, *band, whole), self.frames, self.bands))
        return whole[None] if index is None else whole

    @property
    def timings(self) -> dict[str, float]:
        """Of each stage the slowest device's."""
        each = [frame.timings for frame in self.frames]
        return {stage: max(one.get(stage, 0.0) for one in each) for stage in each[0]}

    @property
    def stats(self) -> dict[str, Any]:
        """Of the device that has most splats; visible and pairs of all, which count twice what two bands
        see."""
        each = [frame.stats for frame in self.frames]
        most = max(one["splats"] for one in each)
        return {"splats": most} | {name: sum(one[name] for one in each) for name in ("visible", "pairs")}
