"""How far a device's picture is from the float64 reference: error, certificate, and what is left beyond both.

Colour, alpha and normals are held to 2e-5, depth to 1e-4 of its value, each plus the reference's certificate:
what float32 may change in that pixel, because a decision lies on its threshold or a splat is thinner than the
rounding of its distance (numerics.md, section 3). Median depth and labels may differ only where the reference
says that they may flip. There is no global loose tolerance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fidsplat.backends.prepare import prepare
from fidsplat.backends.probing import Reshapes
from fidsplat.backends.reference import ReferenceBackend
from fidsplat.backends.view import View
from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture
from fidsplat.capture.environment import Background, Fog
from fidsplat.capture.quality import Quality
from fidsplat.capture.sensor import Sensor
from fidsplat.effects import OUTPUTS, FeatureSet
from fidsplat.render.frame import Frame
from fidsplat.render.renderer import Renderer
from fidsplat.splats.cloud import SplatCloud

ALL_OUTPUTS = ("rgb", "alpha", "depth", "depth_median", "normal", "label")
COLOR_TOLERANCE = 2e-5
DEPTH_TOLERANCE = 1e-4
"""relative"""
TOLERANCE = (
    dict.fromkeys(OUTPUTS, 0.0)
    | dict.fromkeys(("rgb", "alpha", "normal", "normal_world"), COLOR_TOLERANCE)
    | dict.fromkeys(("depth", "distance"), DEPTH_TOLERANCE)
)
"""What each output may be wrong beyond its certificate."""
RARE = 1e-3
"""share of pixels whose certificate may exceed `RISKY`"""
RISKY = 0.05
CATALOGUED = Quality(alpha_cutoff=1 / 255)
"""the cut-off that the triggers of numerics.md are written for; the fuzzer and the contract tests draw with
the presets"""
CULLED = 0xFFFFFFFF
"""depth key of a splat that is not drawn, on devices"""


@dataclass(frozen=True)
class Picture:
    """One picture to compare: what is drawn, from where, and how."""

    cloud: SplatCloud
    camera: Camera
    quality: Quality = CATALOGUED
    outputs: tuple[str, ...] = ("rgb", "alpha")
    background: Background = (0.1, 0.2, 0.3)
    sensor: Sensor | None = None
    fog: Fog | None = None

    @property
    def capture(self) -> Capture:
        """How it is taken."""
        sensor = self.sensor or Sensor()
        return Capture(self.camera, self.outputs, self.quality, self.background, sensor=sensor, fog=self.fog)

    def prepared(self, *more: str) -> tuple[FeatureSet, View]:
        """What a backend draws, with these outputs too."""
        return prepare(self.cloud, self.capture.with_(outputs=(*self.outputs, *more)))


@dataclass(frozen=True)
class Difference:
    """One output of one picture against the reference. Errors are absolute for rgb, alpha and normals,
    relative for depth; for median depth and labels they are the share of pixels that differ.
    """

    output: str
    error: float
    """largest error, certified pixels included"""
    excess: float
    """largest error beyond certificate and `TOLERANCE`; at most 0 in agreement"""
    risky: float
    """share of pixels whose certificate exceeds `RISKY`"""
    finite: bool

    @property
    def uncertified(self) -> float:
        """Largest error beyond the certificate."""
        return self.excess + TOLERANCE[self.output]

    @property
    def agrees(self) -> bool:
        """Whether the output is as it should be."""
        return self.finite and self.excess <= 0 and self.risky < RARE


def draw(renderer: Renderer, picture: Picture) -> Frame:
    """The picture on a device."""
    return renderer.render(picture.cloud, picture.capture)


def truth_of(picture: Picture, pixels: tuple[np.ndarray, np.ndarray] | None = None) -> dict[str, np.ndarray]:
    """The reference's images with `alpha` and `certificate`: whole, or (k, ...) at pixels (rows, columns)."""
    reference = ReferenceBackend()
    features, view = picture.prepared("alpha")
    pipeline, resident = reference.pipeline(features), reference.upload(picture.cloud)
    if pixels is not None:
        return pipeline.pixels(resident, view, *pixels)
    return pipeline.render(resident, view).images


def compare(images: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray], outputs) -> list[Difference]:
    """Images of a device against those of `truth_of`, for each of `outputs`."""
    risk = truth["certificate"]
    brightest = max(1.0, float(np.abs(truth["rgb"]).max(initial=1.0)))
    risky = float((risk > RISKY).mean())
    found = []
    for name in outputs:
        image, want = images[name], truth[name]
        error = np.abs(image - want)
        if error.ndim > risk.ndim:
            error = error.max(-1)
        if TOLERANCE[name] == 0:
            error = error > (
                DEPTH_TOLERANCE * want if name.startswith("d") else truth.get(f"{name}_bound", 0)
            )
            worst = float(error.mean())
            beyond = float((error & ~truth.get(f"{name}_may_flip", np.zeros(error.shape, bool))).mean())
        else:
            if name in ("rgb", "alpha"):
                certified = risk * brightest
                if name == "rgb":
                    certified = truth.get("certificate_rgb", certified)
            else:
                certified = truth[f"certificate_{name}"]
            # parallel rays see what lies behind the camera's plane, at negative depths
            size = np.maximum(np.abs(want), 1e-30) if name in ("depth", "distance") else 1.0
            worst = float((error / size).max(initial=0.0))
            beyond = float(((error - certified) / size).max(initial=0.0))
        excess, finite = beyond - TOLERANCE[name], bool(np.isfinite(image).all())
        found.append(Difference(name, worst, excess, risky, finite))
    return found


def trace(renderer: Renderer, picture: Picture, shape=None) -> dict[str, np.ndarray]:
    """What passes between the stages of a device, with the outputs; `shape` replaces its build constants."""
    features, view = picture.prepared()
    backend = renderer.backend
    if shape is not None and isinstance(backend, Reshapes):
        pipeline = backend.pipeline(features, shape)
    else:
        pipeline = backend.pipeline(features)
    return pipeline.trace(backend.upload(picture.cloud), view)


def differing(first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray], outputs) -> int:
    """Number of pixels whose bits differ in any of the outputs; all of them where the shapes differ."""
    different = np.zeros((), bool)
    for name in outputs:
        one, other = (np.ascontiguousarray(images[name]) for images in (first, second))
        if one.shape != other.shape:
            return max(one.size, other.size)
        bits = f"u{one.itemsize}"
        unlike = one.view(bits) != other.view(bits)
        different = different | (unlike.any(-1) if unlike.ndim == 3 else unlike)
    return int(different.sum())


def out_of_order(traced: Mapping[str, np.ndarray], wanted: np.ndarray) -> int:
    """How many splats of a trace do not follow the order `wanted` (visible,), in tiles' lists or at all."""
    if "lists" not in traced:
        return int((traced["order"] != wanted).sum())
    rank = np.full(len(traced["keys"]), -1)
    rank[wanted] = np.arange(len(wanted))
    places, starts = rank[traced["lists"]], traced["starts"].astype(np.int64)
    follows = np.ones(len(places), bool)  # the one before it in the same list
    follows[starts[:-1][starts[:-1] < len(places)]] = False
    return int((places < 0).sum() + (follows[1:] & (np.diff(places) <= 0)).sum())
