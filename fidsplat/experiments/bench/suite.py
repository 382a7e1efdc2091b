"""`fidsplat bench --suite`: time and error of renderers in processes of their own, by scene.

Results are one JSON object per machine (benchmarks/splatmark.schema.json), written after each scene. A run
with the same file measures the scenes and renderers that it lacks.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
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
from fidsplat.util.provenance import run_facts
from fidsplat.util.timing import Clock, Timer, quartiles, time_interleaved
from fidsplat.vision.readback import means, read_back

SCHEMA = 1
"""version of the format of the results"""
SLOW, TOO_SLOW = 1000.0, 10_000.0
"""Milliseconds of a frame. Above SLOW, a renderer is measured at its first setting, and interleaved
separately, so that faster renderers have more rounds. Above TOO_SLOW it is left out."""
Progress = Callable[[str, float], None]


class AdapterError(FidsplatError):
    """A renderer failed; the message is its own."""


@dataclass(frozen=True)
class Effort:
    """Length of the measurement of a scene."""

    rounds: int
    """maximum number of timed frames of each setting"""
    seconds: float
    """time after which no round is started, after `min_rounds` rounds"""
    min_rounds: int = 3
    burst: float = 0.5
    """seconds of frames for the energy of a frame"""
    compared_views: int = 3
    """maximum number of views whose images are compared"""


FULL, QUICK = Effort(40, 6.0), Effort(7, 1.0, compared_views=1)


class RendererProcess:
    """A renderer in a process of its own (`adapter.py`). A renderer that cannot run has a reason in
    `skipped`."""

    def __init__(
        self,
        name: str,
        file: Path,
        device: str | None = None,
        python: str = sys.executable,
        tree: Path | None = None,
    ) -> None:
        """
        Args:
            file: file of the class `Adapter`.
            python: interpreter of its environment.
            tree: checkout whose package fidsplat is used instead of the installed one.
        """
        self.name, self.clock, self.device_ms = name, Clock(), [0.0]
        path = [str(tree)] if tree else [*filter(None, [os.environ.get("PYTHONPATH")])]
        self._process = subprocess.Popen(
            [python, "-P", adapter.__file__, str(file), *([device] if device else [])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL if not os.environ.get("FIDSPLAT_DEBUG") else None,
            env=os.environ | ({"PYTHONPATH": os.pathsep.join(path)} if path else {}),
            start_new_session=True,  # Ctrl-C is for this process, which closes the pipes
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
        """Send a request. Raises AdapterError."""
        assert self._process.stdin is not None
        with suppress(OSError):  # if the process has ended, no answer follows
            self._process.stdin.write(json.dumps({"do": do, **request}).encode() + b"\n")
            self._process.stdin.flush()
        return self._answer()

    def frame(self, setting: str, views: list[int]) -> float:
        """Render one submission; the clock advances by its time. Returns milliseconds."""
        taken = self.ask("frame", setting=setting, views=views)
        self.clock.seconds += taken["ms"] / 1e3
        self.device_ms = [taken.get("device_ms")]
        return taken["ms"]

    def _answer(self) -> dict[str, Any]:
        line = next(self._answers, None)
        if line is None:
            raise AdapterError(f"the process ended with status {self._process.wait()}")
        found = from_json(line)
        if "error" in found:
            raise AdapterError(found["error"])
        return found

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        with suppress(OSError):  # it may have ended
            self._process.stdin.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


Opener = Callable[[], RendererProcess]


def own_renderers(devices: Sequence[str]) -> dict[str, Opener]:
    """fidsplat on each device, by name."""
    file = Path(own_adapter.__file__)
    names = {f"fidsplat {device}": device for device in devices}
    return {name: partial(RendererProcess, name, file, device) for name, device in names.items()}


def other_renderers(folder: Path) -> dict[str, Opener]:
    """Renderers of the adapters `NAME/adapter.py` of a folder; each in the environment `NAME/.venv`, if there
    is one.

    Raises InputError if there is none.
    """
    files = sorted(folder.glob("*/adapter.py"))
    if not files:
        raise InputError(f"--adapters must be a folder with NAME/adapter.py, got {folder}")
    found = {}
    for file in files:
        own = file.parent / ".venv" / "bin" / "python"
        python = str(own) if own.is_file() else sys.executable
        found[file.parent.name] = partial(RendererProcess, file.parent.name, file, python=python)
    return found


class References:
    """Float64 reference images of a scene by definition of the image."""

    def __init__(self, renderer: Renderer, views: Views, chosen: list[int]) -> None:
        self._renderer, self._views, self.chosen = renderer, views, chosen
        self._resident: Any = None
        self._found: dict[str, np.ndarray] = {}

    def image(self, claim: Mapping[str, Any]) -> np.ndarray:
        """(v, h, w, 3) float64 of the chosen views."""
        claim = dict(claim)
        if not self._views.cloud.has_coplanar_groups and claim.get("order") == "auto":
            claim["order"] = "centre"  # the same image
        if self._views.kind != ELLIPSOIDS:
            claim.pop("ellipsoid", None)
        key = json.dumps(claim, sort_keys=True)
        if key not in self._found:
            if self._resident is None:
                self._resident = self._renderer.upload(self._views.cloud)
            quality = Quality().with_(**claim)
            captures = (
                Capture(self._views.camera.with_pose(self._views.poses[k]), quality=quality)
                for k in self.chosen
            )
            images = [reference_image(self._renderer, self._resident, capture) for capture in captures]
            self._found[key] = np.stack(images)
        return self._found[key]


class Suite:
    """Measurement of scenes by renderers, with a file of results."""

    def __init__(
        self,
        file: Path,
        scenes: Mapping[str, SuiteScene],
        renderers: Mapping[str, Opener],
        effort: Effort,
        command: str,
        overwrite: bool = False,
    ) -> None:
        """Opens the renderers. Raises InputError for a file with results of another machine or version."""
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
        if not isinstance(earlier, dict) or earlier.get("schema") != SCHEMA:
            raise InputError(f"{self._file} must hold results of bench --suite; give another file")
        run = self.found["run"]
        differ = differences(earlier["run"], run) + (
            ["machine"] * (earlier["run"]["machine"] != run["machine"])
        )
        if differ:
            raise InputError(
                f"{self._file} holds results of another {' and '.join(differ)}; give another file, or "
                "--overwrite to measure again"
            )
        self.found = earlier

    def run(self, progress: Progress) -> list[dict[str, Any]]:
        """Measure what the file lacks; returns all results. Each scene is in the file when it is complete."""
        done = {(result["scene"], result["renderer"]) for result in self.found["results"]}
        left = [name for name in self._scenes if any((name, one) not in done for one in self._openers)]
        left.sort(key=lambda name: (self._scenes[name].x is not None, self._scenes[name].large))
        try:
            for number, name in enumerate(left):
                missing = [one for one in self._openers if (name, one) not in done]
                report = lambda words, k=number, name=name: progress(f"{name}: {words}", k / len(left))  # noqa: E731
                self._measure(name, missing, report)
                self.save()
        finally:
            for process in self._processes.values():
                process.close()
        progress("done", 1.0)
        return self.found["results"]

    def save(self) -> None:
        with interrupts.postponed(), atomic_write(self._file) as stream:
            stream.write((json.dumps(self.found, indent=0, allow_nan=False) + "\n").encode())

    def _process(self, name: str) -> RendererProcess:
        """Process of a renderer, started when it is first used or has ended."""
        if name not in self._processes:
            process = self._processes[name] = self._openers[name]()
            facts = {"skipped": process.skipped} if process.skipped else process.facts
            self.found["renderers"][name] = facts
        return self._processes[name]

    def _measure(self, name: str, missing: Sequence[str], report: Callable[[str], None]) -> None:
        scene = self._scenes[name]
        report("making the scene")
        try:
            views = scene.make()
        except FidsplatError as error:  # a capture that cannot be downloaded
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
        chosen = np.unique(
            np.linspace(0, len(views.poses) - 1, self._effort.compared_views).astype(int)
        ).tolist()
        references = References(self._reference, views, chosen)
        timers: list[tuple[Timer, dict[str, Any], RendererProcess, str]] = []
        with tempfile.TemporaryDirectory() as folder:
            file = views.save(Path(folder) / "scene.npz")
            for renderer in missing:
                report(f"first frames of {renderer}")
                process = self._process(renderer)
                if process.skipped:
                    self._add(name, [renderer], {"skipped": process.skipped})
                    continue
                settings = {key: claims for key, claims in process.settings.items() if views.kind in claims}
                if scene.x is not None:
                    settings = dict(list(settings.items())[:1])
                if not settings:
                    self._add(name, [renderer], {"skipped": f"does not render {views.kind}"})
                    continue
                try:
                    loaded = process.ask("load", file=str(file))
                    for number, (setting, claims) in enumerate(settings.items()):
                        claim, image = claims[views.kind], Path(folder) / "image.npy"
                        result = {"scene": name, "renderer": renderer, "setting": setting, "claim": claim}
                        result |= loaded | self._first(process, setting, claim, references, views, image)
                        ms = result["first_ms"][-1]
                        if ms > TOO_SLOW:
                            reason = f"a frame takes {ms / 1e3:.3g} s, more than {TOO_SLOW / 1e3:g} s"
                            self._add(name, [renderer], {"setting": setting, "skipped": reason})
                        else:
                            timer = self._timer(process, setting, scene, len(views.poses))
                            # the first setting has the energy
                            timers.append((timer, result, process, setting if number == 0 else ""))
                        if ms > SLOW:
                            break
                except AdapterError as error:
                    timers = [one for one in timers if one[2] is not process]
                    self._processes.pop(renderer).close()
                    self._add(name, [renderer], {"error": str(error)})
            report("interleaved frames")
            for slow in (False, True):
                group = [one[0] for one in timers if (one[1]["first_ms"][-1] > SLOW) == slow]
                effort = self._effort
                time_interleaved(
                    group,
                    effort.rounds,
                    min_rounds=effort.min_rounds,
                    seconds=effort.seconds * (0.5 if scene.x is not None else 1.0),
                    warm_up=0 if slow else 1,
                    tick=interrupts.check,
                )
            for timer, result, process, metered in timers:
                self._finish(timer, result, process, metered, scene, len(views.poses))

    def _first(
        self,
        process: RendererProcess,
        setting: str,
        claim: Mapping[str, Any],
        references: References,
        views: Views,
        file: Path,
    ) -> dict[str, Any]:
        """First frames of a setting, and the errors of its images."""
        taken, images = [], []
        for view in references.chosen:
            taken.append(process.frame(setting, [view]))
            memory = process.ask("image", file=str(file))
            images.append(np.load(file)[0])
        image, reference = np.stack(images), references.image(claim)
        off = np.abs(image - reference)
        if not np.isfinite(off).all():
            raise AdapterError(f"{setting}: the image has values that are not finite")
        facts = {
            "first_ms": [taken[0], process.frame(setting, [references.chosen[0]])],
            **memory,
            "largest_error": float(off.max()),
            "mean_error": float(off.mean()),
            "psnr_db": float(-10 * np.log10(max(np.mean(off**2), 1e-20))),
        }
        if views.scene is not None:
            readings, _ = read_back(np.clip(images[0], 0, 1), views.scene, views.camera)
            facts["tags"] = means(readings)
        return facts

    def _timer(self, process: RendererProcess, setting: str, scene: SuiteScene, count: int) -> Timer:
        """Timer of a setting: all views of a batch, else the next view at each call."""
        number = iter(range(sys.maxsize))
        views = lambda: list(range(count)) if scene.batch else [next(number) % count]  # noqa: E731

        def render() -> dict[str, float]:
            process.frame(setting, views())
            device = process.device_ms[0]
            return {} if device is None else {"device": device}

        return Timer(render, process.clock, catch_errors=True)

    def _finish(
        self,
        timer: Timer,
        result: dict[str, Any],
        process: RendererProcess,
        metered: str,
        scene: SuiteScene,
        count: int,
    ) -> None:
        """Add a result: times per view, and joules of the setting `metered` if the machine reports them."""
        if timer.error or not timer.ms:
            if self._processes.get(process.name) is process:  # it may have ended
                self._processes.pop(process.name).close()
            self.found["results"].append(
                {key: result[key] for key in ("scene", "renderer", "setting")} | {"error": timer.error}
            )
            return
        per_call = count if scene.batch else 1
        result["first_frame_ms"] = result.pop("first_ms")[0]
        result |= {
            "quartiles_ms": [ms / per_call for ms in quartiles(timer.ms)],
            "fastest_ms": min(timer.ms) / per_call,
            "frames": len(timer.ms),
        }
        if "device" in timer.parts:
            result["device_ms"] = timer.part_medians["device"] / per_call
        meter = energy_meter(process.facts.get("kind", "cpu"))
        if meter is not None and metered and scene.x is None:
            before = meter()
            views = list(range(count)) if scene.batch else [0]
            burst = process.ask("burst", setting=metered, views=views, seconds=self._effort.burst)
            result["joules"] = (meter() - before) / (burst["submissions"] * per_call)
        self.found["results"].append(rounded(result))

    def _add(self, scene: str, renderers: Sequence[str], fact: dict[str, str]) -> None:
        self.found["results"] += [{"scene": scene, "renderer": name, **fact} for name in renderers]
