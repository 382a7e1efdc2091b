"""Multi-device rendering: `render` splits a frame into bands of rows, `render_views` distributes frames."""

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
from fidsplat.backends.view import NO_CAMERA
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

_MAX_IMBALANCE = 1.1
"""maximum ratio of the slowest band's time to the mean; above it, bands are balanced"""

_IN_FLIGHT = 3
"""frames in flight per device: one is copied to the host, one rendered, and one has its chunks prefetched"""


class SeveralDevices:
    """Several devices of one model: `render` splits a frame into bands of rows, `render_views` distributes
    frames.

    Frames are bit-identical to those of one device. Bands are balanced by the times of the previous frame. A
    cloud in memory is copied to every device; each device caches only the chunks of a store that its bands
    and frames need.

    Args:
        devices: names as for `fs.Renderer`, e.g. ["opencl:nvidia", "opencl:nvidia-2"]; a name may be
            repeated.
        memory_budget: bytes per device.

    Raises:
        InputError: no device, or devices of different models, whose frames may differ.
        DeviceError: a device cannot be used.
    """

    def __init__(self, devices: Iterable[str], memory_budget: int | None = None) -> None:
        names = items("devices", [devices] if isinstance(devices, str) else devices, str, "names of devices")
        if not names:
            raise InputError("devices must name at least one device, got an empty list; give e.g. ['opencl']")
        self.renderers = [Renderer(name, memory_budget) for name in names]
        titles = {renderer.device.title for renderer in self.renderers}
        if len(titles) > 1:
            raise InputError(
                "devices must be of one model, so that their frames are bit-identical, got "
                f"{', '.join(sorted(titles))}; name devices of one model"
            )
        self._borders = np.linspace(0.0, 1.0, len(names) + 1)
        """borders between the bands, from 0 to 1, as fractions of the frame's height"""
        self._pool = ThreadPoolExecutor(len(names), "fidsplat-device")

    def __repr__(self) -> str:
        return f"SeveralDevices({', '.join(renderer.device.name for renderer in self.renderers)})"

    def upload(self, scene: Scene | SplatCloud | Store) -> list[ResidentCloud]:
        """Copy a scene to all devices."""
        return list(self._pool.map(lambda renderer: renderer.upload(scene), self.renderers))

    def render(
        self,
        scene: Scene | SplatCloud | Store | Sequence[ResidentCloud],
        capture: Capture | Camera | None = None,
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
    ) -> Frame:
        """Render one frame. scene: a scene, or the result of `upload`. Other arguments and errors: see
        `Renderer.render`."""
        if capture is not None and not isinstance(capture, Capture | Camera):
            raise invalid("capture", "a Capture or a Camera", capture)
        resident = self._uploaded(scene)
        camera = capture.camera if isinstance(capture, Capture) else capture
        camera = camera or resident[0].capture.camera
        if camera is None:
            raise InputError(NO_CAMERA)
        names = None if outputs is None else output_names(outputs)
        bands = self._bands(camera.height)

        def render_band(number: int) -> tuple[Frame, float]:
            start = time.perf_counter()
            frame = self.renderers[number].render_band(
                bands[number], resident[number], capture, names, quality
            )
            return frame.wait(), time.perf_counter() - start

        rendered = list(self._pool.map(render_band, range(len(bands))))
        self._balance([end - first for first, end in bands], [seconds for _, seconds in rendered])
        frames = [frame for frame, _ in rendered]
        return Frame(_BandImages(frames, bands, self._pool), frames[0].capture)

    def render_views(
        self,
        scene: Scene | SplatCloud | Store | Sequence[ResidentCloud],
        captures: Iterable[Capture | Camera],
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
    ) -> Iterator[Frame]:
        """Render many frames in order, each on one device, round robin. A frame is copied to the host while
        its device renders the next. Arguments and errors: see `render`. An error, also in `captures`, is
        raised after all frames before it."""
        resident = self._uploaded(scene)
        names = None if outputs is None else output_names(outputs)
        try:
            remaining = iter(captures)
        except TypeError:
            raise invalid("captures", "a list of Capture or Camera", captures) from None
        workers = [
            _Worker(partial(renderer.render_views, cloud, outputs=names, quality=quality))
            for renderer, cloud in zip(self.renderers, resident, strict=True)
        ]
        pending: deque[_Worker] = deque()
        failure: Exception | None = None
        try:
            for worker in cycle(workers):
                try:
                    worker.submit(next(remaining))
                except StopIteration:
                    break
                except Exception as error:
                    failure = error
                    break
                pending.append(worker)
                if len(pending) > _IN_FLIGHT * len(workers):
                    yield pending.popleft().result()
            for worker in workers:
                worker.end()
            while pending:
                yield pending.popleft().result()
        finally:
            for worker in workers:
                worker.stop()
        if failure is not None:
            raise failure

    def _uploaded(
        self, scene: Scene | SplatCloud | Store | Sequence[ResidentCloud]
    ) -> Sequence[ResidentCloud]:
        if isinstance(scene, Sequence):
            resident = items("scene", scene, ResidentCloud, "a scene, or the result of `upload`")
        else:
            resident = self.upload(scene)
        if len(resident) != len(self.renderers):
            raise InputError(
                f"scene must be uploaded to all {len(self.renderers)} devices, got {len(resident)}; give the "
                "result of `upload`"
            )
        return resident

    def _bands(self, height: int) -> list[tuple[int, int]]:
        """Rows [first, end) of each device, at least one row each; small frames use fewer devices."""
        devices = min(len(self.renderers), height)
        fractions = self._borders if devices == len(self.renderers) else np.linspace(0, 1, devices + 1)
        rows = np.round(fractions * height).astype(int)
        for number in range(1, devices):
            rows[number] = min(max(rows[number], rows[number - 1] + 1), height - devices + number)
        return list(pairwise(rows.tolist()))

    def _balance(self, rows: list[int], seconds: list[float]) -> None:
        """Move the borders of the bands to equalise their times; rows of a band count as equally costly."""
        if len(rows) < len(self.renderers) or max(seconds) <= _MAX_IMBALANCE * np.mean(seconds):
            return
        elapsed = np.concatenate([[0.0], np.cumsum(seconds)])
        borders = np.concatenate([[0.0], np.cumsum(rows)]) / sum(rows)
        self._borders = np.interp(np.linspace(0.0, elapsed[-1], len(elapsed)), elapsed, borders)


