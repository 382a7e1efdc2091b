"""fidsplat as a renderer of `fidsplat bench --suite`, on one device."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

import fidsplat as fs
from fidsplat.effects import select
from fidsplat.splats.rotations import matrices_to_quaternions

PRESETS = ("standard", "fast", "gsplat", "reference")
EXACT = "standard,ellipsoid=exact"
ON_GPUS = ("standard,arithmetic=approximate", "fast,blend_precision=float16")
DEFINITION = ("lowpass", "samples", "order", "ellipsoid")
"""fields of `Quality` that define the image"""


class Adapter:
    """Renderer of disks, 3D Gaussians and exact rectangles at several quality settings."""

    def __init__(self, device: str) -> None:
        self.renderer = fs.Renderer(device)
        info = self.renderer.device
        names = (*PRESETS, EXACT, *(ON_GPUS if info.kind == "gpu" else ()))
        qualities = ((name, fs.Quality.of(name)) for name in names)
        self.resident: Any = None
        self.qualities = {name: quality for name, quality in qualities if self._supported(quality)}
        self.settings = {name: self._claims(name) for name in self.qualities}
        self.facts = {
            "renderer": "fidsplat",
            "version": fs.__version__,
            "device": info.title,
            "kind": info.kind,
            "platform": info.platform,
            "driver": info.version,
        }

    def _supported(self, quality: fs.Quality) -> bool:
        """Whether the device supports the quality, e.g. Warp has no half precision."""
        features = select(fs.SplatCloud.empty(), fs.Capture(quality=quality))
        return not self.renderer.backend.unsupported(features)

    def _claims(self, name: str) -> dict[str, dict]:
        """Settings that define the image, by kind of splats."""
        image_quality = {field: getattr(self.qualities[name], field) for field in DEFINITION}
        kinds = ("ellipsoids",) if name == EXACT else ("disks", "ellipsoids", "boxes")
        return dict.fromkeys(kinds, image_quality)

    def load(self, scene: dict[str, np.ndarray]) -> None:
        size, matrix, near, self.poses = (scene.pop(name) for name in ("size", "matrix", "near", "poses"))
        boxes, groups = scene.pop("boxes", None), scene.pop("coplanar_groups", None)
        cloud = fs.SplatCloud(**scene)
        cloud = cloud if boxes is None else cloud.with_boxes(boxes)
        cloud = cloud if groups is None else cloud.with_coplanar_groups(groups)
        (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
        self.camera = fs.Camera.pinhole(*map(int, size), fx, fy, cx, cy, near=float(near))
        del self.resident  # release the earlier scene before the upload
        if self.renderer.backend.has("rates"):
            self.renderer.backend.release_scratch()
        self.resident = self.renderer.upload(cloud)
        inverse = np.linalg.inv(self.poses)
        self.vectors = np.hstack([inverse[:, :3, 3], matrices_to_quaternions(inverse[:, :3, :3])])
        self.capture = lru_cache(1)(self._capture)  # constructed once per frame of a flight

    def _capture(self, setting: str, view: int) -> fs.Capture:
        return fs.Capture(self.camera.with_pose(self.poses[view]), quality=self.qualities[setting])

    def render(self, setting: str, views: list[int]) -> Any:
        capture = self.capture(setting, views[0])
        if len(views) == 1:
            return self.renderer.render(self.resident, capture).wait()
        return self.renderer.render_batch(self.resident, capture, poses=self.vectors[views]).wait()

    def device_ms(self, rendered: Any) -> float:
        return sum(rendered.timings.values())

    def read(self, rendered: Any) -> np.ndarray:
        rgb = rendered["rgb"]
        return rgb[None] if rgb.ndim == 3 else rgb

    def memory(self) -> int | None:
        backend = self.renderer.backend
        if not backend.has("rates"):
            return None
        return backend.memory_bytes + self.resident.memory_bytes + 12 * self.camera.width * self.camera.height
