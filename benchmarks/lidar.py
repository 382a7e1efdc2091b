"""Measure LiDAR scans of a greenhouse: time, and errors against float64 and against the meshes of plants.

python benchmarks/lidar.py                               time; needs nothing else
python benchmarks/lidar.py --device opencl:nvidia --batch 16
python benchmarks/lidar.py --errors                      also errors; needs trimesh, and embreex or rtree
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
from fidsplat.util.directions import perpendicular, unit
from fidsplat.worlds.greenhouse import PLANT_SPLATS, Greenhouse
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
    95 % of the sizes of errors in mm, the same 95 % of beams without a silhouette within two standard
    deviations of a splat, a standard deviation, shares of beams that are off by less and without silhouette,
    and beams that hit the mesh or the splats only."""
    import trimesh

    mesh = KINDS[kind](np.random.default_rng(3))
    faces = np.concatenate([mesh.quads[:, [0, 1, 2]], mesh.quads[:, [0, 2, 3]]])
    solid = trimesh.Trimesh(mesh.vertices, faces, process=False)
    pose = rigid_matrix((-0.8, 0.1, 0.6), (1, 0, 0, 0))
    lidar = fs.Lidar(Spinning(tuple(np.linspace(-0.7, 0.5, 64)), 1024), near=0.05)
    cloud = mesh.splats(splats)
    size = float(cloud.scales.mean())
    scan = fs.scan(cloud, lidar, pose, renderer=renderer)
    chosen = np.flatnonzero(np.abs(np.arctan2(scan.directions[:, 1], scan.directions[:, 0])) < 0.5)
    rays, found = scan.directions[chosen], scan.range[0][chosen]

    def cast(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Range of the mesh, 0 without intersection, and cosine of the angle of incidence."""
        eyes = np.tile(pose[:3, 3], (len(rays), 1))
        places, beams, hit = solid.ray.intersects_location(eyes, rays, multiple_hits=False)
        ranges, cosines = np.zeros((2, len(rays)))
        ranges[beams] = np.linalg.norm(places - eyes[beams], axis=1)
        cosines[beams] = np.abs((solid.face_normals[hit] * rays[beams]).sum(1))
        return ranges, cosines

    truth, cosine = cast(rays)
    across = perpendicular(rays) * (2 * size / np.where(truth > 0, truth, 0.8))[:, None, None]
    around = [cast(unit(rays + sign * across[:, axis]))[0] for sign in (1, -1) for axis in (0, 1)]
    jump = np.ptp([truth, *around], axis=0)  # a missed surface has a range of 0
    both = (truth > 0) & (found > 0)
    inside = both & (jump < 6 * size / np.maximum(cosine, 0.2))
    error = 1e3 * np.abs(found - truth)
    values = np.median(1e3 * (found - truth)[both]), *np.quantile(error[both], (0.5, 0.95))
    only = 1 - both.sum() / ((truth > 0) | (found > 0)).sum()
    texts = [f"{value:.2f}" for value in (*values, np.quantile(error[inside], 0.95), 1e3 * size)]
    within = (error[both] < 1e3 * size).mean()
    shares = (f"{100 * share:.1f} %" for share in (within, inside.sum() / both.sum(), only))
    return kind, f"{splats:,}", *texts, *shares


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
        counts = (PLANT_SPLATS, 20_000, 100_000, 300_000)
        plants = [mesh_error(renderer, kind, count) for kind in KINDS for count in counts]
        heads = ("plant", "splats", "bias", "50 %", "95 %", "95 % inside", "splat", "within")
        heads = (*heads, "inside", "one only")
        measuring.show("against the mesh, mm", heads, plants)
    return 0


if __name__ == "__main__":
    sys.exit(main())
