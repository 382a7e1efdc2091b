"""Interleaved frame times of several devices, with the roofline of each device."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import date
from types import MappingProxyType

import numpy as np

from fidsplat.backends.interface import DeviceInfo, Rates
from fidsplat.backends.prepare import prepare
from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.effects import select
from fidsplat.experiments.bench.ablation import ReducedScene, middle_camera
from fidsplat.experiments.bench.catalogue import BENCH_SCENES, TIMED, BenchScene
from fidsplat.experiments.bench.model import Counts, roofline_ms
from fidsplat.render.frame import Frame
from fidsplat.render.renderer import Renderer
from fidsplat.render.resident import ResidentCloud
from fidsplat.splats.cloud import SplatCloud
from fidsplat.streaming.device_chunk_cache import DeviceChunkCache
from fidsplat.util.errors import FidsplatError
from fidsplat.util.timing import Timer, frame_timer, time_interleaved

MIN_ROUNDS, SECONDS = 3, 60.0
"""limit for a user's scene: after MIN_ROUNDS rounds, no round starts later than SECONDS"""


@dataclass
class Result:
    """Times of a scene on a device in milliseconds; splats and images stay on the device."""

    scene: str
    device: DeviceInfo
    width: int
    height: int
    timer: Timer
    """wall times of complete frames, with the times of their stages"""
    rates: Rates | None = None
    renderer: str = "fidsplat"
    """name of the renderer; benchmarks/peers has other renderers"""
    first_frame_ms: float = 0.0
    """time of the first frame, including compilation or loading of cached kernels"""
    counts: dict[str, int] = field(default_factory=dict)
    """number of splats, visible splats and pairs of splats and tiles; fragments if the backend counts them"""
    host_ms: list[float] = field(default_factory=list)
    """times until the call returns, while the device is still rendering, for the same frames"""
    mean_rgb: float = 0.0
    memory_bytes: int | None = None
    """device memory in bytes of splats, scratch buffers and image"""
    without: dict[str, Timer] = field(default_factory=dict)
    """times of the same frames without one effect, by the effect's name"""
    rooflines: dict[str, float] = field(default_factory=dict)
    """roofline by stage in milliseconds, for devices with known rates"""

    @property
    def times_roofline(self) -> dict[str, float]:
        """Ratio of the measured time to the roofline, by stage and for the complete `frame`, where known."""
        measured = self.timer.part_medians | {"frame": self.timer.median}
        rooflines = self.rooflines | {"frame": sum(self.rooflines.values())}
        return {name: ms / rooflines[name] for name, ms in measured.items() if rooflines.get(name, 0.0) > 0}

    @property
    def host(self) -> float:
        """Median time until the call returns, in milliseconds."""
        return float(np.median(self.host_ms[-len(self.timer.ms) :])) if self.host_ms else math.nan

    @property
    def effects(self) -> dict[str, float]:
        """Milliseconds that each effect adds to a frame: median of the differences of interleaved frames."""
        return {
            # after an interrupt, one of the lists may be longer by a frame
            name: float(np.median([ms - other for ms, other in zip(self.timer.ms, less.ms, strict=False)]))
            for name, less in self.without.items()
            if less.ms and self.timer.ms
        }

    def as_dict(self) -> dict:
        """Flat JSON record of the result."""
        record = {
            "scene": self.scene,
            "renderer": self.renderer,
            "device": self.device.name,
            "title": self.device.title,
            "platform": self.device.platform,
            "driver": self.device.version,
            "compute_units": self.device.compute_units,
            "date": date.today().isoformat(),
            "width": self.width,
            "height": self.height,
            "repeats": len(self.timer.ms),
            "error": self.timer.error or None,
        }
        if not self.timer.ms:
            return record
        low, middle, high = self.timer.quartiles
        return record | {
            "frame_ms": middle,
            "quartiles_ms": [low, high],
            "fastest_ms": min(self.timer.ms),
            "first_frame_ms": self.first_frame_ms,
            "host_ms": self.host,
            "stages_ms": self.timer.part_medians,
            "fastest_stages_ms": {stage: min(times) for stage, times in self.timer.parts.items()},
            "effects_ms": self.effects,
            **self.counts,
            "splats_per_second": 1e3 * self.counts["splats"] / middle,
            "memory_bytes": self.memory_bytes,
            "mean_rgb": self.mean_rgb,
            "rates": self.rates and asdict(self.rates),
            "rooflines_ms": self.rooflines,
            "times_roofline": self.times_roofline,
        }


