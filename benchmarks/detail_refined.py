"""Would gradients make levels of detail better: merged splats refined against pictures of the exact ones.

    python benchmarks/detail_refined.py [--splats 1e4] [--nodes 4] [--steps 30] [--sizes 0.5] [--json FILE]

Takes nodes of the first level of a small city (`fidsplat.store.city`). Of each, pictures of the splats that
it stands for, alone, from directions that are spread over half of the sphere, so that its cells are --sizes
samples. Adam moves the node's merged splats (places, sizes, opacities, colours) for a number of steps by all
of these pictures. Gradients know no `lowpass="pixel"`; so the splats are widened here as it widens them,
drawn without one, and derivatives are taken back through that. Then for each size the largest difference of
rgb from other directions, by moments alone and refined; and seconds of a node.
"""

from __future__ import annotations

import math
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from measuring import PROGRESS, facts, keep, options, show

import fidsplat as fs
from fidsplat.accuracy import TRUTH_CUTOFF
from fidsplat.rotations import quaternion_to_matrix
from fidsplat.store.city import City
from fidsplat.store.merge import quaternions_of
from fidsplat.store.part import StorePart
from fidsplat.store.streamed import Streamed
from fidsplat.train.derivatives import drawn

EXACT = fs.Quality(lowpass="pixel", alpha_cutoff=TRUTH_CUTOFF, order="centre")
WIDENED = EXACT.with_(lowpass="none")
WHOLE_DEPTH = 4.0
"""samples for which that takes a depth"""
VARIANCE = 0.25
"""square samples: of `lowpass="pixel"` (kernels/opencl/slot/lowpass_pixel.cl)"""
RATES = {"means": 0.02, "log_scales": 0.02, "log_opacities": 0.02, "colors": 0.01}
"""Adam's; of places in edges of a cell"""
BETA1, BETA2 = 0.9, 0.99
EVALUATED = (0.125, 0.25, 0.5)
"""samples"""
GOLDEN = math.pi * (3 - math.sqrt(5))


Arrays = dict[str, np.ndarray]


class Refined:
    """The merged splats of a node while they are refined."""

    def __init__(self, given: Arrays, edge: float, whole: Streamed) -> None:
        self._quats, self._labels, self._whole, self._edge = given["quats"], given["labels"], whole, edge
        opacities, scales = (given[name].astype(np.float64) for name in ("opacities", "scales"))
        logs = {"log_scales": np.log(scales), "log_opacities": np.log(np.maximum(opacities, 1e-6))}
        self._values = logs | {name: given[name].astype(np.float64) for name in ("means", "colors")}
        self._first = {name: np.zeros_like(array) for name, array in self._values.items()}
        self._second = {name: np.zeros_like(array) for name, array in self._values.items()}

    def arrays(self) -> Arrays:
        """As a store has them."""
        values = self._values
        made = {"means": values["means"], "quats": self._quats, "scales": np.exp(values["log_scales"])}
        made |= {"opacities": np.exp(values["log_opacities"]), "colors": np.clip(values["colors"], 0, 1)}
        return made | {"labels": self._labels}

    def slopes(self, renderer: fs.Renderer, camera: fs.Camera, wanted: list[np.ndarray]) -> Arrays:
        """Derivatives, by the free values, of the summed squares of what rgb and alpha are off by."""
        given, frames = self.arrays(), _frames(self._quats)
        widths, turns, grown = _widened(given, frames, camera)
        axes = np.einsum("nij,njk->nik", frames[:, :, :2], turns)
        quats = quaternions_of(np.concatenate([axes, np.cross(axes[:, :, 0], axes[:, :, 1])[:, :, None]], 2))
        faint = np.minimum(given["opacities"] / grown, 0.9999)
        drawable = given | {"quats": quats, "scales": widths, "opacities": faint}
        capture = fs.Capture(camera, outputs=("rgb", "alpha"), quality=WIDENED)
        images, backward = drawn(renderer, _cloud(drawable, self._whole), capture)
        off = {name: images[name] - one for name, one in zip(("rgb", "alpha"), wanted, strict=True)}
        by = backward({name: array.astype(np.float32) for name, array in off.items()})
        # the covariance in the plane is the sum of the splat's and the filter's
        by_spread = np.einsum("nk,nik,njk->nij", by["scales"] / (2 * widths), turns, turns)
        precision = np.einsum("nk,nik,njk->nij", 1 / widths**2, turns, turns)
        square, by_opacity = given["scales"] ** 2, (by["opacities"] * faint)[:, None]
        own, share = (np.diagonal(array, axis1=1, axis2=2) * square for array in (by_spread, precision))
        made = {"log_scales": 2 * own + by_opacity * (1 - share), "log_opacities": by_opacity[:, 0]}
        return made | {name: by[name] for name in ("means", "colors")}

    def step(self, slopes: Arrays, number: int, share: float) -> None:
        """One of Adam's. share: of the rates."""
        for name, slope in slopes.items():
            first, second = self._first[name], self._second[name]
            first += (1 - BETA1) * (slope - first)
            second += (1 - BETA2) * (slope**2 - second)
            size = np.sqrt(second / (1 - BETA2**number)) + 1e-12
            rate = share * RATES[name] * (self._edge if name == "means" else 1.0)
            self._values[name] -= rate * first / (1 - BETA1**number) / size


def _frames(quats: np.ndarray) -> np.ndarray:
    """(n, 3, 3) the axes of splats in columns."""
    return np.array([quaternion_to_matrix(quat) for quat in quats.astype(np.float64)])


