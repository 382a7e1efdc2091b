"""The reference backend: device, cloud and pipeline."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fidsplat.backends.interface import Backend, DeviceCloud, DeviceInfo, HostImages, Pipeline
from fidsplat.backends.reference.blend import composite
from fidsplat.backends.reference.culling import may_contribute
from fidsplat.backends.reference.gradients import ReferenceGradients
from fidsplat.backends.reference.projection import ProjectedSplats
from fidsplat.backends.reference.resolve import resolve
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet
from fidsplat.effects.differentiable import check_differentiable
from fidsplat.effects.extensions import EXTENSIONS
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import color_range
from fidsplat.util import interrupts
from fidsplat.util.errors import DeviceError, UnknownDeviceError

_BLOCK = (
    1 << 16
)  # (sample, splat) pairs that are evaluated at once: arrays of half a megabyte, which fit the cache
_TILE = 16  # samples along a side of a tile, for which splats are culled together
_WIDEST = 128  # maximum side of a tile, for samples that are far apart
_FEW = 16  # tiles with fewer samples are enlarged: another culling would take longer than the extra splats


def devices() -> list[DeviceInfo]:
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0
    return [
        DeviceInfo(
            name="reference",
            title="NumPy, float64, without bounds of footprints",
            platform="reference",
            version=f"NumPy {np.__version__}",
            kind="cpu",
            compute_units=1,
            memory_bytes=memory,
            largest_allocation_bytes=memory,
            float64=True,
            usable=True,
            reason=f"slow; for comparison only ({platform.machine()})",
            always_float64=True,
        )
    ]


def open_device(selector: str = "") -> ReferenceBackend:
    """Open the reference device; any selector is an error."""
    if selector:
        raise UnknownDeviceError(
            f"the reference must have no selector, got {selector!r}; use device='reference'"
        )
    return ReferenceBackend()


class ReferenceBackend(Backend):
    renders_subsampled = True

    def __init__(self) -> None:
        self.info = devices()[0]

    def upload(self, cloud: SplatCloud) -> ReferenceCloud:
        return ReferenceCloud(cloud)

    def unsupported(self, features: FeatureSet) -> str:
        lacking = ", ".join(sorted(EXTENSIONS.keys() & features.names))
        return f"reference has no {lacking}; use an OpenCL device for it" if lacking else ""

    def pipeline(self, features: FeatureSet, config: None = None) -> ReferencePipeline:
        if why := self.unsupported(features):
            raise DeviceError(why)
        return ReferencePipeline(features)

    def gradient_pipeline(self, features: FeatureSet, config: None = None) -> ReferenceGradients:
        check_differentiable(features)
        return ReferenceGradients(self.pipeline(features), features)


class ReferenceCloud(DeviceCloud):
    def __init__(self, cloud: SplatCloud) -> None:
        self.host_cloud, self.count = cloud, len(cloud)
        self.memory_bytes = 0  # nothing is copied to a device
        self.copy_properties(cloud)

    def color_range(self) -> tuple[float, float]:
        return color_range(self.host_cloud.plain_colors, self.host_cloud.sh)


class ReferencePipeline(Pipeline):
    """Renders complete frames (`render`) or single pixels (`pixels`)."""

    def __init__(self, features: FeatureSet) -> None:
        self.features, self._progress = features, _Progress()

    def render_view(self, cloud: ReferenceCloud, view: View) -> HostImages:
        return self.render_subsampled(cloud, view, 1)

    def render_subsampled(
        self,
        cloud: ReferenceCloud,
        view: View,
        step: int,
        progress: Callable[[float], object] | None = None,
    ) -> HostImages:
        rows, columns = np.mgrid[
            0 : view.height // view.samples : step, 0 : view.width // view.samples : step
        ]
        start = time.perf_counter()
        self._progress = _Progress(progress, rows.size * view.samples**2)
        # tiles as in the complete frame, so that sums have the same order
        flat = self.pixels(cloud, view, rows.ravel(), columns.ravel(), widest=_TILE)
        images = {name: image.reshape(1, *rows.shape, *image.shape[1:]) for name, image in flat.items()}
        took = (time.perf_counter() - start) * 1e3
        count = len(cloud.host_cloud)
        return HostImages(images, {"reference": took}, {"splats": count, "visible": count, "pairs": 0})

    def render_intermediates(self, cloud: ReferenceCloud, view: View) -> dict[str, np.ndarray]:
        """Render one view; returns the depth order, the float32 keys, and the images with the error bound."""
        splats = ProjectedSplats(cloud.host_cloud, view, self.features)
        images = self.render_view(cloud, view).arrays_of(0)
        return {"order": splats.order, "keys": splats.key, **images}

    def pixels(
        self,
        cloud: ReferenceCloud,
        view: View,
        rows: np.ndarray,
        columns: np.ndarray,
        widest: int = _WIDEST,
    ) -> dict[str, np.ndarray]:
        """Render single pixels (row, column): outputs (k,) or (k, 3) float64, and `error_bound` (k,). widest:
        maximum side in samples of the tiles for which splats are culled together."""
        n = view.samples
        sub_rows, sub_columns = np.mgrid[0:n, 0:n]
        y = (np.asarray(rows)[:, None] * n + sub_rows.ravel() + 0.5).ravel()
        x = (np.asarray(columns)[:, None] * n + sub_columns.ravel() + 0.5).ravel()
        sampled = self._exposed if view.sub_frames else self._samples
        flat = sampled(cloud, view, x, y, widest)
        samples = {name: values.reshape(-1, n * n, *values.shape[1:]) for name, values in flat.items()}
        samples |= {"x": x.reshape(-1, n * n), "y": y.reshape(-1, n * n)}
        return resolve(samples, view, self.features)

    def _samples(
        self, cloud: ReferenceCloud, view: View, x: np.ndarray, y: np.ndarray, widest: int
    ) -> dict[str, np.ndarray]:
        """Sample buffers (k, ...) at grid positions x, y (k,)."""
        splats = ProjectedSplats(cloud.host_cloud, view, self.features)
        if len(x) * len(splats.order) <= _BLOCK:
            return composite(splats, view, self.features, x, y)
        order, starts = _by_tile(view, x, y, widest)
        parts = []
        for members in np.split(order, starts):
            candidates = splats.subset(may_contribute(splats, view, x[members], y[members]))
            step = max(1, _BLOCK // max(1, len(candidates.order)))
            for k in range(0, len(members), step):
                block = members[k : k + step]
                parts.append(composite(candidates, view, self.features, x[block], y[block]))
                self._progress.add(len(block))
        inverse = np.argsort(order)
        return {name: np.concatenate([part[name] for part in parts])[inverse] for name in parts[0]}

    def _exposed(
        self, cloud: ReferenceCloud, view: View, x: np.ndarray, y: np.ndarray, widest: int
    ) -> dict[str, np.ndarray]:
        """Combine the samples of several sub-frames: colour, fog and transmittance are averaged; other
        outputs and `error_bound_middle` are from the middle sub-frame."""
        out: dict[str, np.ndarray] = {}
        rows_of = [
            (y > sub_frame.top) & (y < sub_frame.top + sub_frame.view.height) for sub_frame in view.sub_frames
        ]
        self._progress.total = sum(int(members.sum()) for members in rows_of)
        for sub_frame, members in zip(view.sub_frames, rows_of, strict=True):
            samples = self._samples(cloud, sub_frame.view, x[members], y[members] - sub_frame.top, widest)
            samples["error_bound_middle"] = samples["error_bound"]
            for name, values in samples.items():
                plane = out.setdefault(name, np.zeros((len(x), *values.shape[1:]), values.dtype))
                if name in ("rgb", "t", "fogged", "error_bound", "behind_bound"):
                    plane[members] += sub_frame.weight * values
                elif sub_frame.middle:
                    plane[members] = values
        return out


def _by_tile(view: View, x: np.ndarray, y: np.ndarray, widest: int) -> tuple[np.ndarray, np.ndarray]:
    """Sort samples by tile; returns their indices (k,), and the start of each tile except the first. Tiles
    are up to `widest` samples wide where samples are far apart."""
    side = _TILE
    while True:
        tile = y // side * view.width + x // side
        order = np.argsort(tile, kind="stable")
        starts = np.flatnonzero(np.diff(tile[order])) + 1
        if side >= widest or len(x) >= _FEW * len(starts):
            return order, starts
        side *= 2


@dataclass
class _Progress:
    """Counter of a frame's rendered samples that calls the progress callback."""

    callback: Callable[[float], object] | None = None
    total: int = 1
    done: int = 0

    def add(self, count: int) -> None:
        interrupts.check()
        self.done += count
        if self.callback is not None:
            self.callback(self.done / self.total)
