"""The judge of the other backends: NumPy in float64, every sample of the picture against every splat, no
tiles, no boxes.

It starts from the same float32 inputs and takes the same decisions (numerics.md, section 3). Beside the
planes it gives a certificate: how much a pixel may differ because a decision lies within rounding of its
threshold.
"""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fidsplat.backends.base import DeviceInfo, View
from fidsplat.effects import FeatureSet
from fidsplat.errors import UnknownDeviceError
from fidsplat.splats import SplatCloud, sh_basis

_BLOCK = 1 << 20  # (sample, splat) pairs that are evaluated at once
_RISK = 5e-5  # relative band around a threshold in which single precision may decide otherwise


def devices() -> list[DeviceInfo]:
    """The one reference device: this machine's NumPy."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0
    return [
        DeviceInfo(
            name="reference",
            title="NumPy, float64, every pixel against every splat",
            platform="reference",
            version=f"NumPy {np.__version__}",
            kind="cpu",
            compute_units=1,
            memory_bytes=memory,
            largest_allocation_bytes=memory,
            float64=True,
            usable=True,
            reason=f"slow; for comparison only ({platform.machine()})",
        )
    ]


def open_device(selector: str = "") -> ReferenceBackend:
    """The reference; it has no variants.

    Raises:
        UnknownDeviceError: a selector was given.
    """
    if selector:
        raise UnknownDeviceError(f"the reference has no device {selector!r}; its name is just 'reference'")
    return ReferenceBackend()


class ReferenceBackend:
    """NumPy in float64."""

    def __init__(self) -> None:
        self.info = devices()[0]

    def upload(self, cloud: SplatCloud) -> ReferenceCloud:
        """The cloud itself."""
        return ReferenceCloud(cloud)

    def pipeline(self, features: FeatureSet) -> ReferencePipeline:
        """Nothing to compile."""
        return ReferencePipeline(features)


class ReferenceCloud:
    """A cloud with what the renderer asks of a resident one."""

    def __init__(self, cloud: SplatCloud) -> None:
        self.cloud = cloud
        self.origin = cloud.origin
        self.sh_degree = cloud.sh_degree
        self.has_planes = cloud.planes is not None


@dataclass
class ReferencePlanes:
    """Finished planes in memory."""

    planes: dict[str, np.ndarray]
    timings: Mapping[str, float]
    stats: Mapping[str, int]

    def read(self, name: str) -> np.ndarray:
        return self.planes[name]


class ReferencePipeline:
    """Draws whole pictures (`render`) or chosen pixels (`pixels`)."""

    def __init__(self, features: FeatureSet) -> None:
        self.features = features

    def render(self, resident: ReferenceCloud, view: View) -> ReferencePlanes:
        """Draw every pixel; planes in float64."""
        height, width = view.height // view.samples, view.width // view.samples
        rows, columns = np.mgrid[0:height, 0:width]
        start = time.perf_counter()
        flat = self.pixels(resident, view, rows.ravel(), columns.ravel())
        planes = {name: plane.reshape(height, width, *plane.shape[1:]) for name, plane in flat.items()}
        took = (time.perf_counter() - start) * 1e3
        count = len(resident.cloud)
        return ReferencePlanes(planes, {"reference": took}, {"splats": count, "visible": count, "pairs": 0})

    def trace(self, resident: ReferenceCloud, view: View) -> dict[str, np.ndarray]:
        """The depth order, the float32 keys, and the finished planes with the certificate."""
        splats = _Splats(resident.cloud, view, self.features)
        return {"order": splats.order, "keys": splats.key, **self.render(resident, view).planes}

    def pixels(
        self, resident: ReferenceCloud, view: View, rows: np.ndarray, columns: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Planes at pixels (row, column), each (k,) or (k, 3) float64; `certificate` (k,) beside those asked
        for.
        """
        splats = _Splats(resident.cloud, view, self.features)
        n = view.samples
        sub_rows, sub_columns = np.mgrid[0:n, 0:n]
        y = (np.asarray(rows)[:, None] * n + sub_rows.ravel() + 0.5).ravel()
        x = (np.asarray(columns)[:, None] * n + sub_columns.ravel() + 0.5).ravel()
        step = max(1, _BLOCK // max(1, len(splats.order)))
        blocks = [
            _composite(splats, view, self.features, x[k : k + step], y[k : k + step])
            for k in range(0, len(x), step)
        ]
        samples = {
            name: np.concatenate([block[name] for block in blocks]).reshape(
                -1, n * n, *blocks[0][name].shape[1:]
            )
            for name in blocks[0]
        }
        return _resolve(samples, view, self.features)


class _Splats:
    """Per-splat set-up, arrays in depth order."""

    def __init__(self, cloud: SplatCloud, view: View, features: FeatureSet) -> None:
        q = cloud.quats.astype(np.float64)
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        w, x, y, z = q.T
        tangent_u = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1)
        tangent_v = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1)
        mean, scale = cloud.means.astype(np.float64), cloud.scales.astype(np.float64)
        scale = np.maximum(scale, np.float32(1e-20))  # as the kernels' SMALLEST_SCALE
        rotation = view.rotation
        unit_a, unit_b = tangent_u @ rotation.T, tangent_v @ rotation.T
        a, b = unit_a * scale[:, :1], unit_b * scale[:, 1:]
        p = mean @ rotation.T + view.translation
        self.key = p[:, 2].astype(np.float32)
        with np.errstate(divide="ignore"):
            log_opacity = np.log(cloud.opacities.astype(np.float64))
        half_r2 = log_opacity - view.log_cut
        reach = np.sqrt(np.maximum(2 * half_r2, 0)) * np.hypot(a[:, 2], b[:, 2])
        drawn = (half_r2 > 0) & (p[:, 2] + reach >= view.near) & (p[:, 2] - reach <= view.far)
        order = np.flatnonzero(drawn)
        order = order[np.argsort(self.key[order], kind="stable")]
        self.order = order

        normal = np.cross(unit_a, unit_b)[order]
        a, b, p, mean = a[order], b[order], p[order], mean[order]
        self.log_opacity, self.half_r2, self.reach = log_opacity[order], half_r2[order], reach[order]
        self.labels = cloud.labels[order]
        self.pz = p[:, 2]
        rows = np.stack([a, b, p], axis=2)  # (n, xyz, uv1)
        tw = rows[:, 2]
        tu = view.fx * rows[:, 0] + view.cx * tw
        tv = view.fy * rows[:, 1] + view.cy * tw
        self.k0, self.kx, self.ky = np.cross(tu, tv), np.cross(tv, tw), np.cross(tw, tu)
        determinant = np.einsum("ij,ij->i", tw, self.k0)
        offset = np.einsum("ij,ij->i", normal, p)
        edge_on = np.abs(offset) <= 1e-13 * np.linalg.norm(p, axis=1)
        self.sign = np.where(edge_on, 0.0, np.sign(determinant))
        self.z_numerator = np.abs(determinant) * np.abs(self.sign)
        self.dot = self.pz >= view.near  # the low-pass dot belongs to the centre
        with np.errstate(divide="ignore", invalid="ignore"):
            self.center_x = np.where(self.dot, tu[:, 2] / self.pz, np.inf)
            self.center_y = np.where(self.dot, tv[:, 2] / self.pz, np.inf)
        self.colors = _colors(cloud, order, mean - view.eye)
        self.normal = normal * np.where(offset > 0, -1.0, 1.0)[:, None]
        self.screen = "lowpass_screen" in features.slots
        self.planes = None
        if "compose_planes" in features.slots and cloud.planes is not None:
            self.planes = cloud.planes[order]


