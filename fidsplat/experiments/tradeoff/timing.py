"""Milliseconds of a setting and of the base, turn by turn, and the memory that it takes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fidsplat.backends.base import Measurable
from fidsplat.experiments.tradeoff.points import BASE
from fidsplat.experiments.tradeoff.session import Session
from fidsplat.quality import Quality
from fidsplat.render import Frame


@dataclass(frozen=True)
class Effort:
    """How long is measured: pairs of frames until `seconds` have passed, within limits."""

    least: int = 5
    most: int = 30
    seconds: float = 0.3


FULL, QUICK = Effort(), Effort(3, 5, 0.2)


def time_point(session: Session, view: str, quality: Quality, effort: Effort) -> tuple[Frame, dict]:
    """Draw a picture at a setting and at the base in turn.

    Splats lie on the device, the picture stays there; a time is from the call until the device is done.
    Each pair begins with the other one of the two, and neither counts before both have been drawn once.

    Returns the picture, and `ms`, `base_ms` (medians), their quartiles, `ratio` (median of the pairs' ratios,
    and its quartiles), `repeats`, `stages_ms` by the device's own clock, `memory_bytes` (scratch, cloud and
    picture; None where the backend cannot tell), `splats`, `pairs`.
    """
    memory = memory_of(session, view, quality)
    frame = session.draw(view, quality)
    stats = dict(frame.stats)
    _ = session.draw(view, BASE).timings
    own: list[float] = []
    base: list[float] = []
    stages: dict[str, list[float]] = {}
    end = time.perf_counter() + effort.seconds
    while len(own) < effort.least or (len(own) < effort.most and time.perf_counter() < end):
        turns = [(quality, own), (BASE, base)]
        for which, times in turns[:: -1 if len(own) % 2 else 1]:
            start = time.perf_counter()
            timings = session.draw(view, which).timings  # waits for the device
            times.append(1e3 * (time.perf_counter() - start))
            if times is own:
                for stage, ms in timings.items():
                    stages.setdefault(stage, []).append(ms)
    ms, ms_quartiles = _middle(own)
    base_ms, base_quartiles = _middle(base)
    ratio, ratio_quartiles = _middle(np.divide(own, base).tolist())
    return frame, {
        "ms": ms,
        "ms_quartiles": ms_quartiles,
        "base_ms": base_ms,
        "base_quartiles": base_quartiles,
        "ratio": ratio,
        "ratio_quartiles": ratio_quartiles,
        "repeats": len(own),
        "stages_ms": {stage: float(np.median(times)) for stage, times in stages.items()},
        "memory_bytes": memory,
        "splats": stats["splats"],
        "pairs": stats["pairs"],
    }


def memory_of(session: Session, view: str, quality: Quality) -> int | None:
    """Bytes on the device of a picture at a setting: scratch, cloud and picture; None where the backend
    cannot tell."""
    backend, scene = session.renderer.backend, session.scene(view, quality.marker).scene
    if not isinstance(backend, Measurable):
        return None
    backend.release_scratch()
    # a cloud keeps every form of its colours that was ever asked for; this one has been asked for nothing yet
    resident = session.renderer.upload(scene.cloud)
    session.renderer.render(resident, scene.camera, ("rgb",), quality, background=scene.background)
    picture = 12 * scene.camera.width * scene.camera.height
    return backend.memory_bytes + resident.memory_bytes + picture


def _middle(values: Sequence[float]) -> tuple[float, list[float]]:
    """The median and the two quartiles."""
    low, middle, high = np.percentile(values, (25, 50, 75))
    return float(middle), [float(low), float(high)]
