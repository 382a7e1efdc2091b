"""Digests of random scenes, equal on all devices with float64 and fused multiply-adds.

The seed determines a scene. It is computed by sums, products, quotients and roots alone, which IEEE
arithmetic rounds equally on every processor.
"""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.backends.interface import Backend
from fidsplat.cameras import BrownConrady, Camera, Fisheye, Orthographic
from fidsplat.capture.quality import Quality
from fidsplat.capture.sensor import Sensor
from fidsplat.render.renderer import Renderer
from fidsplat.selftest.agreement import CULLED, FrameSpec, render, render_intermediates
from fidsplat.splats.cloud import SplatCloud

COUNT = 200
"""number of scenes in the table"""
TABLE = Path(__file__).with_name("digests.csv")
OUTPUTS = ("rgb", "alpha", "depth", "normal", "label")
_FORMS = (
    *("nu0", "nux", "nuy", "nv0", "nvx", "nvy", "d0", "dx", "dy", "d_near", "log_opacity", "ax", "ay"),
    *(
        "r",
        "g",
        "b",
        "lowpass_x",
        "lowpass_y",
        "z_numerator",
        "z_center",
        "z_reach",
        "nearest",
        "ellipsoid_term",
    ),
    *("nx", "ny", "nz", "nuz", "nvz", "dz", "ray_x", "ray_y", "ray_z"),
    *("edge_u0", "edge_u1", "edge_v0", "edge_v1"),
)
"""fields of a splat's record"""


@dataclass(frozen=True)
class Kind:
    """A kind of scene: scenes of one kind are rendered by the same kernels."""

    name: str
    quality: str = "standard"
    lens: str = "pinhole"
    splats: str = "disks"
    """disks, boxes, disks and boxes, 3D Gaussians, or 3D Gaussians and disks"""
    sh_degree: int = -1
    """-1: plain colours"""
    groups: bool = False
    """whether a third of the splats is in coplanar groups"""
    sensor: Sensor | None = None


KINDS = (
    Kind("disks"),
    Kind("SH of degree 1", sh_degree=1),
    Kind("coplanar groups", groups=True),
    Kind("order by pixel", "order=pixel"),
    Kind("boxes", "order=pixel", splats="boxes", groups=True),
    Kind("disks and boxes", splats="disks and boxes"),
    Kind("3D Gaussians, EWA", splats="3D Gaussians", sh_degree=3),
    Kind("3D Gaussians, antialiased", "ellipsoid=ewa_antialiased", splats="3D Gaussians"),
    Kind("3D Gaussians, exact", "ellipsoid=exact", splats="3D Gaussians", sh_degree=2),
    Kind("3D Gaussians and groups", splats="3D Gaussians and disks", groups=True),
    Kind("fisheye", lens="fisheye"),
    Kind("fisheye, boxes", lens="fisheye", splats="disks and boxes", groups=True),
    Kind("fisheye, 3D Gaussians", lens="fisheye", splats="3D Gaussians", sh_degree=0),
    Kind("distortion", lens="distortion"),
    Kind("equirectangular", lens="equirectangular"),
    Kind("orthographic", lens="orthographic"),
    Kind("low-pass pixel", "lowpass=pixel"),
    Kind("2 x 2 samples, sensor", "lowpass=none,samples=2", sensor=Sensor(response="srgb", bits=8)),
    Kind("preset fast", "fast"),
    Kind("preset gsplat", "gsplat,arithmetic=fast"),
)


class _Source:
    """Random numbers of a scene."""

    def __init__(self, seed: int) -> None:
        self._bits = np.random.PCG64(seed)

    def uniform(self, low: float, high: float, *shape: int) -> np.ndarray:
        bits = self._bits.random_raw(int(np.prod(shape, dtype=int))) >> np.uint64(11)
        return low + (high - low) * (bits.reshape(shape).astype(np.float64) / 2.0**53)

    def number(self, low: float, high: float) -> float:
        return float(self.uniform(low, high))

    def integers(self, low: int, high: int, *shape: int) -> np.ndarray:
        """Random integers in [low, high)."""
        return np.minimum(np.floor(self.uniform(low, high, *shape)), high - 1).astype(np.int64)


def kind_of(seed: int) -> Kind:
    """Kind of the scene of a seed."""
    return KINDS[seed % len(KINDS)]