def _colors(cloud: SplatCloud, order: np.ndarray, rays: np.ndarray) -> np.ndarray:
    if cloud.sh is None:
        return cloud.colors[order].astype(np.float64)  # type: ignore[index]
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    directions = rays / np.where(length > 0, length, 1)
    basis = sh_basis(cloud.sh_degree, directions)
    return np.maximum(0.5 + np.einsum("nk,nkc->nc", basis, cloud.sh[order].astype(np.float64)), 0)


def _composite(
    s: _Splats, view: View, features: FeatureSet, x: np.ndarray, y: np.ndarray
) -> dict[str, np.ndarray]:
    """Samples (k,) at grid positions x, y against all splats: what blending leaves, before resolving."""
    x, y = x[:, None], y[:, None]
    n_u, n_v, d = (s.k0[:, c] + x * s.kx[:, c] + y * s.ky[:, c] for c in range(3))
    q = n_u * n_u + n_v * n_v
    d = d * s.sign
    band = 2 * s.half_r2 * d * d
    beyond_near = d * view.near <= s.z_numerator
    inside = (q <= band) & (d > 0) & beyond_near
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        half_rho = np.where(inside, q / (2 * d * d), np.inf)
        z = s.z_numerator / d
    at_rim = (d > 0) & beyond_near & (np.abs(q - band) <= _RISK * band)
    at_near = (d > 0) & (q <= band) & (np.abs(d * view.near - s.z_numerator) <= _RISK * s.z_numerator)
    if s.screen:
        offset = ((x - s.center_x) ** 2 + (y - s.center_y) ** 2) / view.samples**2
        half_rho = np.minimum(half_rho, np.where(offset <= s.half_r2, offset, np.inf))
        at_rim |= s.dot & (np.abs(offset - s.half_r2) <= _RISK * s.half_r2)
    z = np.where(d > 0, np.clip(z, s.pz - s.reach, s.pz + s.reach), s.pz)

    alpha = np.minimum(np.exp(s.log_opacity - half_rho), view.ceiling)
    run = None if s.planes is None else _runs(alpha > 0, s.planes)
    before, live, final = _transmittance(alpha, view.stop, "stop_exclusive" in features.slots, run)
    weight = np.where(live, before * alpha, 0.0)
    if s.planes is None or run is None:
        rgb, worth = weight @ s.colors, before
    else:
        rgb, worth = _layered(alpha, before, weight, live, run, s, s.planes)
    # What a risky fragment weighs, drawn or not: the cut-off at its rim; its opacity at the near plane.
    stake = at_rim * math.exp(view.log_cut) + at_near * np.exp(s.log_opacity)
    certificate = (worth * stake).sum(1)
    near_stop = np.abs(before * (1 - alpha) - view.stop) <= _RISK * view.stop
    certificate += np.where((near_stop & (alpha > 0) & live).any(1), view.stop, 0.0)

    out = {"rgb": rgb, "t": final, "certificate": certificate}
    if {"depth", "depth_median"} & set(features.taps):
        out["depth"] = (weight * z).sum(1)
        out["weight"] = weight.sum(1)
        half = live & (alpha > 0) & (before > 0.5)
        last = (
            half.shape[1] - 1 - np.argmax(half[:, ::-1], axis=1) if half.shape[1] else np.zeros(len(x), int)
        )
        out["depth_median"] = _pick(z, last, np.any(half, axis=1), 0.0)
    if "normal" in features.taps:
        out["normal"] = weight @ s.normal
    if "label" in features.taps:
        heaviest = np.argmax(weight, axis=1) if weight.shape[1] else np.zeros(len(x), int)
        out["label_weight"] = _pick(weight, heaviest, np.ones(len(x), bool), 0.0)
        labels = np.broadcast_to(s.labels, weight.shape)
        out["label"] = _pick(labels, heaviest, out["label_weight"] > 0, -1)
    return out


