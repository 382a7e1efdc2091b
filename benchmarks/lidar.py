"""Measure LiDAR scans of a greenhouse: time, and errors against float64 and against the meshes of plants.

python benchmarks/lidar.py                               time; needs nothing else
python benchmarks/lidar.py --device opencl:nvidia --batch 16
python benchmarks/lidar.py --errors                      also errors; needs trimesh and rtree
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import replace

import measuring
import numpy as np

import fidsplat as fs
from fidsplat.capture.lidar import Spinning
from fidsplat.render.scan import ScanRequest
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.worlds.greenhouse import Greenhouse
from fidsplat.worlds.plants import KINDS

POSE = rigid_matrix((1.0, 0.75, 0.8), (1, 0, 0, 0))
"""in the first aisle"""
SENSORS = ("os1-64", "vlp-16", "livox-mid-40")


def times(renderer: fs.Renderer, name: str, batch: int, repeats: int) -> tuple[str, ...]:
    """Beams, and medians over scans of an uploaded greenhouse: stages of the device, complete scan, CPU time
    of the complete scan."""
    scene, lidar = Greenhouse().scene, fs.Lidar.preset(name)
    resident = renderer.upload(scene)
    poses = np.tile(np.concatenate([POSE[:3, 3], [1.0, 0, 0, 0]]), (batch, 1))
    poses[:, 0] += 0.1 * np.arange(batch)
    seconds = []
    for _ in range(repeats + 1):
        begun, used = time.perf_counter(), time.process_time()
        if batch == 1:
            fs.scan(resident, lidar, POSE, renderer=renderer)
        else:
            fs.scan_batch(resident, lidar, poses, renderer=renderer)
        seconds.append((time.perf_counter() - begun, time.process_time() - used))
    capture = ScanRequest.of(lidar, scene, False, fs.Motion(), None).capture(POSE)
    frames = [renderer.render_batch(resident, capture, poses=poses) for _ in range(repeats + 1)]
    device = [sum(frame.timings.values()) / batch for frame in frames[1:]]
    complete, cpu = 1e3 / batch * np.median(seconds[1:], axis=0)
    return name, f"{lidar.pattern.beams:,}", *(f"{ms:.2f}" for ms in (np.median(device), complete, cpu))


def device_error(renderer: fs.Renderer) -> tuple[float, float, float]:
    """Relative range error of an OS1 with an eighth of its columns against float64: 99 % quantile, and shares
    of beams that end at another surface or on one device only."""
    scene, lidar = Greenhouse(rows=2, plants=4).scene, fs.Lidar.preset("os1-64")
    pattern = Spinning(lidar.pattern.elevations, lidar.pattern.columns // 8)  # type: ignore[union-attr]
    ideal = replace(lidar, pattern=pattern, noise=0.0, detection_range=math.inf)
    found, truth = (
        fs.scan(scene, ideal, POSE, renderer=one).range for one in (renderer, fs.Renderer("reference"))
    )
    both = (found > 0) & (truth > 0)
    error = np.abs(found[both] / truth[both] - 1)
    same = error < 1e-4
    return np.quantile(error[same], 0.99), 1 - same.mean(), ((found > 0) != (truth > 0)).mean()


def mesh_error(renderer: fs.Renderer, kind: str, splats: int) -> tuple[str, ...]:
    """Ranges of a plant's splats against trimesh's intersections with its mesh, 0.8 m away: bias, 50 % and
    95 % of the sizes of errors, in mm, and beams that hit one of them only."""
    import trimesh

    mesh = KINDS[kind](np.random.default_rng(3))
    faces = np.concatenate([mesh.quads[:, [0, 1, 2]], mesh.quads[:, [0, 2, 3]]])
    solid = trimesh.Trimesh(mesh.vertices, faces, process=False)
    pose = rigid_matrix((-0.8, 0.1, 0.6), (1, 0, 0, 0))
    lidar = fs.Lidar(Spinning(tuple(np.linspace(-0.7, 0.5, 64)), 1024), near=0.05)
    cloud = mesh.splats(splats)
    found = fs.scan(cloud, lidar, pose, renderer=renderer)
    rays, found_range = found.directions, found.range[0]
    chosen = np.flatnonzero(np.abs(np.arctan2(rays[:, 1], rays[:, 0])) < 0.5)
    places, beams, _ = solid.ray.intersects_location(
        np.tile(pose[:3, 3], (len(chosen), 1)), rays[chosen], multiple_hits=False
    )
    truth = np.zeros(len(rays))
    truth[chosen[beams]] = np.linalg.norm(places - pose[:3, 3], axis=1)
    both, either = (truth > 0) & (found_range > 0), (truth > 0) | (found_range > 0)
    either[np.setdiff1d(np.arange(len(rays)), chosen)] = False
    error = 1e3 * (found_range - truth)[both]
    values = np.median(error), *np.quantile(np.abs(error), (0.5, 0.95)), 1e3 * cloud.scales.mean()
    only = 1 - both[chosen].sum() / either.sum()
    return kind, f"{splats:,}", *(f"{value:.2f}" for value in values), f"{100 * only:.1f} %"


def main() -> int:
    """Measure and print."""
    parser = measuring.options(__doc__, repeats=9)
    parser.add_argument("--batch", type=int, default=1, help="scans in one submission")
    parser.add_argument("--errors", action="store_true", help="also measure errors")
    arguments = parser.parse_args()
    renderer = fs.Renderer(arguments.device)
    print(measuring.facts(renderer))
    rows = [times(renderer, name, arguments.batch, arguments.repeats) for name in SENSORS]
    measuring.show("ms per scan", ("sensor", "beams", "device", "scan", "CPU time"), rows)
    if arguments.errors:
        precise, elsewhere, one_sided = device_error(renderer)
        print(f"against float64: 99 % {precise:.2g}, elsewhere {elsewhere:.2g}, on one only {one_sided:.2g}")
        plants = [mesh_error(renderer, kind, count) for kind in KINDS for count in (1_000, 20_000, 100_000)]
        heads = ("plant", "splats", "bias [mm]", "50 % [mm]", "95 % [mm]", "splat [mm]", "one only")
        measuring.show("against the mesh", heads, plants)
    return 0


if __name__ == "__main__":
    sys.exit(main())
