"""Times frames on several devices, turn by turn, beside what each device can do at best."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import date

import numpy as np

from fidsplat.backends.interface import DeviceInfo, Rates
from fidsplat.backends.prepare import prepare
from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.experiments.bench.catalogue import BENCH_SCENES, TIMED, BenchScene
from fidsplat.experiments.bench.model import Counts, roofline_ms
from fidsplat.render.frame import Frame
from fidsplat.render.renderer import Renderer
from fidsplat.render.resident import ResidentCloud
from fidsplat.splats.cloud import SplatCloud
from fidsplat.streaming.residency import Residency
from fidsplat.util.errors import FidsplatError
from fidsplat.util.timing import Timer, time_interleaved


@dataclass
class Result:
    """One scene on one device; milliseconds, on an idle device, splats there, picture left there."""

    scene: str
    device: DeviceInfo
    width: int
    height: int
    timer: Timer
    """wall times of frames, from the call until the device is done; its parts are the stages"""
    rates: Rates | None = None
    renderer: str = "fidsplat"
    """who draws; benchmarks/peers has others"""
    first_frame_ms: float = 0.0
    """with compilation, or with what a kernel cache leaves of it"""
    counts: dict[str, int] = field(default_factory=dict)
    """splats, visible, pairs as the frame tells, and fragments where the backend can count them"""
    host_ms: list[float] = field(default_factory=list)
    """of the same frames, the call alone, which returns while the device draws"""
    mean_rgb: float = 0.0
    memory_bytes: int | None = None
    """held on the device: cloud, scratch buffers and the finished picture"""
    rooflines: dict[str, float] = field(default_factory=dict)
    """least milliseconds by stage, where the device's rates are known"""

    @property
    def times_roofline(self) -> dict[str, float]:
        """How many times its least each stage takes, and `frame`; without what the model does not know."""
        taken = self.timer.part_medians | {"frame": self.timer.median}
        least = self.rooflines | ({"frame": sum(self.rooflines.values())} if self.rooflines else {})
        return {name: taken[name] / least[name] for name in taken if least.get(name, 0.0) > 0}

    @property
    def host(self) -> float:
        """Median milliseconds of the frames that count until the call returns, while the device draws."""
        return float(np.median(self.host_ms[-len(self.timer.ms) :])) if self.host_ms else math.nan

    def as_dict(self) -> dict:
        """For JSON: one flat record."""
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
            **self.counts,
            "splats_per_second": 1e3 * self.counts["splats"] / middle,
            "memory_bytes": self.memory_bytes,
            "mean_rgb": self.mean_rgb,
            "rates": self.rates and asdict(self.rates),
            "rooflines_ms": self.rooflines,
            "times_roofline": self.times_roofline,
        }


class Bench:
    """Devices that draw the same scenes, frame by frame in turn, so that what disturbs one disturbs all.

    `results` grows as frames are drawn, so that a run which is stopped keeps what it has.
    """

    def __init__(
        self,
        devices: Sequence[str],
        tell: Callable[[str], None],
        tick: Callable[[], None],
        scenes: Mapping[str, BenchScene] = BENCH_SCENES,
    ) -> None:
        """Opens the devices and measures their rates.

        Args:
            devices: names as `Renderer` takes them.
            tell: called with what is being done.
            tick: is called after each frame that counts.
            scenes: what `run` finds its scenes in.

        Raises:
            DeviceError, UnknownDeviceError: a device cannot be opened.
        """
        self.results: list[Result] = []
        self.devices: dict[str, Rates | None] = {}
        self._tell, self._tick, self._scenes = tell, tick, scenes
        for name in dict.fromkeys(devices):
            tell(f"rates of {name}")
            backend = Renderer(name).backend
            self.devices[name] = backend.rates() if backend.traits.measures_rates else None

    def run(self, scene: str, repeats: int) -> None:
        """Draw a scene `repeats` times on each device. What a device cannot draw stands in its result."""
        self._tell(f"making {scene}")
        cloud, camera = self._scenes[scene].make()
        runs = []
        for name, rates in self.devices.items():
            self._tell(f"{scene}: first frame on {name}")
            runs.append(SceneRun(scene, name, rates, cloud, camera))
            self.results.append(runs[-1].result)
        self._tell(scene)
        time_interleaved([run.result.timer for run in runs], repeats, tick=self._tick)


class SceneRun:
    """One scene on one device. A renderer of its own, so that memory is that of this scene alone."""

    def __init__(
        self, scene: str, device: str, rates: Rates | None, cloud: SplatCloud, camera: Camera
    ) -> None:
        self.renderer = Renderer(device)
        self.camera, self.capture = camera, Capture(camera, quality=TIMED)
        self.picture = np.zeros((camera.height, camera.width, 3), np.float32)
        """what was drawn, (h, w, 3)"""
        timer = Timer(self._whole, catch_errors=True, parts=lambda frame: frame.timings)
        self.result = Result(scene, self.renderer.device, camera.width, camera.height, timer, rates)
        try:
            self.resident = self.renderer.upload(cloud)
            self.result.first_frame_ms = Timer(self._first).run()
            self._count(cloud)
        except FidsplatError as error:
            timer.error = str(error)

    def draw(self) -> Frame:
        """One frame."""
        return self.renderer.render(self.resident, self.capture)

    def _whole(self) -> Frame:
        """One frame until the device is done."""
        begun = time.perf_counter()
        frame = self.draw()
        self.result.host_ms.append(1e3 * (time.perf_counter() - begun))
        return frame.wait()

    def _first(self) -> None:
        frame = self.draw()
        self.picture, self.result.counts = frame["rgb"], dict(frame.stats)

    def _count(self, cloud: SplatCloud) -> None:
        result, backend = self.result, self.renderer.backend
        result.mean_rgb = float(self.picture.mean(dtype=np.float64))
        if not backend.traits.measures_rates or result.rates is None:
            return
        pixels = result.width * result.height
        result.memory_bytes = backend.memory_bytes + self.resident.memory_bytes + 12 * pixels
        drawn = overdraw(self.renderer, self.resident, self.camera, TIMED)
        result.counts["fragments"] = int(drawn.sum(dtype=np.int64))
        further = max(cloud.sh_degree + 1, 1) ** 2 - 1
        counts = Counts(pixels=pixels, sh_coefficients=further, **result.counts)
        result.rooflines = roofline_ms(counts, result.rates)


def overdraw(renderer: Renderer, resident: ResidentCloud, camera: Camera, quality: Quality) -> np.ndarray:
    """Fragments that each pixel draws, (h, w) int32, of all its samples together, as the kernels that draw
    them count them.

    Raises:
        FidsplatError: the device fails, or its backend has no such count.
    """
    data = resident.data
    assert not isinstance(data, Residency), "of splats in memory"
    features, view = prepare(data, Capture(camera, quality=quality))
    features = replace(features, outputs=("overdraw",))
    return renderer.backend.pipeline(features).render(data, view).read("overdraw")
