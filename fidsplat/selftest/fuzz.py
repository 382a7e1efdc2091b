"""Fuzzing: random hard scenes, each determined by its seed, compared with the reference, in resumable runs.

Scales are log-uniform from 1e-6 to 1e3 m, anisotropy to 1e6, depths from -5 to 1e5 m, opacities at the
thresholds. A tenth of the splats is edge-on within 1e-6 rad, a tenth crosses the near plane, a tenth is
coplanar; half of the coplanar groups are tilted.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.quality import Quality
from fidsplat.render.renderer import Renderer
from fidsplat.scenes.random_clouds import log_uniform
from fidsplat.selftest.agreement import ALL_OUTPUTS, RARE, RISKY, FrameSpec, compare, reference_images, render
from fidsplat.selftest.clouds import quaternion
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import quaternion_multiply, quaternion_to_matrix
from fidsplat.util.files import from_json, read_text, write_file
from fidsplat.util.provenance import code_hash

LARGEST_SCENE = 200
CUT = 1.0 / 255.0
OPACITIES = np.array([0.0, CUT * (1 - 1e-6), CUT * (1 + 1e-6), 0.5, 0.99, 1.0], np.float32)
QUALITIES = (
    Quality(),
    Quality.named("reference"),
    Quality(lowpass="none"),
    Quality(samples=2),
    Quality.named("gsplat"),
)
PROBABILITIES = (0.5, 0.15, 0.15, 0.1, 0.1)
"""probability of each quality"""
_SAVE_EVERY = 5.0  # seconds


def scene_of(seed: int) -> FrameSpec:
    """The frame of a seed: 1 to 200 splats, at most 80 x 64 pixels, a random camera."""
    generator = np.random.default_rng(seed)
    count = int(generator.integers(1, LARGEST_SCENE + 1))
    width, height = (int(generator.integers(1, limit + 1)) for limit in (80, 64))
    focal = max(width, height) * float(log_uniform(generator, 0.4, 4.0))
    near = float(generator.choice([0.01, 0.01, 0.2, 1.0]))

    kind = generator.choice(4, count, p=[0.7, 0.1, 0.1, 0.1])  # plain, edge-on, across near, coplanar
    depth = np.where(
        generator.random(count) < 0.4,
        generator.uniform(-5, 5, count),
        log_uniform(generator, near, 1e5, count),
    )
    span = np.array([width, height]) / 2 / focal
    sideways = generator.uniform(-1.3, 1.3, (count, 2)) * span * np.maximum(np.abs(depth), 0.1)[:, None]
    means = np.column_stack([sideways, depth])
    quats = generator.normal(size=(count, 4))
    large = log_uniform(generator, 1e-6, 1e3, count)
    scales = np.column_stack([large, large / log_uniform(generator, 1, 1e6, count)])
    swap = generator.random(count) < 0.5
    scales[swap] = scales[swap, ::-1]

    for k in np.flatnonzero(kind == 1):
        quats[k] = _edge_on(generator, means[k])
    for k in np.flatnonzero(kind == 2):
        # the disk extends three standard deviations along z, and its centre is nearer than that to the near
        # plane
        axes = quaternion_to_matrix(quats[k])[2, :2] * scales[k]
        means[k, 2] = near + generator.uniform(-3, 3) * np.linalg.norm(axes)
    planes = _coplanar(generator, np.flatnonzero(kind == 3), means, quats)
    _tilt(np.random.default_rng([seed, 1]), planes, means, quats)

    pose = np.eye(4)
    if generator.random() < 0.5:
        if (planes >= 0).any():
            _separate(np.random.default_rng([seed, 3]), np.flatnonzero((kind == 3) & (planes < 0)), means)
        rotation = generator.normal(size=4)
        rotation /= np.linalg.norm(rotation)
        pose[:3, :3] = quaternion_to_matrix(rotation)
        means = means @ pose[:3, :3]
        quats = quaternion_multiply(rotation * [1, -1, -1, -1], quats)
    cloud = SplatCloud(
        means.astype(np.float32),
        quats,
        scales,
        generator.choice(OPACITIES, count),
        colors=generator.uniform(0, 1, (count, 3)),
        labels=generator.integers(0, 9, count),
    ).with_coplanar_groups(planes)
    cx, cy = generator.uniform(-0.2, 1.2, 2) * [width, height]
    camera = Camera.pinhole(width, height, focal, focal, cx, cy, pose, near=near)
    quality = QUALITIES[int(generator.choice(len(QUALITIES), p=PROBABILITIES))]
    return FrameSpec(cloud, camera, quality, ALL_OUTPUTS)


def _edge_on(generator: np.random.Generator, mean: np.ndarray) -> np.ndarray:
    """Quaternion (4,) of a splat at `mean` that is edge-on within 1e-6 rad."""
    ray = mean / np.linalg.norm(mean)
    across = np.cross(ray, generator.normal(size=3))
    across /= np.linalg.norm(across)
    normal = across + generator.uniform(-1e-6, 1e-6) * ray
    along = np.cross(normal, generator.normal(size=3))
    return quaternion(along, np.cross(normal, along))


def _coplanar(generator, chosen: np.ndarray, means: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """Move the chosen splats to a few planes z = const, with rotations in the plane; returns group ids
    (n,)."""
    planes = np.full(len(means), -1)
    groups = generator.integers(0, 3, len(chosen))
    for group in range(3):
        members = chosen[groups == group]
        depth = float(np.float32(log_uniform(generator, 0.3, 30.0)))
        # only half of the groups have a group id
        known = generator.random() < 0.5
        for k in members:
            means[k, :2] *= depth / max(abs(means[k, 2]), 0.1)
            means[k, 2] = depth
            angle = generator.uniform(0, math.pi)
            quats[k] = [math.cos(angle / 2), 0, 0, math.sin(angle / 2)]
            planes[k] = group if known else -1
    return planes


def _tilt(generator: np.random.Generator, planes: np.ndarray, means: np.ndarray, quats: np.ndarray) -> None:
    """Rotate half of the groups about their centres, so that they intersect each other and other splats."""
    for plane in np.unique(planes[planes >= 0]):
        axis = generator.normal(size=3) * [1, 1, 0.3]
        angle = generator.uniform(0, math.pi / 2)
        if generator.random() < 0.5:
            continue
        rows = np.flatnonzero(planes == plane)
        rotation = np.array([math.cos(angle / 2), *(math.sin(angle / 2) * axis / np.linalg.norm(axis))])
        middle = means[rows].mean(axis=0)
        means[rows] = middle + (means[rows] - middle) @ quaternion_to_matrix(rotation).T
        quats[rows] = quaternion_multiply(rotation, quats[rows])


def _separate(generator: np.random.Generator, chosen: np.ndarray, means: np.ndarray) -> None:
    """Move the chosen coplanar splats up to 1/1000 away from the camera. In a tilted plane without a group id
    rounding would decide their order at every pixel (docs/correctness.md)."""
    means[chosen] *= 1 + generator.uniform(0, 1e-3, (len(chosen), 1))


@dataclass
class FuzzState:
    """Results of all scenes from seed 0 to `scenes` - 1."""

    key: str
    """device, driver and sources of the results"""
    scenes: int = 0
    splats: int = 0
    pixels: int = 0
    risky: int = 0
    """pixels whose error bound exceeds 0.05"""
    beyond_bound: dict[str, tuple[float, int]] = field(default_factory=dict)
    """output -> largest error beyond the error bound, and its seed"""
    largest: dict[str, tuple[float, int]] = field(default_factory=dict)
    """output -> largest error, including pixels with an error bound, and its seed"""
    failing: list[int] = field(default_factory=list)
    """seeds with an error beyond tolerance and error bound, or a non-finite value"""
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether no seed fails and few pixels have large error bounds."""
        return not self.failing and self.risky <= RARE * self.pixels

    def add(self, seed: int, renderer: Renderer) -> None:
        """Render the scene of the next seed and compare it."""
        spec = scene_of(seed)
        expected = reference_images(spec)
        failed = False
        for difference in compare(render(renderer, spec), expected, ALL_OUTPUTS):
            name = difference.output
            failed |= not (difference.finite and difference.excess <= 0)
            errors = (self.beyond_bound, difference.beyond_bound), (self.largest, difference.error)
            for record, value in errors:
                value = float("inf") if np.isnan(value) else value
                if name not in record or value > record[name][0]:
                    record[name] = value, seed
        if failed:
            self.failing.append(seed)
        self.scenes, self.splats = seed + 1, self.splats + len(spec.cloud)
        self.pixels += expected["error_bound"].size
        self.risky += int((expected["error_bound"] > RISKY).sum())


def fuzz_run(renderer: Renderer, splats: int, file: Path | None = None) -> Iterator[FuzzState]:
    """Render scenes until they contain `splats` splats; yields the state after each.

    A stopped run with the same device and kernels resumes from `file`; a completed one starts again. Raises
    InputError when the file cannot be written.
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
            write_file(file, json.dumps(asdict(state), indent=1))  # errors may be infinite
            saved = now
        yield state


def _key(renderer: Renderer) -> str:
    device = renderer.device
    return " | ".join((device.title, device.platform, device.version, code_hash()))


def _load(file: Path | None, key: str) -> FuzzState:
    try:
        values = from_json(read_text(file)) if file is not None else {}
        if values.get("key") != key:
            return FuzzState(key)
        for name in ("beyond_bound", "largest"):
            values[name] = {output: (float(pair[0]), int(pair[1])) for output, pair in values[name].items()}
        return FuzzState(**values)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):  # missing, or another file
        return FuzzState(key)
