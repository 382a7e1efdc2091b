"""Compare interleaved frames of our devices, quality settings and orders, and of gsplat and HiGS if built.

    python benchmarks/frame_times.py r1m_1080p tag before_wall biker.compressed.ply \
        [--devices opencl:nvidia warp:cuda] [--repeats 40] [--json FILE]

Scenes are those of `fidsplat bench`, `before_wall` (an AprilTag 5 cm in front of a wall of 2000 splats),
`intersecting` (1000 splats that intersect), and files of captured scenes. A file has three views of
1920 x 1080 (far, middle, near) of 3D Gaussians with plain colours, and one of 640 x 480 through a fisheye
lens, with a marker.

Random scenes are rendered with the cut-off 1/255 and the stop 1e-4, captured views with all constants of
gsplat, both also with half precision; random scenes and qr_wall also with the quality `standard`, on each
device. Scenes with intersecting splats are rendered in each order. HiGS is the inference renderer of gsplat's
main branch (gsplat.experimental.render, BUILD_EXPERIMENTAL=1): 3D Gaussians in half precision; disks are flat
3D Gaussians for it. gsplat is run if it is installed, on the first device's GPU.

Splats and images stay on the device; times end when it is done. The columns are the median and the shortest
time of a frame, the time over that of the renderer or setting in the next column (median over the rounds),
and PSNR against our first setting.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from measuring import PROGRESS, facts, keep, options, show
from real_scene import extent, views

import fidsplat as fs
from fidsplat.capture.quality import Quality
from fidsplat.experiments.bench.catalogue import BENCH_SCENES
from fidsplat.formats import load_splats
from fidsplat.scenes.random_clouds import SCENES, random_splats
from fidsplat.selftest.order import camera_path, wall
from fidsplat.splats.harmonics import C0
from fidsplat.util.timing import Timer, frame_timer, ratios, time_interleaved
from fidsplat.vision.metrics import psnr

try:
    import gsplat
    import torch
    from gsplat.experimental.render.components.gaussian_inference_renderer import GaussianInferenceRenderer
    from gsplat.scene import GaussianInferenceScene
except ImportError:
    gsplat = torch = None

RANDOM, CAPTURED, HALF = f"alpha_cutoff={1 / 255:.6f}", "gsplat", ",blend_precision=float16"
VIEWS = {"far": 2.2, "middle": 1.2, "near": 0.5}
"""distance of the camera from the median splat, in radii that hold 95 % of the splats"""
DIRECTION = np.array([0.6, -0.3, -0.74])
MARKER = "apriltag:36h11:5"


@dataclass(frozen=True)
class Row:
    """A scene with the settings that are compared."""

    name: str
    cloud: fs.SplatCloud
    camera: fs.Camera
    settings: tuple[str, ...]
    """quality settings on the first device"""
    base: str = "HiGS"
    """setting or renderer to whose time others are compared, if it is measured"""
    every_device: bool = False
    """whether `standard` is also rendered on the other devices"""


def orders(name: str, cloud: fs.SplatCloud, camera: fs.Camera) -> Row:
    """A scene in all orders."""
    some = ("centre", "auto", "pixel") if cloud.has_coplanar_groups else ("centre", "pixel")
    settings = tuple(f"standard,order={order}" for order in some)
    return Row(name, cloud, camera, settings, settings[0])


def before_wall() -> tuple[fs.SplatCloud, fs.Camera]:
    """An AprilTag 1 m wide, 5 cm in front of a wall, seen from 30 degrees."""
    cloud = fs.SplatCloud.concatenate([fs.marker(MARKER, size=1.0).cloud, wall()])
    return cloud, next(camera_path(cloud, "auto", 0, 30.0, 1280, 720)).camera


def intersecting() -> tuple[fs.SplatCloud, fs.Camera]:
    """Splats of 5 to 40 cm in a cube of 1 m."""
    cloud = random_splats(1000, 3, (-0.5, 0.5), (0.05, 0.4), across=1.0)
    return cloud, next(camera_path(cloud, "auto", 0, 30.0, 1280, 720)).camera


def with_marker(scene: fs.SplatCloud) -> tuple[fs.SplatCloud, fs.Camera]:
    """A captured scene with a marker next to it, through a fisheye lens."""
    low, high = extent(scene)
    height = high[1] - low[1]
    front = views(scene)["front"].world_to_camera
    beside = np.eye(4)
    beside[:3, :3] = front[:3, :3].T
    beside[:3, 3] = (low + high) / 2 + front[:3, :3].T @ [0.35 * height, 0.0, -0.1 * height]
    tag = fs.marker(MARKER, size=0.2 * height).cloud.transformed(beside)
    return fs.SplatCloud.concatenate([scene, tag]), fs.Camera.fisheye(640, 480, math.radians(120), front)


def captured(file: str) -> Iterator[Row]:
    """Rows of a captured scene."""
    cloud = load_splats(file)
    means = cloud.means + cloud.origin.astype(np.float32)
    colors = cloud.colors
    if colors is None:
        assert cloud.sh is not None
        colors = np.clip(cloud.sh[:, 0] * C0 + 0.5, 0, None)
    thickness = np.zeros(len(cloud)) if cloud.thickness is None else cloud.thickness
    scales = np.column_stack([cloud.scales, thickness])
    plain = fs.SplatCloud(means, cloud.quats, scales, cloud.opacities, colors=colors)
    middle = np.median(means, axis=0)
    radius = float(np.percentile(np.linalg.norm(means - middle, axis=1), 95))
    name = Path(file).name.split(".")[0] if Path(file).stem != "meta" else Path(file).parents[1].name
    for view, distance in VIEWS.items():
        position = tuple(middle + distance * radius * DIRECTION)
        camera = fs.Camera.look_at(1920, 1080, 1.0, position=position, target=tuple(middle))
        yield Row(f"{name} {view}", plain, camera, (CAPTURED, CAPTURED + HALF))
    yield orders(f"{name} with a tag, fisheye", *with_marker(plain))


def rows_of(scene: str) -> Iterator[Row]:
    """Rows of a scene by its name or file."""
    crossing = {"before_wall": before_wall, "intersecting": intersecting}
    if scene in crossing:
        yield orders(scene, *crossing[scene]())
    elif scene in BENCH_SCENES:
        cloud, camera = BENCH_SCENES[scene].make()
        settings = (RANDOM, RANDOM + HALF, "standard") if scene in SCENES else (RANDOM, "standard")
        yield Row(scene, cloud, camera, settings, every_device=True)
        if scene == "r1m_1080p":
            yield orders(scene, cloud, camera)
    else:
        yield from captured(scene)


def peers(cloud: fs.SplatCloud, camera: fs.Camera) -> dict[str, Callable[[], Any]]:
    """Functions by renderer that render a frame (h, w, 3) and wait for the GPU."""
    if gsplat is None or torch is None or cloud.colors is None or cloud.boxes is not None:
        return {}
    disks = cloud.thickness is None
    third = np.ones(len(cloud)) if disks else cloud.thickness
    arrays = {
        "means": cloud.means + cloud.origin,
        "quats": cloud.quats,
        "scales": np.column_stack([cloud.scales, third]),
        "opacities": cloud.opacities,
        "colors": cloud.colors[None],  # for each camera
        "viewmats": camera.world_to_camera[None],
        "Ks": camera.matrix[None],
    }
    on_gpu = {
        name: torch.tensor(np.asarray(array, np.float32), device="cuda") for name, array in arrays.items()
    }
    size = {"width": camera.width, "height": camera.height}
    rasterize = gsplat.rasterization_2dgs if disks else gsplat.rasterization
    scales = on_gpu["scales"].clone()
    if disks:
        scales[:, 2] = 1e-6
    scene = GaussianInferenceScene.from_gaussian_tensors(
        on_gpu["means"],
        torch.nn.functional.normalize(on_gpu["quats"], dim=-1),
        scales,
        on_gpu["opacities"],
        on_gpu["colors"][0].contiguous(),
        None,
        "none",
        id="a",
    )
    higs = GaussianInferenceRenderer(scene, tile_size=8)

    def render_gsplat() -> Any:
        image = rasterize(**on_gpu, **size, packed=False)[0][0]
        torch.cuda.synchronize()
        return image

    def render_higs() -> Any:
        frame = higs.render(viewmat=on_gpu["viewmats"][0], K=on_gpu["Ks"][0], **size).frame
        torch.cuda.synchronize()
        return frame.reshape(camera.height, camera.width, -1)[..., :3]

    return {f"gsplat {gsplat.__version__}": render_gsplat, "HiGS": render_higs}


def measure(row: Row, devices: list[str], repeats: int) -> list[dict]:
    """Records of a row by renderer and setting."""
    compared = [(devices[0], setting) for setting in row.settings]
    if row.every_device:
        compared += [(device, "standard") for device in devices[1:]]
    renderers = {device: fs.Renderer(device) for device in dict(compared)}
    resident = {device: renderer.upload(row.cloud) for device, renderer in renderers.items()}
    images, timers = {}, {}
    for device, setting in compared:
        capture = fs.Capture(row.camera, quality=Quality.of(setting))
        name = setting if device == devices[0] else f"{device} {setting}"
        images[name] = np.asarray(renderers[device].render(resident[device], capture)["rgb"])
        timers[name] = frame_timer(renderers[device], resident[device], capture)
    drawn = peers(row.cloud, row.camera) if row.base == "HiGS" else {}
    images |= {name: draw().float().cpu().numpy() for name, draw in drawn.items()}
    timers |= {name: Timer(draw, parts=lambda image: {}) for name, draw in drawn.items()}
    time_interleaved(list(timers.values()), repeats, warm_up=6)
    first = row.settings[0]
    backend = renderers[devices[0]].backend
    records = []
    for name, timer in timers.items():
        base = row.base if row.base in timers else first
        if name.endswith(" standard"):
            base = "standard"  # of the first device
        records.append(
            {
                "scene": row.name,
                "renderer": name,
                "splats": len(row.cloud),
                "frame_ms": timer.median,
                "quartiles_ms": timer.quartiles[::2],
                "fastest_ms": min(timer.ms),
                "ratio": float(np.median(ratios(timer, timers[base]))),
                "over": base,
                "stages_ms": timer.part_medians,
                "psnr_db": psnr(np.clip(images[name], 0, 1), np.clip(images[first], 0, 1)),
            }
        )
    pixels = row.camera.width * row.camera.height
    records[0]["memory_bytes"] = backend.memory_bytes + resident[devices[0]].memory_bytes + 12 * pixels
    return records


def main() -> None:
    parser = options(__doc__, device="opencl:nvidia", repeats=40)
    parser.add_argument("scenes", nargs="+", help="scenes by name, and files of captured scenes")
    parser.add_argument("--devices", nargs="+", help="our devices (default: --device)")
    arguments = parser.parse_args()
    devices = arguments.devices or [arguments.device]
    versions = facts(fs.Renderer(devices[0])) | ({} if gsplat is None else {"gsplat": gsplat.__version__})
    records: list[dict] = []
    for scene in arguments.scenes:
        for row in rows_of(scene):
            found = measure(row, devices, arguments.repeats)
            records += found
            keep({**versions, "results": records}, None if arguments.json == "-" else arguments.json)
            for record in found:
                PROGRESS.print(f"{row.name} {record['renderer']}: {record['frame_ms']:.3f} ms")
            gc.collect()
            if torch is not None:
                torch.cuda.empty_cache()
    if not keep({**versions, "results": records}, arguments.json):
        rows = [
            (
                record["scene"],
                record["renderer"],
                f"{record['frame_ms']:.3f}",
                f"{record['fastest_ms']:.3f}",
                f"{record['ratio']:.2f}",
                record["over"],
                f"{record['psnr_db']:.1f}",
            )
            for record in records
        ]
        heads = ("scene", "renderer or setting", "ms", "shortest", "ratio", "over", "PSNR, dB")
        show("Milliseconds per frame", heads, rows)


if __name__ == "__main__":
    with nullcontext() if torch is None else torch.no_grad():
        main()