def scene_of(seed: int) -> FrameSpec:
    """The frame of a seed: 20 to 400 splats, 30 x 20 to 110 x 80 pixels, a random pose."""
    kind, source = kind_of(seed), _Source(seed)
    count = int(source.integers(20, 400))
    camera = _camera(kind.lens, source)
    around = kind.lens in ("fisheye", "equirectangular")
    means = source.uniform(-1.0, 1.0, count, 3) * [2.2, 1.6, 2.5]
    if not around:
        means[:, 2] += 2.6
    position = camera.position if camera.position is not None else np.zeros(3)
    rotation = camera.world_to_camera[:3, :3]
    means = position + (means[:, :1] * rotation[0] + means[:, 1:2] * rotation[1] + means[:, 2:] * rotation[2])
    quats = source.uniform(-1.0, 1.0, count, 4)
    large = source.uniform(0.1, 1.0, count) ** 2 * source.number(0.1, 0.6)
    columns = 3 if kind.splats.startswith("3D") else 2
    scales = large[:, None] * source.uniform(0.05, 1.0, count, columns)
    opacities = source.uniform(0.0, 1.15, count).clip(0.004, 1.0)
    colors = {"colors": source.uniform(0.0, 1.0, count, 3)}
    if kind.sh_degree >= 0:
        colors = {"sh": source.uniform(-0.7, 0.7, count, (kind.sh_degree + 1) ** 2, 3)}
    if kind.splats == "3D Gaussians and disks":
        scales[::3, 2] = 0.0
    if kind.groups:
        # splats of a group share a plane and its axes
        for group in range(3):
            members = slice(3 * group, count // 3, 9)
            quats[members] = quats[3 * group]
            axes = _axes(quats[3 * group])
            at = source.uniform(-1.0, 1.0, len(means[members]), 2)
            means[members] = means[3 * group] + at[:, :1] * axes[0] + at[:, 1:] * axes[1]
    cloud = SplatCloud(
        means, quats, scales, opacities, labels=source.integers(0, 9, count), origin=np.zeros(3), **colors
    )
    if kind.splats in ("boxes", "disks and boxes"):
        cloud = cloud.with_boxes(np.arange(count) % 9 < 5 if kind.splats == "disks and boxes" else True)
    if kind.groups:
        ids = np.full(count, -1)
        for group in range(3):
            ids[3 * group : count // 3 : 9] = group
        if cloud.thickness is not None:
            ids[cloud.thickness > 0] = -1
        cloud = cloud.with_coplanar_groups(ids)
    background = tuple(source.uniform(0.0, 1.0, 3).tolist())
    return FrameSpec(cloud, camera, Quality.of(kind.quality), OUTPUTS, background, kind.sensor)


def _axes(quaternion: np.ndarray) -> np.ndarray:
    """(3, 3) float64: rows are the axes of a quaternion of any length."""
    w, x, y, z = quaternion.astype(np.float32).astype(np.float64)
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y)],
            [s * (x * y - w * z), 1 - s * (x * x + z * z), s * (y * z + w * x)],
            [s * (x * z + w * y), s * (y * z - w * x), 1 - s * (x * x + y * y)],
        ]
    )


def _camera(lens: str, source: _Source) -> Camera:
    width, height = int(source.integers(30, 110)), int(source.integers(20, 80))
    pose, position = np.eye(4), source.uniform(-1.0, 1.0, 3)
    pose[:3, :3] = rotation = _axes(source.uniform(-1.0, 1.0, 4))
    pose[:3, 3] = -(rotation * position).sum(axis=1)
    focal = source.uniform(0.6, 1.2, 2) * width
    center = source.uniform(0.4, 0.6, 2) * [width, height]
    placed = {"world_to_camera": pose, "position": position, "near": 0.05}
    if lens == "equirectangular":
        return replace(Camera.equirectangular(width, width // 2), **placed)
    lenses = {
        "pinhole": None,
        "fisheye": Fisheye(0.05, -0.01),
        "distortion": BrownConrady(-0.2, 0.05, p1=0.01, p2=-0.005),
        "orthographic": Orthographic(),
    }
    if lens == "fisheye":
        focal *= 0.4
    if lens == "orthographic":
        focal *= 0.3
    return Camera(width, height, *focal.tolist(), *center.tolist(), **placed, lens=lenses[lens])


@dataclass(frozen=True)
class Digest:
    """Digests of a frame."""

    sha256: str
    """digest of all outputs together"""
    outputs: dict[str, str]
    """first 8 hexadecimal digits of the SHA-256 of each output"""

    @classmethod
    def of(cls, images: Mapping[str, np.ndarray]) -> Digest:
        """Digests of the images of `OUTPUTS`."""
        outputs = {name: _sha256(images[name])[:8] for name in OUTPUTS}
        return cls(_sha256(*(images[name] for name in OUTPUTS)), outputs)

    def differing(self, other: Digest) -> list[str]:
        """Names of the outputs whose digests differ."""
        return [name for name in OUTPUTS if self.outputs[name] != other.outputs[name]]


def digest_of(renderer: Renderer, seed: int) -> Digest:
    """Render the scene of a seed."""
    return Digest.of(render(renderer, scene_of(seed)))


def stage_digests(renderer: Renderer, seed: int) -> dict[str, str]:
    """Digests of intermediate results: records of visible splats, sort keys, samples."""
    spec = scene_of(seed)
    data = render_intermediates(renderer, spec)
    return {name: _sha256(array)[:8] for name, array in stages_of(data, spec, renderer.backend).items()}


def stages_of(data: Mapping[str, np.ndarray], spec: FrameSpec, backend: Backend) -> dict[str, np.ndarray]:
    """Buffers between the stages of a frame, converted to a device-independent layout."""
    keys, visible = data["keys"], data["keys"] != CULLED
    features, _ = spec.prepared()
    records = data["records"]
    pipeline: Any = backend.pipeline(features)
    names = records.dtype.names or pipeline.program.layout.names  # Warp's records are rows of numbers
    fields = {name: records[name] if records.dtype.names else records[:, k] for k, name in enumerate(names)}
    height, width = spec.camera.height * spec.quality.samples, spec.camera.width * spec.quality.samples
    forms = {name: fields[name][visible].astype(np.float32) for name in _FORMS if name in fields}
    samples = {"samples": data["raw"][:, :height, :width]} if "raw" in data else {}
    return {**forms, "keys": keys, **samples}


def _sha256(*arrays: np.ndarray) -> str:
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


def read_table() -> dict[int, Digest]:
    """Read the SHA-256 digests of the random scenes in the repository, by seed."""
    with TABLE.open() as stream:
        return {
            int(row["seed"]): Digest(row["sha256"], {name: row[name] for name in OUTPUTS})
            for row in csv.DictReader(stream)
        }
