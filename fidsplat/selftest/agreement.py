"""Comparison of a device's images with the float64 reference, with an error bound per pixel.

The tolerance of an output is declared in fidsplat/effects/catalogue.py. The reference adds an error bound per
pixel: the change that float32 rounding may cause there, because a decision is at its threshold or a splat is
thinner than the rounding of its distance (docs/correctness.md). Outputs that jump at a decision, such as
labels, may differ only in pixels that the reference marks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fidsplat.backends.prepare import prepare
from fidsplat.backends.reference import ReferenceBackend
from fidsplat.backends.view import View
from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture
from fidsplat.capture.environment import Background, Fog
from fidsplat.capture.quality import Quality
from fidsplat.capture.sensor import Sensor
from fidsplat.effects import FeatureSet, declared_output
from fidsplat.render.frame import Frame
from fidsplat.render.renderer import Renderer
from fidsplat.splats.cloud import SplatCloud

ALL_OUTPUTS = ("rgb", "alpha", "depth", "depth_median", "normal", "label")
COLOR_TOLERANCE = declared_output("rgb").tolerance
DEPTH_TOLERANCE = declared_output("depth").tolerance
"""relative slack for the rounding of the comparison"""
RARE = 1e-3
"""maximum fraction of pixels with an error bound above `RISKY`"""
RISKY = 0.05
CATALOGUED = Quality(alpha_cutoff=1 / 255)
"""alpha cut-off of the catalogue's cases; the fuzzer and the contract tests use the presets"""
CULLED = 0xFFFFFFFF
"""sort key of a culled splat, on devices"""


@dataclass(frozen=True)
class FrameSpec:
    """A frame to compare: cloud, camera and settings."""

    cloud: SplatCloud
    camera: Camera
    quality: Quality = CATALOGUED
    outputs: tuple[str, ...] = ("rgb", "alpha")
    background: Background = (0.1, 0.2, 0.3)
    sensor: Sensor | None = None
    fog: Fog | None = None

    @property
    def capture(self) -> Capture:
        sensor = self.sensor or Sensor()
        return Capture(self.camera, self.outputs, self.quality, self.background, sensor=sensor, fog=self.fog)

    def prepared(self, *more: str) -> tuple[FeatureSet, View]:
        """Features and view of the frame with additional outputs."""
        return prepare(self.cloud, self.capture.with_(outputs=(*self.outputs, *more)))


@dataclass(frozen=True)
class Difference:
    """Error of one output of one frame relative to the reference.

    Errors are in units of the output, or relative if the output is declared so. For discontinuous outputs the
    error is the fraction of pixels that differ.
    """

    output: str
    error: float
    """largest error, including pixels with an error bound"""
    excess: float
    """largest error beyond error bound and tolerance; at most 0 if the device agrees"""
    risky: float
    """fraction of pixels whose error bound exceeds `RISKY`"""
    finite: bool

    @property
    def beyond_bound(self) -> float:
        """Largest part of an error that exceeds the error bound of its pixel."""
        return self.excess + tolerance_of(self.output)

    @property
    def agrees(self) -> bool:
        """Whether the output is within its tolerance."""
        return self.finite and self.excess <= 0 and self.risky < RARE


def tolerance_of(name: str) -> float:
    """Allowed error of an output beyond its error bound; 0 (fraction of pixels) if discontinuous."""
    output = declared_output(name)
    return 0.0 if output.discontinuous else output.tolerance


def render(renderer: Renderer, spec: FrameSpec) -> Frame:
    return renderer.render(spec.cloud, spec.capture)


def reference_images(
    spec: FrameSpec, pixels: tuple[np.ndarray, np.ndarray] | None = None
) -> dict[str, np.ndarray]:
    """Images of the reference with `alpha` and `error_bound`: all pixels, or (k, ...) at (rows, columns)."""
    reference = ReferenceBackend()
    features, view = spec.prepared("alpha")
    pipeline, resident = reference.pipeline(features), reference.upload(spec.cloud)
    if pixels is not None:
        return pipeline.pixels(resident, view, *pixels)
    return pipeline.render_view(resident, view).arrays_of(0)