class Bench:
    """Benchmark of devices with interleaved frames, so that disturbances affect all devices.

    `results` grows during the run, so that an interrupted run has results.
    """

    def __init__(
        self,
        devices: Sequence[str],
        report: Callable[[str], None],
        tick: Callable[[], None],
        scenes: Mapping[str, BenchScene] = BENCH_SCENES,
    ) -> None:
        """Open the devices and measure their rates.

        Args:
            devices: names of `Renderer`.
            report: called with the name of each step.
            tick: called after each timed frame.
            scenes: scenes by name.

        Raises:
            DeviceError, UnknownDeviceError: a device cannot be opened.
        """
        self.results: list[Result] = []
        self.devices: dict[str, Rates | None] = {}
        self._report, self._tick, self._scenes = report, tick, scenes
        for name in dict.fromkeys(devices):
            report(f"rates of {name}")
            backend = Renderer(name).backend
            self.devices[name] = backend.rates() if backend.has("rates") else None

    def run(self, scene: str, repeats: int) -> None:
        """Render a scene `repeats` times on each device. A device's error is stored in its result."""
        self._report(f"making {scene}")
        entry = self._scenes[scene]
        cloud, camera = entry.make()
        timers: list[Timer] = []
        for name, rates in self.devices.items():
            self._report(f"{scene}: first frame on {name}")
            run = SceneRun(scene, name, rates, cloud, entry.capture or camera, entry.without)
            self.results.append(run.result)
            timers += [run.result.timer, *run.result.without.values()]
        self._report(scene)
        if entry.capture is None:
            time_interleaved(timers, repeats, tick=self._tick)
        else:  # frames of the user's scenes may be slow: fewer rounds, within a time limit
            few = min(MIN_ROUNDS, repeats)
            time_interleaved(timers, repeats, min_rounds=few, seconds=SECONDS, warm_up=1, tick=self._tick)


class SceneRun:
    """A scene on a device, with a renderer of its own, so that the measured memory is the scene's."""

    def __init__(
        self,
        scene: str,
        device: str,
        rates: Rates | None,
        cloud: SplatCloud,
        capture: Camera | Capture,
        without: Mapping[str, ReducedScene] = MappingProxyType({}),
    ) -> None:
        self.renderer = Renderer(device)
        self.capture = Capture(capture, quality=TIMED) if isinstance(capture, Camera) else capture
        self.camera = camera = middle_camera(self.capture)
        self.image = np.zeros((camera.height, camera.width, 3), np.float32)
        """rendered image (h, w, 3)"""
        timer = Timer(self._timed, catch_errors=True, parts=lambda frame: frame.timings)
        self.result = Result(scene, self.renderer.device, camera.width, camera.height, timer, rates)
        try:
            self.resident = self.renderer.upload(cloud)
            self.result.first_frame_ms = Timer(self._first).run()
            self._count(cloud)
            for name, less in without.items():
                rest = less.cloud()
                resident = self.resident if rest is None else self.renderer.upload(rest)
                self.result.without[name] = frame_timer(
                    self.renderer, resident, less.capture, catch_errors=True
                )
        except FidsplatError as error:
            timer.error = str(error)

    def render(self) -> Frame:
        return self.renderer.render(self.resident, self.capture)

    def _timed(self) -> Frame:
        """Render a frame and wait for the device."""
        begun = time.perf_counter()
        frame = self.render()
        self.result.host_ms.append(1e3 * (time.perf_counter() - begun))
        return frame.wait()

    def _first(self) -> None:
        frame = self.render()
        image = frame[frame.outputs[0]]  # waits for the device
        self.image, self.result.counts = frame["rgb"] if "rgb" in frame.outputs else image, dict(frame.stats)

    def _count(self, cloud: SplatCloud) -> None:
        result, backend = self.result, self.renderer.backend
        result.mean_rgb = float(self.image.mean(dtype=np.float64))
        if not backend.has("rates") or result.rates is None:
            return
        pixels = result.width * result.height
        result.memory_bytes = backend.memory_bytes + self.resident.memory_bytes + 12 * pixels
        plain = Capture(self.camera, quality=self.capture.quality)
        if select(cloud, plain) != select(cloud, self.capture):
            return  # the roofline model describes frames without effects
        fragments = overdraw(self.renderer, self.resident, self.camera, self.capture.quality)
        result.counts["fragments"] = int(fragments.sum(dtype=np.int64))
        coefficients = max(cloud.sh_degree + 1, 1) ** 2 - 1
        counts = Counts(pixels=pixels, sh_coefficients=coefficients, **result.counts)
        result.rooflines = roofline_ms(counts, result.rates)


def overdraw(renderer: Renderer, resident: ResidentCloud, camera: Camera, quality: Quality) -> np.ndarray:
    """Number of fragments of all samples of a pixel, (h, w) int32, counted by the blending kernels.

    Raises:
        FidsplatError: the device fails, or its backend does not count fragments.
    """
    data = resident.data
    assert not isinstance(data, DeviceChunkCache), "splats must be in memory"
    features, view = prepare(data, Capture(camera, quality=quality))
    features = replace(features, outputs=("overdraw",))
    return renderer.backend.pipeline(features).render_view(data, view).read("overdraw", 0)
