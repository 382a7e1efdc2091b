"""Measure images per second and PSNR of tiled cameras: fidsplat, mujoco_warp and Newton, interleaved on one
scene.

    python benchmarks/tiled_cameras.py --device warp:cpu --row few --repeats 3
    python benchmarks/tiled_cameras.py --device warp:cuda opencl:nvidia --row agents

Needs `pip install 'fidsplat[tiled]'`. The scene is a closed room of flat splats without spherical harmonics
and low-pass filter, which the other renderers lack; their third scale is 1e-4 m. Images stay on the device.
PSNR compares 8-bit images with all fragments blended in float64.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from batches import ROWS, arc
from measuring import PROGRESS, facts, keep, options, show

import fidsplat as fs
from fidsplat.images.files import to_uint8, write_png
from fidsplat.sim import Rig
from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.vision.metrics import psnr

THIN = 1e-4
"""metres: third scale of splats of the others"""
TRUTH = "standard,lowpass=none,order=pixel,alpha_cutoff=1e-8,transmittance_stop=0"
QUALITIES = {
    "order by pixel": "standard,order=pixel",
    "fast, by pixel": "fast,order=pixel",
    "order by centre": "standard,order=centre",
}
COLOR = 0.28209479177387814
"""spherical harmonic of degree 0"""


class Tiled(NamedTuple):
    """Renderer of all views of a batch."""

    draw: Callable[[], object]
    """render, and wait for the device"""
    image: Callable[[int], np.ndarray]
    """(h, w, 3) uint8 image of a view, as last rendered"""


def room(count: int) -> fs.SplatCloud:
    """Splats on the walls of a room around the cameras of `arc`, and a fifth of them inside."""
    rng, half = np.random.default_rng(0), np.array([6.0, 3.0, 7.0])
    axis = rng.choice(3, count, p=(half.prod() / half) / (half.prod() / half).sum())
    means, inside = rng.uniform(-half, half, (count, 3)), rng.random(count) < 0.2
    walls = np.flatnonzero(~inside)
    means[walls, axis[walls]] = (half * np.sign(rng.uniform(-1, 1, (count, 3))))[walls, axis[walls]]
    facing = np.array([[1, 0, 1, 0], [1, 1, 0, 0], [1, 0, 0, 0]]) / np.sqrt([[2], [2], [1]])  # of each axis
    means += rng.normal(0, 0.1, (count, 3))  # their order is that of depths
    tilted = facing[axis] + rng.normal(0, 0.05, (count, 4))
    quats = np.where(inside[:, None], rng.normal(size=(count, 4)), tilted)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    spacing = math.sqrt(8 * (half.prod() / half).sum() / count)
    scales = spacing * rng.uniform(0.6, 1.2, (count, 2)) * np.where(inside, 0.5, 1.0)[:, None]
    opacities, shades = rng.uniform(0.7, 1.0, count), rng.random((count, 3))
    return fs.SplatCloud(means + np.array([0, 0, 6]), quats, scales, opacities, colors=shades)


def ours(cloud: fs.SplatCloud, camera: fs.Camera, poses: np.ndarray, device: str, quality: str) -> Tiled:
    scene = fs.Scene([cloud], quality=f"{quality},lowpass=none")
    rig, last = Rig(scene, cameras={"eye": camera}, renderer=fs.Renderer(device), outputs=("rgb",)), {}

    def draw() -> None:
        last["images"] = rig.render(None, {"eye": poses}).wait()

    return Tiled(draw, lambda k: to_uint8(last["images"].of("eye").frame(k)["rgb"]))


def mujoco_warp(cloud: fs.SplatCloud, camera: fs.Camera, poses: np.ndarray, device: str) -> Tiled:
    import mujoco
    import mujoco_warp as mjw
    import warp as wp

    size = camera.width, camera.height
    fovy = math.degrees(2 * math.atan(camera.height / 2 / camera.fy))
    # it crashes without a geom
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody><geom size='.001' pos='0 0 -1000'/><camera fovy='{fovy}'/></worldbody></mujoco>"
    )
    with wp.ScopedDevice(device):
        there, data = mjw.put_model(model), mjw.make_data(model, nworld=len(poses))
        data.cam_xpos.assign(poses[:, None, :3].astype(np.float32))
        axes = quaternion_to_matrix(poses[:, 3:]) @ np.diag([1.0, -1.0, -1.0])
        data.cam_xmat.assign(axes[:, None].astype(np.float32))
        context = mjw.create_render_context(
            model, len(poses), size, True, False, False,
            splat_position=cloud.means.astype(np.float32), splat_rotation=cloud.quats,
            splat_scale=with_thickness(cloud), splat_rgba=np.column_stack([colors(cloud), cloud.opacities]),
        )  # fmt: skip
        mjw.refit_bvh(there, data, context)

    def draw() -> None:
        with wp.ScopedDevice(device):
            mjw.render(there, data, context)
            wp.synchronize_device()

    def image(k: int) -> np.ndarray:
        packed = context.rgb_data.numpy()[k].reshape(camera.height, camera.width)
        return np.stack([packed >> shift & 255 for shift in (16, 8, 0)], -1).astype(np.uint8)

    return Tiled(draw, image)


def newton(cloud: fs.SplatCloud, camera: fs.Camera, poses: np.ndarray, device: str, best: bool) -> Tiled:
    """Newton's renderer. best: composite all fragments of a ray above 1/255, instead of Newton's defaults."""
    import warp as wp
    from newton import Gaussian, ModelBuilder
    from newton.sensors import SensorCamera

    builder, count = ModelBuilder(), len(poses)
    gaussian = Gaussian(
        cloud.means, cloud.quats[:, [1, 2, 3, 0]], with_thickness(cloud), cloud.opacities,
        (colors(cloud) - 0.5) / COLOR, min_response=1 / 255 if best else 0.1,
    )  # fmt: skip
    builder.add_shape_gaussian(-1, gaussian=gaussian)
    builder.replicate(ModelBuilder(), count)
    model = builder.finalize(device=device)
    state, sensor = model.state(), SensorCamera(model)
    mode = SensorCamera.GaussianRenderMode
    config = SensorCamera.RenderConfig(gaussians_mode=mode.QUALITY if best else mode.FAST)
    intrinsics = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    rays = SensorCamera.compute_camera_rays_pinhole_opencv(*intrinsics, device=device)
    w, x, y, z = poses[:, 3:].T
    places = np.column_stack([poses[:, :3], w, z, -y, -x])  # turned by 180 degrees about x; x y z w
    transforms = wp.array(places.astype(np.float32), dtype=wp.transformf, device=device)
    pixels = sensor.allocate_image_color(count, camera.width, camera.height)

    def draw() -> None:
        sensor.update(state, transforms, rays, color_image=pixels, render_config=config)
        wp.synchronize_device(device)

    def image(k: int) -> np.ndarray:
        packed = pixels.numpy()[k]
        return np.stack([packed >> shift & 255 for shift in (0, 8, 16)], -1).astype(np.uint8)

    return Tiled(draw, image)


def with_thickness(cloud: fs.SplatCloud) -> np.ndarray:
    return np.column_stack([cloud.scales, np.full(len(cloud), THIN)]).astype(np.float32)


def colors(cloud: fs.SplatCloud) -> np.ndarray:
    return np.asarray(cloud.colors, np.float32)


def main() -> None:
    parser = options(__doc__, repeats=5)
    parser.set_defaults(device=["warp:cpu"])
    next(one for one in parser._actions if one.dest == "device").nargs = "*"
    parser.add_argument("--row", default="few", choices=[*ROWS], help="number of views and splats, size")
    parser.add_argument("--views", type=int, help="another number of views")
    parser.add_argument("--splats", type=int, help="another number of splats")
    parser.add_argument("--side", type=int, help="another width and height in pixels")
    parser.add_argument("--images", help="folder for one image of each renderer")
    given = parser.parse_args()
    row = ROWS[given.row]
    side = (given.side, given.side) if given.side else (row.width, row.height)
    row = replace(row, views=given.views or row.views, splats=given.splats or row.splats)
    row = replace(row, width=side[0], height=side[1])
    focal = row.width / 2 / math.tan(0.5)
    camera = fs.Camera.pinhole(row.width, row.height, focal, focal, row.width / 2, row.height / 2)
    cloud, poses = room(row.splats), arc(row.views)
    warp_device = next((d.removeprefix("warp:") for d in given.device if d.startswith("warp:")), "cpu")
    scene = cloud, camera, poses
    tiled = {
        **{f"{d}, {name}": ours(*scene, d, q) for d in given.device for name, q in QUALITIES.items()},
        "mujoco_warp": mujoco_warp(*scene, warp_device),
        "newton": newton(*scene, warp_device, False),
        "newton, all fragments": newton(*scene, warp_device, True),
    }
    seconds: dict[str, list[float]] = {name: [] for name in tiled}
    for turn in range(given.repeats + 2):  # compiles, then records, then measures
        for name, one in tiled.items():
            with PROGRESS.status(f"{name}, turn {turn}"):
                begun = time.perf_counter()
                one.draw()
            if turn > 1:
                seconds[name].append(time.perf_counter() - begun)
    number = row.views // 3
    at = camera.with_pose(camera_to_world=pose_matrix(poses[number]))
    truth = fs.Renderer("reference").render(cloud, at, quality=TRUTH)["rgb"]
    rows = []
    for name, one in tiled.items():
        image = one.image(number)
        if given.images:
            write_png(
                f"{given.images}/{name.replace(', ', '-').replace(' ', '-').replace(':', '-')}.png", image
            )
        rows.append(
            {"renderer": name, "images_a_second": row.views / float(np.median(seconds[name])),
             "psnr": psnr(image / 255, truth), "views": row.views, "splats": row.splats,
             "width": row.width, "height": row.height} | facts(fs.Renderer(given.device[0]))
        )  # fmt: skip
    if not keep(rows, given.json):
        cells = [(r["renderer"], f"{r['images_a_second']:,.0f}", f"{r['psnr']:.2f} dB") for r in rows]
        title = f"{row.views} views of {row.width} x {row.height}, {row.splats:,} splats"
        show(title, ("renderer", "images a second", "PSNR"), cells)


def pose_matrix(pose: np.ndarray) -> np.ndarray:
    """Matrix (4, 4) of a pose x y z and a quaternion w x y z."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = quaternion_to_matrix(pose[3:]), pose[:3]
    return matrix


if __name__ == "__main__":
    main()
