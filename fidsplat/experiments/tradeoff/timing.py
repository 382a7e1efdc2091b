"""Milliseconds of a setting and of the base, turn by turn, and the memory that it takes."""

from __future__ import annotations

from dataclasses import dataclass

from fidsplat.backends.base import Measurable
from fidsplat.experiments.tradeoff.points import BASE
from fidsplat.experiments.tradeoff.session import Session
from fidsplat.quality import Quality
from fidsplat.render import Frame
from fidsplat.timing import frame_timer, quartiles, ratios, take_turns


@dataclass(frozen=True)
class Effort:
    """How long is measured: pairs of frames until `seconds` have passed, within limits."""

    least: int = 5
    most: int = 30
    seconds: float = 0.3


FULL, QUICK = Effort(), Effort(3, 5, 0.2)


def time_point(session: Session, view: str, quality: Quality, effort: Effort) -> tuple[Frame, dict]:
    """Draw a picture at a setting and at the base in turn; splats lie on the device, the picture stays there.

    Returns the picture, and `ms`, `base_ms` (medians), their quartiles, `ratio` (median of the pairs' ratios,
    and its quartiles), `repeats`, `stages_ms` by the device's own clock, `memory_bytes` (scratch, cloud and
    picture; None where the backend cannot tell), `splats`, `pairs`.
    """
    memory = memory_of(session, view, quality)
    frame = session.draw(view, quality)
    own, base = (
        frame_timer(
            session.renderer, on.resident, on.scene.camera, quality=drawn, background=on.scene.background
        )
        for drawn in (quality, BASE)
        for on in [session.scene(view, drawn.marker)]
    )
    take_turns([own, base], effort.most, least=effort.least, seconds=effort.seconds, warm_up=1)
    result: dict = {"repeats": len(own.ms)}
    for name, quarters, values in (
        ("ms", "ms_quartiles", own.ms),
        ("base_ms", "base_quartiles", base.ms),
        ("ratio", "ratio_quartiles", ratios(own, base)),
    ):
        low, result[name], high = quartiles(values)
        result[quarters] = [low, high]
    result |= {"stages_ms": own.part_medians, "memory_bytes": memory}
    return frame, result | {name: frame.stats[name] for name in ("splats", "pairs")}


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
