"""Suite of `fidsplat bench --suite`: time and error of renderers by scene, each in a process of its own.

Results are one JSON object per machine (benchmarks/splatmark.schema.json), written after each scene. A run
with an existing file measures only missing scenes and renderers.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.accuracy.error import reference_image, reference_renderer
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.experiments.bench import adapter, own_adapter
from fidsplat.experiments.bench.power import energy_meter
from fidsplat.experiments.bench.regimes import ELLIPSOIDS, SuiteScene, Views
from fidsplat.experiments.sweep import differences, rounded
from fidsplat.render.renderer import Renderer
from fidsplat.util import interrupts
from fidsplat.util.errors import FidsplatError, InputError
from fidsplat.util.files import atomic_write, from_json, read_text
from fidsplat.util.progress import Progress
from fidsplat.util.provenance import run_facts
from fidsplat.util.timing import Clock, Timer, quartiles, time_interleaved
from fidsplat.vision.readback import means, read_back

SCHEMA = 2
"""version of the results' format"""
TOO_SLOW = 10_000.0
"""milliseconds of a submission above which a renderer is skipped"""
SHORT = 50.0
"""milliseconds: shorter frames follow untimed frames, since other processes use device and caches in
between"""


class AdapterError(FidsplatError):
    """Failure of a renderer, with the renderer's message."""


@dataclass(frozen=True)
class Effort:
    """Length of the measurement of a scene."""

    rounds: int
    """maximum number of timed frames of each setting"""
    seconds: float
    """time in seconds after which no round starts, unless fewer than `min_rounds` are done"""
    min_rounds: int = 3
    fast: float = 400.0
    """milliseconds of a submission up to which settings are interleaved; slower ones are interleaved
    separately, so that faster ones have more rounds"""
    slow: float = 1000.0
    """milliseconds of a submission above which only the first setting of a renderer is measured"""
    burst: float = 0.5
    """seconds of frames for the measurement of energy"""
    compared_views: int = 3
    """maximum number of views with compared images"""


FULL = Effort(40, 2.5, compared_views=2)
QUICK = Effort(7, 1.0, min_rounds=1, fast=250.0, slow=250.0, compared_views=1)


