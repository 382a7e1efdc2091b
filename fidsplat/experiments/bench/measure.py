"""Times frames on several devices, turn by turn, and holds them against what each device can do."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from datetime import date

import numpy as np

from fidsplat.backends.base import DeviceInfo, Measurable, Rates
from fidsplat.cameras import Camera
from fidsplat.errors import FidsplatError
from fidsplat.experiments.bench.catalogue import BENCH_SCENES, TIMED
from fidsplat.experiments.bench.model import Counts, floor_ms
from fidsplat.experiments.bench.overdraw import overdraw
from fidsplat.render import Frame, Renderer
from fidsplat.splats import SplatCloud

WARM_UP = 2
"""Frames that are drawn before those that count."""


@dataclass
class Result:
    """One scene on one device; milliseconds, on an idle device, splats there, picture left there."""

    scene: str
    device: DeviceInfo
    width: int
    height: int
    rates: Rates | None = None
    renderer: str = "fidsplat"
    """who draws; benchmarks/peers has others"""
    first_frame_ms: float = 0.0
    """with compilation, or with what a kernel cache leaves of it"""
    counts: dict[str, int] = field(default_factory=dict)
    """splats, visible, pairs as the frame tells, and fragments where the backend can count them"""
    mean_rgb: float = 0.0
    memory_bytes: int | None = None
    """held on the device: cloud, scratch buffers and the finished picture"""
    frames: list[float] = field(default_factory=list)
    """wall time of each: from the call until the device is done"""
    stages: dict[str, list[float]] = field(default_factory=dict)
    """the same frames stage by stage, by the device's own clock"""
    floors: dict[str, float] = field(default_factory=dict)
    """least milliseconds by stage, where the device's rates are known"""
    error: str = ""

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """First quartile, median and third quartile of the frames; needs at least one."""
        low, middle, high = np.percentile(self.frames, (25, 50, 75))
        return float(low), float(middle), float(high)

    @property
    def stage_ms(self) -> dict[str, float]:
        """Medians by stage."""
        return {stage: float(np.median(times)) for stage, times in self.stages.items()}

    @property
    def times_floor(self) -> dict[str, float]:
        """How many times its floor each stage takes, and `frame`; without what the model does not know."""
        taken = self.stage_ms | {"frame": self.quartiles[1]}
        floors = self.floors | ({"frame": sum(self.floors.values())} if self.floors else {})
        return {name: taken[name] / floors[name] for name in taken if floors.get(name, 0.0) > 0}

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
            "repeats": len(self.frames),
            "error": self.error or None,
        }
        if not self.frames:
            return record
        low, middle, high = self.quartiles
        return record | {
            "frame_ms": middle,
            "quartiles_ms": [low, high],
            "fastest_ms": min(self.frames),
            "first_frame_ms": self.first_frame_ms,
            "stages_ms": self.stage_ms,
            "fastest_stages_ms": {stage: min(times) for stage, times in self.stages.items()},
            **self.counts,
            "splats_per_second": 1e3 * self.counts["splats"] / middle,
            "memory_bytes": self.memory_bytes,
            "mean_rgb": self.mean_rgb,
            "rates": self.rates and asdict(self.rates),
            "floors_ms": self.floors,
            "times_floor": self.times_floor,
        }


class Bench:
    """Devices that draw the same scenes, frame by frame in turn, so that what disturbs one disturbs all.

    `results` grows as frames are drawn, so that a run which is stopped keeps what it has.
    """

    def __init__(self, devices: Sequence[str], tell: Callable[[str], None], tick: Callable[[], None]) -> None:
        """Opens the devices and measures their rates.

        Args:
            devices: names as `Renderer` takes them.
            tell: is told what is being done.
            tick: is called after each frame that counts.

        Raises:
            DeviceError, UnknownDeviceError: a device cannot be opened.
        """
        self.results: list[Result] = []
        self.devices: dict[str, Rates | None] = {}
        self._tell, self._tick = tell, tick
        for name in dict.fromkeys(devices):
            tell(f"rates of {name}")
            backend = Renderer(name).backend
            self.devices[name] = backend.rates() if isinstance(backend, Measurable) else None

    def run(self, scene: str, repeats: int) -> None:
        """Draw a scene `repeats` times on each device. What a device cannot draw stands in its result."""
        self._tell(f"making {scene}")
        cloud, camera = BENCH_SCENES[scene].make()
        runs = []
        for name, rates in self.devices.items():
            self._tell(f"{scene}: first frame on {name}")
            runs.append(SceneRun(scene, name, rates, cloud, camera))
            self.results.append(runs[-1].result)
        self._tell(scene)
        for number in range(WARM_UP + repeats):
            for run in runs:
                run.draw(counts=number >= WARM_UP)
                if number >= WARM_UP:
                    self._tick()


class SceneRun:
    """One scene on one device. A renderer of its own, so that memory is that of this scene alone."""

    def __init__(
        self, scene: str, device: str, rates: Rates | None, cloud: SplatCloud, camera: Camera
    ) -> None:
        self.renderer = Renderer(device)
        self.camera = camera
        self.result = Result(scene, self.renderer.device, camera.width, camera.height, rates)
        self.picture = np.zeros((camera.height, camera.width, 3), np.float32)
        """what was drawn, (h, w, 3)"""
        try:
            self.resident = self.renderer.upload(cloud)
            start = time.perf_counter()
            frame = self.renderer.render(self.resident, camera, quality=TIMED)
            self.picture = frame["rgb"]
            self.result.first_frame_ms = 1e3 * (time.perf_counter() - start)
            self.result.mean_rgb = float(self.picture.mean(dtype=np.float64))
            self._count(frame, cloud)
        except FidsplatError as error:
            self.result.error = str(error)

    def _count(self, frame: Frame, cloud: SplatCloud) -> None:
        result, backend = self.result, self.renderer.backend
        result.counts = dict(frame.stats)
        if not isinstance(backend, Measurable) or result.rates is None:
            return
        pixels = result.width * result.height
        result.memory_bytes = backend.memory_bytes + self.resident.memory_bytes + 12 * pixels
        result.counts["fragments"] = int(
            overdraw(self.renderer, self.resident, self.camera, TIMED).sum(dtype=np.int64)
        )
        further = max(cloud.sh_degree + 1, 1) ** 2 - 1
        counts = Counts(pixels=pixels, sh_coefficients=further, **result.counts)
        result.floors = floor_ms(counts, result.rates)

    def draw(self, counts: bool) -> None:
        """Draw one frame and time it; it goes into the result if it counts."""
        if self.result.error:
            return
        try:
            start = time.perf_counter()
            frame = self.renderer.render(self.resident, self.camera, quality=TIMED)
            timings = frame.timings  # waits for the device
            took = 1e3 * (time.perf_counter() - start)
        except FidsplatError as error:
            self.result.error = str(error)
            return
        if counts:
            self.result.frames.append(took)
            for stage, ms in timings.items():
                self.result.stages.setdefault(stage, []).append(ms)
