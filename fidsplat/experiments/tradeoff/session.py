"""What is open while points are measured: a renderer, the scenes on its device, their truths; and how long a
setting takes beside the base, turn by turn."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fidsplat.accuracy.error import full_precision, reference_image, reference_renderer
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import MarkerQuality, Quality
from fidsplat.experiments.tradeoff.points import BASE
from fidsplat.experiments.tradeoff.scenes import Own, TradeScene, make
from fidsplat.render.frame import Frame
from fidsplat.render.renderer import Renderer
from fidsplat.render.resident import ResidentCloud
from fidsplat.util.timing import frame_timer, quartiles, ratios, time_interleaved

_SCENES, _TRUTHS = 12, 6
"""kept at a time"""
DEFINITION = ("lowpass", "samples", "order")
"""knobs that say what a picture is; the others say how well it is drawn, and `ellipsoid` how near to 3D
Gaussians themselves"""


class Session:
    """Scenes and truths are made when they are first asked for, and the last few are kept.

    Truths are drawn by the renderer itself, or by OpenCL on the processor where it cannot blend in float64.
    """

    def __init__(self, renderer: Renderer, own: Own | None = None) -> None:
        """own: one's own pictures, which have the splats of their files, whatever the knobs of markers."""
        self.renderer, self._reference = renderer, reference_renderer(renderer, Capture())
        self._own, self._uploaded = own or {}, {}
        self._made = lru_cache(_SCENES)(make)
        self.resident = lru_cache(_SCENES)(self._resident)
        """(view, knobs of markers) -> its splats on the device"""
        self._truth = lru_cache(_TRUTHS)(self._draw_truth)

    def scene(self, view: str, knobs: MarkerQuality) -> TradeScene:
        """A picture's scene."""
        return self._own[view] if view in self._own else self._made(view, knobs)

    def _resident(self, view: str, knobs: MarkerQuality) -> ResidentCloud:
        cloud = self.scene(view, knobs).cloud
        if view not in self._own:
            return self.renderer.upload(cloud)
        if id(cloud) not in self._uploaded:  # the views of a file show the same splats
            self._uploaded[id(cloud)] = self.renderer.upload(cloud)
        return self._uploaded[id(cloud)]

    def draw(self, view: str, quality: Quality) -> Frame:
        """The picture at a setting, not waited for."""
        capture = self.scene(view, quality.marker).capture
        return self.renderer.render(self.resident(view, quality.marker), capture, quality=quality)

    def truth(self, view: str, quality: Quality) -> np.ndarray:
        """(h, w, 3) float64: the same splats by the same definition at full precision."""
        return self._truth(view, self.definition(view, quality))

    def _draw_truth(self, view: str, like: Quality) -> np.ndarray:
        scene, own = self.scene(view, like.marker), self._reference is self.renderer
        what = self.resident(view, like.marker) if own else scene.cloud
        return reference_image(self._reference, what, scene.capture.with_(quality=like))

    def definition(self, view: str, quality: Quality) -> Quality:
        """The base with what `quality` says of the definition; 3D Gaussians as they are, in one's own
        pictures as the setting draws them: captures look as they did to their trainer."""
        asked = {name: getattr(quality, name) for name in DEFINITION}
        ellipsoid = quality.ellipsoid if view in self._own else "exact"
        return BASE.with_(**asked, ellipsoid=ellipsoid, marker=quality.marker)

    def full(self, view: str, quality: Quality) -> Quality:
        """The setting at which `truth` is drawn."""
        like = Capture(quality=self.definition(view, quality))
        return full_precision(like, self._reference).quality


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
            session.renderer,
            session.resident(view, drawn.marker),
            session.scene(view, drawn.marker).capture,
            quality=drawn,
        )
        for drawn in (quality, BASE)
    )
    time_interleaved([own, base], effort.most, min_rounds=effort.least, seconds=effort.seconds, warm_up=1)
    result: dict = {"repeats": len(own.ms), "stages_ms": own.part_medians, "memory_bytes": memory}
    for name, values in (("ms", own.ms), ("base_ms", base.ms), ("ratio", ratios(own, base))):
        low, result[name], high = quartiles(values)
        result[f"{name.removesuffix('_ms')}_quartiles"] = [low, high]
    return frame, result | {name: frame.stats[name] for name in ("splats", "pairs")}


def memory_of(session: Session, view: str, quality: Quality) -> int | None:
    """Bytes on the device of a picture at a setting: scratch, cloud and picture; None where the backend
    cannot tell."""
    backend, scene = session.renderer.backend, session.scene(view, quality.marker)
    if not backend.traits.measures_rates:
        return None
    backend.release_scratch()
    # a cloud keeps every form of its colours that was ever asked for; this one has been asked for nothing yet
    resident = session.renderer.upload(scene.cloud)
    session.renderer.render(resident, scene.capture, quality=quality)
    return backend.memory_bytes + resident.memory_bytes + 12 * scene.camera.width * scene.camera.height