class RendererProcess:
    """A renderer in its own process (`adapter.py`). `skipped` is the reason if it cannot run."""

    def __init__(
        self,
        name: str,
        file: Path,
        device: str | None = None,
        python: str = sys.executable,
    ) -> None:
        """
        Args:
            file: file with the class `Adapter`.
            python: Python interpreter of the renderer's environment.
        """
        self.name, self.clock = name, Clock()
        self._process = subprocess.Popen(
            [python, "-P", adapter.__file__, str(file), *([device] if device else [])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL if not os.environ.get("FIDSPLAT_DEBUG") else None,
            start_new_session=True,  # Ctrl-C reaches only this process, which closes the pipes
        )
        assert self._process.stdout is not None
        self._answers = interrupts.lines_of(self._process.stdout)
        opened: dict[str, Any]
        try:
            opened = self._answer()
        except AdapterError as error:
            opened = {"skipped": str(error)}
        self.skipped: str = opened.get("skipped", "")
        self.facts: dict[str, Any] = opened.get("facts", {})
        self.settings: dict[str, dict[str, dict]] = opened.get("settings", {})
        """fields of `Quality` that define the image, by setting and kind of splats"""

    def ask(self, do: str, **request: Any) -> dict[str, Any]:
        """Send a request and return the response. Raises AdapterError."""
        assert self._process.stdin is not None
        with suppress(OSError):  # the process may have ended; `_answer` reports that
            self._process.stdin.write(json.dumps({"do": do, **request}).encode() + b"\n")
            self._process.stdin.flush()
        return self._answer()

    def frame(
        self, setting: str, views: list[int], before: list[list[int]] | None = None
    ) -> dict[str, float]:
        """Render a submission after untimed submissions `before`; the clock advances by its time.
        Returns `ms`, `cpu_ms`, and if known `device_ms`."""
        answer = self.ask("frame", setting=setting, views=views, before=before)
        self.clock.seconds += answer["ms"] / 1e3
        return answer

    def _answer(self) -> dict[str, Any]:
        line = next(self._answers, None)
        if line is None:
            raise AdapterError(f"the process ended with status {self._process.wait()}")
        answer = from_json(line)
        if "error" in answer:
            raise AdapterError(answer["error"])
        return answer

    def close(self) -> None:
        assert self._process.stdin is not None
        with suppress(OSError):  # it may have ended
            self._process.stdin.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


Opener = Callable[[], RendererProcess]


def fidsplat_renderers(devices: Sequence[str]) -> dict[str, Opener]:
    """fidsplat on each device, by name."""
    file = Path(own_adapter.__file__)
    names = {f"fidsplat {device}": device for device in devices}
    return {name: partial(RendererProcess, name, file, device) for name, device in names.items()}


def adapter_renderers(folder: Path) -> dict[str, Opener]:
    """Renderers of the adapters `NAME/adapter.py` in a folder, each with the Python of `NAME/.venv` if it
    exists.

    Raises InputError if the folder has no adapter.
    """
    files = sorted(folder.glob("*/adapter.py"))
    if not files:
        raise InputError(f"--adapters must be a folder with NAME/adapter.py, got {folder}")
    renderers = {}
    for file in files:
        interpreter = file.parent / ".venv" / "bin" / "python"
        python = str(interpreter) if interpreter.is_file() else sys.executable
        renderers[file.parent.name] = partial(RendererProcess, file.parent.name, file, python=python)
    return renderers


class Measurement:
    """Measurement of one setting of a renderer in a scene: the result so far, and the timer of its frames."""

    def __init__(
        self, process: RendererProcess, setting: str, result: dict[str, Any], submissions: list[list[int]]
    ) -> None:
        """submissions: views of each frame, which are repeated in a cycle."""
        self.process, self.setting, self.result, self.submissions = process, setting, result, submissions
        self.second_ms = math.inf
        """time of the first submission after the first frames, in milliseconds"""
        self.timer = Timer(self._render, process.clock, catch_errors=True)
        self._next = cycle(range(len(submissions)))

    def _render(self) -> dict[str, float]:
        number = next(self._next)
        # preceded by earlier views of a flight, so that the camera is new to the renderer, as in a flight
        before = [self.submissions[number - k] for k in range(min(8, len(self.submissions) - 1), 0, -1)]
        views = self.submissions[number]
        answer = self.process.frame(
            self.setting, views, (before or [views]) if self.second_ms < SHORT else None
        )
        return {name: ms for name, ms in answer.items() if name != "ms"}

    def first(self, references: References, image_quality: Mapping[str, Any], file: Path) -> np.ndarray:
        """Render the first frame of the chosen views, add times and errors to `self.result`, and return the
        first image (h, w, 3).

        Args:
            image_quality: fields of `Quality` that define the image.
            file: file by which the process returns images.

        Raises AdapterError.
        """
        milliseconds, images, memory = [], [], {}
        for view in references.chosen:
            milliseconds.append(self.process.frame(self.setting, [view])["ms"])
            memory = self.process.ask("image", file=str(file))
            images.append(np.load(file)[0])
        self.second_ms = self.timer.run()
        if self.timer.error:
            raise AdapterError(self.timer.error)
        off = np.abs(np.stack(images) - references.image(image_quality))
        if not np.isfinite(off).all():
            raise AdapterError(f"{self.setting}: the image has values that are not finite")
        self.result |= {
            "first_frame_ms": milliseconds[0],
            **memory,
            "largest_error": float(off.max()),
            "mean_error": float(off.mean()),
            "psnr_db": float(-10 * np.log10(max(np.mean(off**2), 1e-20))),
        }
        return images[0]

    def finish(self, burst: float) -> None:
        """Add times per view to the result, and its joules if `burst` is above 0 and the machine reports
        them.

        Raises AdapterError.
        """
        if self.timer.error or not self.timer.ms:
            raise AdapterError(self.timer.error)
        views = len(self.submissions[0])
        self.result |= {
            "quartiles_ms": [ms / views for ms in quartiles(self.timer.ms)],
            "fastest_ms": min(self.timer.ms) / views,
            "frames": len(self.timer.ms),
            **{name: ms / views for name, ms in self.timer.part_medians.items()},
        }
        meter = energy_meter(self.process.facts["kind"]) if burst else None
        if meter is not None:
            before = meter()
            done = self.process.ask("burst", setting=self.setting, views=self.submissions[0], seconds=burst)
            self.result["joules"] = (meter() - before) / (done["submissions"] * views)


class References:
    """Float64 reference images of a scene, by the settings that define the image."""

    def __init__(self, renderer: Renderer, views: Views, chosen: list[int]) -> None:
        self._renderer, self._views, self.chosen = renderer, views, chosen
        self._resident: Any = None
        self._found: dict[str, np.ndarray] = {}

    def image(self, image_quality: Mapping[str, Any]) -> np.ndarray:
        """Reference images (v, h, w, 3) float64 of the chosen views."""
        image_quality = dict(image_quality)
        if not self._views.cloud.has_coplanar_groups and image_quality.get("order") == "auto":
            image_quality["order"] = "centre"  # renders the same image
        if self._views.kind != ELLIPSOIDS:
            image_quality.pop("ellipsoid", None)
        key = json.dumps(image_quality, sort_keys=True)
        if key not in self._found:
            if self._resident is None:
                self._resident = self._renderer.upload(self._views.cloud)
            quality = Quality().with_(**image_quality)
            captures = (
                Capture(self._views.camera.with_pose(self._views.poses[k]), quality=quality)
                for k in self.chosen
            )
            images = [reference_image(self._renderer, self._resident, capture) for capture in captures]
            self._found[key] = np.stack(images)
        return self._found[key]


class Suite:
    """Measurement of scenes with renderers, and the file of its results."""

    def __init__(
        self,
        file: Path,
        scenes: Mapping[str, SuiteScene],
        renderers: Mapping[str, Opener],
        effort: Effort,
        command: str,
        overwrite: bool = False,
    ) -> None:
        """Open the file. Raises InputError for results of another machine or version."""
        self._file, self._scenes, self._effort = file, scenes, effort
        facts = run_facts(None, 0) | {"command": command, "effort": asdict(effort)}
        self.found: dict[str, Any] = {
            "schema": SCHEMA,
            "run": facts,
            "scenes": {},
            "renderers": {},
            "results": [],
        }
        if file.exists() and not overwrite:
            self._resume(from_json(read_text(file)))
        self._openers, self._processes = dict(renderers), {}
        self._reference = reference_renderer(Renderer(), Capture())

    def _resume(self, earlier: Any) -> None:
        schema = earlier.get("schema") if isinstance(earlier, dict) else None
        if schema != SCHEMA:
            raise InputError(
                f"{self._file} must have results of bench --suite, schema {SCHEMA!r}, got {schema!r}; give "
                "another file"
            )
        run = self.found["run"]
        differ = differences(earlier["run"], run)
        differ += [name for name in ("machine", "effort") if earlier["run"].get(name) != run[name]]
        if differ:
            raise InputError(
                f"results in {self._file} must be of the same {' and '.join(differ)}, got others; give "
                "another file, or --overwrite to measure again"
            )
        self.found = earlier

    def run(self, progress: Progress) -> list[dict[str, Any]]:
        """Measure missing scenes and renderers; returns all results. The file is written after each scene."""
        done = {(result["scene"], result["renderer"]) for result in self.found["results"]}
        left = [
            name for name in self._scenes if any((name, renderer) not in done for renderer in self._openers)
        ]
        left.sort(key=lambda name: (self._scenes[name].x is not None, self._scenes[name].large))
        try:
            for number, name in enumerate(left):
                missing = [renderer for renderer in self._openers if (name, renderer) not in done]
                report = lambda words, k=number, name=name: progress(f"{name}: {words}", k / len(left))  # noqa: E731
                self._measure(name, missing, report)
                self.save()
        finally:
            for process in self._processes.values():
                process.close()
        progress("done", 1.0)
        return self.found["results"]

    def save(self) -> None:
        """Write the file with one line per result."""
        compact = partial(json.dumps, allow_nan=False, separators=(",", ":"))
        facts = {name: value for name, value in self.found.items() if name != "results"}
        lines = ",\n".join(compact(result) for result in self.found["results"])
        text = f'{compact(facts)[:-1]},"results":[\n{lines}\n]}}\n'
        with interrupts.postponed(), atomic_write(self._file) as stream:
            stream.write(text.encode())

    def _process(self, name: str) -> RendererProcess:
        """Process of a renderer; started on first use, or again after its end."""
        if name not in self._processes:
            process = self._processes[name] = self._openers[name]()
            self.found["renderers"][name] = (
                {"skipped": process.skipped}
                if process.skipped
                else {**process.facts, "settings": process.settings}
            )
        return self._processes[name]

    def _measure(self, name: str, missing: Sequence[str], report: Callable[[str], None]) -> None:
        scene = self._scenes[name]
        report("making the scene")
        try:
            views = scene.make()
        except FidsplatError as error:  # for example a failed download of a capture
            self._add(name, missing, {"skipped": str(error)})
            return
        self.found["scenes"][name] = rounded(
            {
                "regime": scene.regime,
                "about": scene.about,
                "licence": scene.licence,
                "kind": views.kind,
                "splats": len(views.cloud),
                "width": views.camera.width,
                "height": views.camera.height,
                "views": len(views.poses),
                "batch": scene.batch,
                "x": scene.x,
            }
        )
        count, compared = len(views.poses), self._effort.compared_views
        chosen = np.unique(np.linspace(0, count - 1, compared).astype(int)).tolist()
        references = References(self._reference, views, chosen)
        submissions = [list(range(count))] if scene.batch else [[view] for view in range(count)]
        measurements: list[Measurement] = []
        with tempfile.TemporaryDirectory() as folder:
            file = views.save(Path(folder) / "scene.npz")
            for renderer in missing:
                report(f"first frames of {renderer}")
                try:
                    measurements += self._first_frames(name, renderer, views, references, file, submissions)
                except AdapterError as error:
                    self._failed(renderer)
                    self._add(name, [renderer], {"error": str(error)})
        report("interleaved frames")
        effort = self._effort
        seconds = effort.seconds * (0.5 if scene.x is not None else 1.0)
        fast = [measurement for measurement in measurements if measurement.second_ms <= effort.fast]
        slow = [measurement for measurement in measurements if measurement.second_ms > effort.fast]
        for measurement in fast:  # discard the first frame, which had no warm-up
            measurement.timer.ms.clear()
            measurement.timer.parts.clear()
        for timed, done in ((fast, 0), (slow, 1)):
            time_interleaved(
                [measurement.timer for measurement in timed],
                effort.rounds - done,
                min_rounds=effort.min_rounds - done,
                seconds=seconds - done * sum(measurement.second_ms for measurement in timed) / 1e3,
                warm_up=1 - done,
                tick=interrupts.check,
            )
        metered: set[str] = set()
        for measurement in measurements:
            # energy is measured only for the first setting of each renderer
            with_energy = measurement.process.name not in metered and scene.x is None
            metered.add(measurement.process.name)
            try:
                measurement.finish(self._effort.burst if with_energy else 0.0)
                self.found["results"].append(rounded(measurement.result))
            except AdapterError as error:
                self._failed(measurement.process.name)
                self._add(
                    name, [measurement.process.name], {"setting": measurement.setting, "error": str(error)}
                )

    def _first_frames(
        self,
        name: str,
        renderer: str,
        views: Views,
        references: References,
        file: Path,
        submissions: list[list[int]],
    ) -> list[Measurement]:
        """Load a scene and render the first frames of each setting. Raises AdapterError."""
        process = self._process(renderer)
        measurements: list[Measurement] = []
        settings = {key: kinds for key, kinds in process.settings.items() if views.kind in kinds}
        reason = process.skipped or ("" if settings else f"does not render {views.kind}")
        if reason:
            self._add(name, [renderer], {"skipped": reason})
            return []
        loaded = process.ask("load", file=str(file))
        for setting, image_quality_of in settings.items():
            result = {"scene": name, "renderer": renderer, "setting": setting}
            measurement = Measurement(process, setting, result | loaded, submissions)
            image = measurement.first(references, image_quality_of[views.kind], file.with_name("image.npy"))
            if views.scene is not None:
                readings, _ = read_back(np.clip(image, 0, 1), views.scene, views.camera)
                measurement.result["tags"] = means(readings)
            if measurement.second_ms > TOO_SLOW:
                reason = f"a frame takes {measurement.second_ms / 1e3:.3g} s, more than {TOO_SLOW / 1e3:g} s"
                self._add(name, [renderer], {"setting": setting, "skipped": reason})
            else:
                measurements.append(measurement)
            if measurement.second_ms > self._effort.slow or self._scenes[name].x is not None:
                break
        return measurements

    def _failed(self, renderer: str) -> None:
        """End the process of a renderer that failed; the next scene starts a new one."""
        if renderer in self._processes:
            self._processes.pop(renderer).close()

    def _add(self, scene: str, renderers: Sequence[str], fact: dict[str, str]) -> None:
        self.found["results"] += [{"scene": scene, "renderer": name, **fact} for name in renderers]