def _runs(hit: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Number of the run of each fragment (k, n), -1 where nothing is hit.

    Hits of one plane >= 0 that follow each other in a sample share a run.
    """
    run = np.full(hit.shape, -1)
    row, column = np.nonzero(hit)
    plane = planes[column]
    follows = (row[1:] == row[:-1]) & (plane[1:] == plane[:-1]) & (plane[1:] >= 0)
    run[row, column] = np.cumsum(np.concatenate([[True], ~follows])) - 1 if len(row) else 0
    return run


def _layered(
    alpha: np.ndarray,
    before: np.ndarray,
    weight: np.ndarray,
    live: np.ndarray,
    run: np.ndarray,
    s: _Splats,
    planes: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (k, 3) where a run is one layer: its weight, in the mean colour by optical depth.

    Also what a little more opacity of each splat would change (k, n): the light in front of it or of its run,
    shared with the run's other splats.
    """
    row, column = np.nonzero(live & (run >= 0))
    number = run[row, column]
    tau = np.minimum(-np.log1p(-np.minimum(alpha[row, column], 1 - 2.0**-24)), 24 * math.log(2))
    count = int(run.max(initial=-1)) + 1
    ink = np.zeros((count, 3))
    np.add.at(ink, number, tau[:, None] * s.colors[column])
    depth = np.bincount(number, tau, count)
    total = np.bincount(number, weight[row, column], count)
    mean = ink / np.where(depth > 0, depth, 1)[:, None]
    owner, front = np.zeros(count, int), np.zeros(count)
    owner[number] = row
    np.maximum.at(front, number, before[row, column])
    rgb = np.zeros((len(alpha), 3))
    np.add.at(rgb, owner, total[:, None] * mean)
    # a splat at its rim would join the sample's run of its plane, or be the only one
    joint = np.zeros((len(alpha), planes.max(initial=-1) + 1))
    plane = np.zeros(count, int)
    plane[number] = planes[column]
    printed = plane >= 0
    share = front[printed] / np.maximum(depth[printed], 1)
    np.maximum.at(joint, (owner[printed], plane[printed]), share)
    shared = joint[:, np.maximum(planes, 0)] if joint.size else before
    worth = np.where((planes >= 0) & (shared > 0), shared, before)
    return rgb, worth


def _transmittance(
    alpha: np.ndarray, stop: float, exclusive: bool, run: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transmittance before each fragment, which fragments are drawn, and what is left at the end.

    With runs (k, n), all of a run is drawn if its first fragment is.
    """
    after = np.cumprod(1 - alpha, axis=1)
    before = np.concatenate([np.ones((len(alpha), 1)), after[:, :-1]], axis=1)[:, : alpha.shape[1]]
    live = before > stop
    if run is not None:
        row, column = np.nonzero(run >= 0)
        number = run[row, column]
        first = np.unique(number, return_index=True)[1]
        live[row, column] = live[row[first], column[first]][number]
    if exclusive:
        live &= ~np.logical_or.accumulate((alpha > 0) & (after <= stop), axis=1)
    return before, live, np.where(live, 1 - alpha, 1.0).prod(axis=1)


def _pick(values: np.ndarray, index: np.ndarray, found: np.ndarray, otherwise: float) -> np.ndarray:
    if values.shape[1] == 0:
        return np.full(len(values), otherwise)
    return np.where(found, np.take_along_axis(values, index[:, None], 1)[:, 0], otherwise)


def _resolve(samples: dict[str, np.ndarray], view: View, features: FeatureSet) -> dict[str, np.ndarray]:
    """Pixels from their samples (k, n * n, ...)."""
    t = samples["t"].mean(1)
    out = {
        "rgb": samples["rgb"].mean(1) + t[:, None] * np.asarray(view.background),
        "certificate": samples["certificate"].mean(1),
    }
    if "alpha" in features.taps:
        out["alpha"] = 1 - t
    if "depth" in features.taps:
        weight = samples["weight"].sum(1)
        out["depth"] = np.where(weight > 0, samples["depth"].sum(1) / np.where(weight > 0, weight, 1), 0.0)
    if "depth_median" in features.taps:
        medians = np.sort(np.where(samples["depth_median"] > 0, samples["depth_median"], math.inf), axis=1)
        hits = np.isfinite(medians).sum(1)
        middle = np.take_along_axis(medians, np.maximum((hits - 1) // 2, 0)[:, None], 1)[:, 0]
        out["depth_median"] = np.where(hits > 0, middle, 0.0)
    if "normal" in features.taps:
        total = samples["normal"].sum(1)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        out["normal"] = total / np.where(length > 0, length, 1)
    if "label" in features.taps:
        heaviest = np.argmax(samples["label_weight"], axis=1)
        out["label"] = np.take_along_axis(samples["label"], heaviest[:, None], 1)[:, 0].astype(np.int32)
    return out