def _widened(
    given: Arrays, frames: np.ndarray, camera: fs.Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What `lowpass="pixel"` makes of splats: standard deviations (n, 2) along axes (n, 2, 2, columns in
    (u, v)), and how many times larger they are (n,)."""
    pose = camera.world_to_camera
    place = given["means"] @ pose[:3, :3].T + pose[:3, 3]
    axes = np.einsum("ij,njk->nik", pose[:3, :3], frames[:, :, :2])
    depth = place[:, 2, None, None]
    by_metre = camera.matrix[0, 0] / depth * (axes[:, :2] - place[:, :2, None] / depth * axes[:, 2:])
    by_metre = np.concatenate([by_metre, WHOLE_DEPTH / depth * axes[:, 2:]], axis=1)
    spread = VARIANCE * np.linalg.inv(np.einsum("nik,nil->nkl", by_metre, by_metre))
    scales = given["scales"].astype(np.float64)
    spread[:, 0, 0] += scales[:, 0] ** 2
    spread[:, 1, 1] += scales[:, 1] ** 2
    squares, turns = np.linalg.eigh(spread)
    widths = np.sqrt(squares)
    return widths, turns, widths.prod(axis=1) / scales.prod(axis=1)


def _cloud(given: Arrays, whole: Streamed) -> StorePart:
    kinds = {name: np.int32 if name == "labels" else np.float32 for name in given}
    return StorePart.of({name: np.ascontiguousarray(given[name], kinds[name]) for name in given}, whole)


def cameras(node: Any, size: float, count: int, turn: float) -> list[fs.Camera]:
    """That look at a node from so many directions above, far away: its cells have so many samples."""
    low, high = node["low"].astype(np.float64), node["high"].astype(np.float64)
    middle, across = (low + high) / 2, float(np.linalg.norm(high - low)) + 6 * float(node["reach"])
    width = max(16, math.ceil(across * size / float(node["size"])) + 8)
    away = 20 * across
    fov = 2 * math.atan(width / 2 * float(node["size"]) / size / away)
    made = []
    for number in range(count):
        up, around = 1 - (number + 0.5) / count, GOLDEN * number + turn
        side = math.sqrt(1 - up * up)
        at = middle + away * np.array([math.cos(around) * side, -up, math.sin(around) * side])
        made.append(fs.Camera.look_at(width, width, fov, at, middle, up=(0.0, -1.0, 1e-3)))
    return made


def pictures(renderer: fs.Renderer, cloud: fs.SplatCloud, views: list[fs.Camera]) -> list[list[np.ndarray]]:
    """rgb and alpha of each view."""
    frames = (renderer.render(cloud, fs.Capture(view, ("rgb", "alpha"), EXACT)) for view in views)
    return [[frame["rgb"], frame["alpha"]] for frame in frames]


def measure(store: fs.Store, number: int, renderer: fs.Renderer, asked: Any) -> dict:
    """Errors of one node (its number) by moments and refined, by size."""
    nodes, whole = store.nodes, Streamed([store])
    node, below = nodes[number], np.flatnonzero(nodes["parent"] == number)
    parts = [store.load(int(one)) for one in below]
    exact = _cloud({name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, whole)
    merged = store.load(number)
    splats, begun = Refined(merged, float(node["size"]), whole), time.perf_counter()
    views = [one for size in asked.sizes for one in cameras(node, size, asked.directions, 0.0)]
    wanted = pictures(renderer, exact, views)
    for step in range(1, asked.steps + 1):
        each = [splats.slopes(renderer, view, one) for view, one in zip(views, wanted, strict=True)]
        total = {name: np.sum([slopes[name] for slopes in each], axis=0) for name in each[0]}
        splats.step(total, step, 1 - 0.95 * step / asked.steps)
    row = {"splats": len(exact), "merged": len(merged["means"]), "s": time.perf_counter() - begun}
    for name, arrays in (("moments", merged), ("refined", splats.arrays())):
        row[name] = []
        for size in EVALUATED:
            others = cameras(node, size, 2 * asked.directions, 1.0)
            ours = pictures(renderer, _cloud(arrays, whole), others)
            theirs = pictures(renderer, exact, others)
            row[name].append(max(float(np.abs(a[0] - b[0]).max()) for a, b in zip(ours, theirs, strict=True)))
    PROGRESS.print(str(row))
    return row


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--splats", type=float, default=1e4)
    parser.add_argument("--nodes", type=int, default=4)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--directions", type=int, default=12)
    parser.add_argument("--sizes", type=float, nargs="+", default=[0.5], help="of cells in samples")
    asked = parser.parse_args()
    renderer = fs.Renderer(asked.device)
    with tempfile.TemporaryDirectory() as folder:
        city = City(int(asked.splats), 4)
        store = fs.Store(fs.build_store([city.source], Path(folder) / "city.fss", chunk=512))
        numbers = np.flatnonzero(store.nodes["level"] == 1)[: asked.nodes]
        rows = [measure(store, int(number), renderer, asked) for number in numbers]
    about = {name: value for name, value in vars(asked).items() if name not in ("device", "json")}
    keep({**facts(renderer), **about, "evaluated": EVALUATED, "rows": rows}, asked.json)
    show(
        f"{len(rows)} nodes, refined at {asked.sizes} samples, {asked.steps} steps, {renderer.device.title}",
        ("largest error by cells of", *(f"{size:.3f} px" for size in EVALUATED), "seconds a node"),
        (
            (
                name,
                *(f"{max(row[name][at] for row in rows):.4f}" for at in range(len(EVALUATED))),
                f"{np.mean([row['s'] for row in rows]):.2f}" if name == "refined" else "",
            )
            for name in ("moments", "refined")
        ),
    )


if __name__ == "__main__":
    main()
