"""How far a device's picture is from the float64 reference: error, certificate, and what is left beyond both.

Colour, alpha and normals are held to 2e-5, depth to 1e-4 of its value, each plus the reference's certificate:
what float32 may change in that pixel, because a decision lies on its threshold or a splat is thinner than the
rounding of its distance (numerics.md, section 3). Median depth and labels may differ only where the reference
says that they may flip. There is no global loose tolerance.
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
RARE = 1e-3
"""share of pixels whose certificate may exceed `RISKY`"""
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
    """largest error beyond tolerance and certificate; at most 0 in agreement. For median depth and labels:
    share of the pixels that differ and may not"""
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
    risk = truth["certificate"]
    covered = truth["alpha"] > 1e-3
    brightest = max(1.0, float(np.abs(truth["rgb"]).max(initial=1.0)))
    risky = float((risk > RISKY).mean())
    differences = []
    for name in outputs:
        plane, want = planes[name], truth[name]
        error = np.abs(plane - want)
        if error.ndim > risk.ndim:
            error = error.max(-1)
        if name in ("rgb", "alpha"):
            excess = (error - risk * brightest).max(initial=0.0) - COLOR_TOLERANCE
        elif name == "normal":
            beyond = np.where(covered, error - truth["certificate_normal"], 0.0)
            excess = beyond.max(initial=0.0) - COLOR_TOLERANCE
        elif name == "depth":
            size = np.maximum(want, 1e-30)
            beyond = np.where(covered, error - truth["certificate_depth"], 0.0)
            excess = (beyond / size).max(initial=0.0) - DEPTH_TOLERANCE
            error = error / size
        else:
            limit = DEPTH_TOLERANCE * want if name == "depth_median" else 0.0
            excess = ((error > limit) & ~truth[f"{name}_may_flip"]).mean()
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
