"""A long run of the fuzzer: what it has found so far, in a file, so that a run that is stopped goes on."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from fidsplat.files import atomic_write
from fidsplat.hard_cases import fuzz
from fidsplat.hard_cases.agreement import ALL_OUTPUTS, RARE, RISKY, compare, draw, truth_of
from fidsplat.provenance import code_hash
from fidsplat.render import Renderer

_SAVE_EVERY = 5.0  # seconds


@dataclass
class FuzzState:
    """Figures over all scenes from seed 0 to `scenes` - 1."""

    key: str
    """device, driver and sources that they hold for"""
    scenes: int = 0
    splats: int = 0
    pixels: int = 0
    risky: int = 0
    """pixels whose certificate exceeds 0.05"""
    uncertified: dict[str, tuple[float, int]] = field(default_factory=dict)
    """output -> largest error beyond the certificate, and its seed"""
    largest: dict[str, tuple[float, int]] = field(default_factory=dict)
    """output -> largest error, certified ones included, and its seed"""
    failing: list[int] = field(default_factory=list)
    """seeds with an error above its tolerance beyond the certificate, or a value that is not finite"""
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether no seed fails and few pixels have large certificates."""
        return not self.failing and self.risky <= RARE * self.pixels

    def add(self, seed: int, renderer: Renderer) -> None:
        """Draw the scene of the next seed and compare it."""
        picture = fuzz.scene_of(seed)
        truth = truth_of(picture)
        failed = False
        for difference in compare(draw(renderer, picture), truth, ALL_OUTPUTS):
            name = difference.output
            failed |= not (difference.finite and difference.excess <= 0)
            errors = (self.uncertified, difference.uncertified), (self.largest, difference.error)
            for record, value in errors:
                value = float("inf") if np.isnan(value) else value
                if name not in record or value > record[name][0]:
                    record[name] = value, seed
        if failed:
            self.failing.append(seed)
        self.scenes, self.splats = seed + 1, self.splats + len(picture.cloud)
        self.pixels += truth["certificate"].size
        self.risky += int((truth["certificate"] > RISKY).sum())


def fuzz_run(renderer: Renderer, splats: int, file: Path | None = None) -> Iterator[FuzzState]:
    """Draw scenes until they hold `splats` splats; yields the state after each.

    A run that was stopped, with the same device and kernels, goes on from `file`; one that has reached its
    number starts again. Raises InputError when the file cannot be written.
    """
    state = _load(file, _key(renderer))
    if state.splats >= splats:
        state = FuzzState(state.key)
    saved = began = time.monotonic()
    before = state.seconds
    while state.splats < splats:
        state.add(state.scenes, renderer)
        now = time.monotonic()
        state.seconds = before + now - began
        if file is not None and (now - saved > _SAVE_EVERY or state.splats >= splats):
            with atomic_write(file) as stream:
                stream.write(json.dumps(asdict(state), indent=1).encode())
            saved = now
        yield state


def _key(renderer: Renderer) -> str:
    device = renderer.device
    return " | ".join((device.title, device.platform, device.version, code_hash()))


def _load(file: Path | None, key: str) -> FuzzState:
    try:
        values = json.loads(file.read_text("utf-8")) if file is not None else {}
        if values.get("key") != key:
            return FuzzState(key)
        for name in ("uncertified", "largest"):
            values[name] = {output: (float(pair[0]), int(pair[1])) for output, pair in values[name].items()}
        return FuzzState(**values)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):  # none yet, or not one of ours
        return FuzzState(key)