def compare(
    images: Mapping[str, np.ndarray], reference: Mapping[str, np.ndarray], outputs
) -> list[Difference]:
    """Compare images of a device with those of `reference_images`, for each of `outputs`."""
    risky = float((reference["error_bound"] > RISKY).mean())
    differences = []
    for name in outputs:
        errors = _flips if declared_output(name).discontinuous else _errors
        worst, beyond = errors(name, images[name], reference)
        finite = bool(np.isfinite(images[name]).all())
        differences.append(Difference(name, worst, beyond - tolerance_of(name), risky, finite))
    return differences


def _errors(name: str, image: np.ndarray, reference: Mapping[str, np.ndarray]) -> tuple[float, float]:
    """Largest error of a continuous output, and largest error beyond the error bound."""
    expected, bound = reference[name], _error_bound(name, reference)
    error = np.abs(image - expected)
    if error.ndim > reference["error_bound"].ndim:
        error = error.max(-1)
    # parallel rays have negative depths behind the camera's plane
    size = np.maximum(np.abs(expected), 1e-30) if declared_output(name).relative else 1.0
    return float((error / size).max(initial=0.0)), float(((error - bound) / size).max(initial=0.0))


def _error_bound(name: str, reference: Mapping[str, np.ndarray]) -> np.ndarray:
    """Change of an output that float32 may cause in each pixel."""
    if name not in ("rgb", "alpha"):
        return reference[f"error_bound_{name}"]
    brightest = max(1.0, float(np.abs(reference["rgb"]).max(initial=1.0)))
    in_colors = reference["error_bound"] * brightest
    return reference.get("error_bound_rgb", in_colors) if name == "rgb" else in_colors


def _flips(name: str, image: np.ndarray, reference: Mapping[str, np.ndarray]) -> tuple[float, float]:
    """Fraction of pixels in which a discontinuous output differs, and fraction that differs without an
    error bound."""
    output, expected = declared_output(name), reference[name]
    limit = (
        output.tolerance * expected if output.relative else reference.get(f"{name}_bound", output.tolerance)
    )
    differs = np.abs(image - expected) > limit
    may_flip = reference.get(f"{name}_may_flip", np.zeros(differs.shape, bool))
    return float(differs.mean()), float((differs & ~may_flip).mean())


def render_intermediates(renderer: Renderer, spec: FrameSpec, shape=None) -> dict[str, np.ndarray]:
    """Render a frame; returns the buffers between its stages, and its outputs. shape: build constants."""
    features, view = spec.prepared()
    backend = renderer.backend
    if shape is not None and backend.has("probe"):
        pipeline = backend.pipeline(features, shape)
    else:
        pipeline = backend.pipeline(features)
    return pipeline.render_intermediates(backend.upload(spec.cloud), view)


def differing(first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray], outputs) -> int:
    """Number of pixels that are not bit-identical in all outputs; all of them if the shapes differ."""
    different = np.zeros((), bool)
    for name in outputs:
        one, other = (np.ascontiguousarray(images[name]) for images in (first, second))
        if one.shape != other.shape:
            return max(one.size, other.size)
        bits = f"u{one.itemsize}"
        unlike = one.view(bits) != other.view(bits)
        different = different | (unlike.any(-1) if unlike.ndim == 3 else unlike)
    return int(different.sum())


def out_of_order(buffers: Mapping[str, np.ndarray], expected: np.ndarray) -> int:
    """Number of splats that violate the expected depth order, in tile lists or overall. buffers: result of
    `render_intermediates`. expected: (visible,) indices in depth order."""
    if "lists" not in buffers:
        return int((buffers["order"] != expected).sum())
    rank = np.full(len(buffers["keys"]), -1)
    rank[expected] = np.arange(len(expected))
    places, starts = rank[buffers["lists"]], buffers["starts"].astype(np.int64)
    follows = np.ones(len(places), bool)  # whether a splat comes after its predecessor in the same list
    follows[starts[:-1][starts[:-1] < len(places)]] = False
    return int((places < 0).sum() + (follows[1:] & (np.diff(places) <= 0)).sum())
