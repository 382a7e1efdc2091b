"""How far a device's picture is from the float64 reference: error, certificate, and what is left beyond both.

Colour and alpha are held to 2e-5, depth to 1e-4 of its value, each plus the reference's certificate where a
decision lies on its threshold (numerics.md, section 3). There is no global loose tolerance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fidsplat.backends.base import View
from fidsplat.backends.reference import ReferenceBackend
from fidsplat.cameras import Camera
from fidsplat.effects import select
from fidsplat.quality import Quality
from fidsplat.render import Renderer
from fidsplat.splats import SplatCloud

ALL_OUTPUTS = ("rgb", "alpha", "depth", "depth_median", "normal", "label")
COLOR_TOLERANCE = 2e-5
DEPTH_TOLERANCE = 1e-4
"""relative"""
NORMAL_TOLERANCE = 1e-3
RARE = 1e-3
"""share of pixels whose median depth or label may flip, and whose certificate may exceed `RISKY`"""
RISKY = 0.05


@dataclass(frozen=True)
class Picture:
    """One picture to compare: what is drawn, from where, and how."""

    cloud: SplatCloud
    camera: Camera
    quality: Quality = field(default_factory=Quality)
    outputs: tuple[str, ...] = ("rgb", "alpha")
    background: tuple[float, float, float] = (0.1, 0.2, 0.3)


@dataclass(frozen=True)
class Difference:
    """One plane of one picture against the reference. Errors are absolute for rgb and alpha, relative for
    depth.
    """

    output: str
    error: float
    """largest error, certified pixels included"""
    excess: float
    """largest error beyond tolerance and certificate; at most 0 in agreement. For median depth, labels and
    normals: share of the pixels that differ, less `RARE`"""
    risky: float
    """share of pixels whose certificate exceeds `RISKY`"""
    finite: bool

    @property
    def agrees(self) -> bool:
        """Whether the plane is as it should be."""
        return self.finite and self.excess <= 0 and self.risky < RARE


def truth_of(picture: Picture, pixels: tuple[np.ndarray, np.ndarray] | None = None) -> dict[str, np.ndarray]:
    """The reference's planes with `alpha` and `certificate`: whole, or (k, ...) at pixels (rows, columns)."""
    judge = ReferenceBackend()
    features = select(picture.cloud, (*picture.outputs, "alpha"), picture.quality)
    view = View.of(picture.camera, picture.quality, picture.cloud.origin, picture.background)
    pipeline, resident = judge.pipeline(features), judge.upload(picture.cloud)
    if pixels is not None:
        return pipeline.pixels(resident, view, *pixels)
    return pipeline.render(resident, view).planes


def compare(planes: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray], outputs) -> list[Difference]:
    """Planes of a device against those of `truth_of`, for each of `outputs`."""
    risk, alpha = truth["certificate"], truth["alpha"]
    covered = alpha > 1e-3
    spread = risk / np.where(covered, alpha, 1.0)  # what a flip may move in a mean over the splats
    risky = float((risk > RISKY).mean())
    differences = []
    for name in outputs:
        plane, want = planes[name], truth[name]
        error = np.abs(plane - want)
        if error.ndim > risk.ndim:
            error = error.max(-1)
        if name in ("rgb", "alpha"):
            brightest = max(1.0, float(np.abs(truth.get("rgb", np.ones(1))).max(initial=1.0)))
            excess = (error - COLOR_TOLERANCE - risk * brightest).max(initial=-COLOR_TOLERANCE)
        elif name == "depth":
            excess = np.where(covered, error - spread * want.max(initial=0.0), 0.0) / np.maximum(want, 1e-30)
            excess = excess.max(initial=0.0) - DEPTH_TOLERANCE
            error = error / np.maximum(want, 1e-30)
        else:
            limit = {"normal": NORMAL_TOLERANCE + 4 * spread, "label": 0.0}.get(name, DEPTH_TOLERANCE * want)
            # blended normals may cancel: their direction means little where little is drawn
            wrong = (error > limit) & (covered if name == "normal" else True)
            excess = wrong.mean() - RARE
        worst = float(np.max(error, initial=0.0))
        differences.append(Difference(name, worst, float(excess), risky, bool(np.isfinite(plane).all())))
    return differences


def judge(renderer: Renderer, picture: Picture) -> list[Difference]:
    """Draw a picture on a device and compare every output with the reference."""
    frame = renderer.render(
        picture.cloud,
        picture.camera,
        outputs=picture.outputs,
        quality=picture.quality,
        background=picture.background,
    )
    return compare(frame, truth_of(picture), picture.outputs)