class _Worker:
    """Worker thread of one device: a queue of captures and a queue of frames."""

    _END = object()

    def __init__(self, render: Callable[[Iterator[Any]], Iterator[Frame]]) -> None:
        """render: `Renderer.render_views` of a scene, as a function of the captures."""
        self._captures: SimpleQueue[Any] = SimpleQueue()
        self._frames: SimpleQueue[Frame | BaseException] = SimpleQueue()
        self._stopped = False
        self._thread = Thread(target=self._run, args=(render,), name="fidsplat-device", daemon=True)
        self._thread.start()

    def submit(self, capture: Any) -> None:
        """Queue a capture. `result` raises the error of an invalid capture."""
        self._captures.put(capture)

    def end(self) -> None:
        """Signal that no captures follow."""
        self._captures.put(self._END)

    def result(self) -> Frame:
        """Wait for the next frame; returns it, copied to the host. Raises the error of its rendering."""
        frame = self._frames.get()
        if isinstance(frame, BaseException):
            raise frame
        return frame

    def stop(self) -> None:
        """Cancel the queued captures, and wait for the current frame."""
        self._stopped = True
        self.end()
        self._thread.join()

    def _queued(self) -> Iterator[Any]:
        while (capture := self._captures.get()) is not self._END:
            if self._stopped:
                return
            yield capture

    def _run(self, render: Callable[[Iterator[Any]], Iterator[Frame]]) -> None:
        try:
            for frame in render(self._queued()):
                for name in frame.outputs:
                    _ = frame[name]
                self._frames.put(frame)
        except BaseException as error:
            self._frames.put(error)


@dataclass(frozen=True)
class _BandImages(Images):
    """Images of one frame, stacked from bands of rows."""

    frames: list[Frame]
    bands: list[tuple[int, int]]
    pool: ThreadPoolExecutor

    def read(self, name: str, index: int | None = None) -> np.ndarray:
        """Read the rows of all bands and stack them."""
        image = self.frames[0].read_rows(name, 0, 0)
        list(self.pool.map(lambda frame, band: frame.read_rows(name, *band, image), self.frames, self.bands))
        return image[None] if index is None else image

    @property
    def timings(self) -> dict[str, float]:
        """Milliseconds of each stage, on the device that is slowest in this stage."""
        timings = [frame.timings for frame in self.frames]
        return {stage: max(ms.get(stage, 0.0) for ms in timings) for stage in timings[0]}

    @property
    def stats(self) -> dict[str, Any]:
        """splats: maximum over the devices; visible, pairs: sums over the bands."""
        stats = [frame.stats for frame in self.frames]
        sums = {name: sum(counts[name] for counts in stats) for name in ("visible", "pairs")}
        return {"splats": max(counts["splats"] for counts in stats)} | sums
