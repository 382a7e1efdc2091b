"""Measure the viewer while the camera moves: frames per second, their size, and the latency from a new
viewpoint to its JPEG.

A simulated browser rotates its view of the random splats of `fidsplat bench` after each frame, and receives
the JPEG of the page, which is encoded while the next frame is rendered. `rendered` is the time until the
bytes are on the host. CPU time is of one frame, over all cores.

    PYTHONPATH=. python benchmarks/viewer.py
    PYTHONPATH=. python benchmarks/viewer.py --device opencl:nvidia --splats 1000000 --size 1920 1080
"""

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import fidsplat as fs
from fidsplat.images.files import encode_image
from fidsplat.scenes.random_clouds import SCENES, random_cloud, standard_camera
from fidsplat.splats.rotations import matrix_to_quaternion
from fidsplat.viewer.server import JPEG
from fidsplat.viewer.session import Session
from fidsplat.viewer.settings import Viewpoint
from fidsplat.viewer.stream import Stream

STEP, SWING = 0.01, 0.3
"""radians: rotation between frames, and amplitude of the oscillation, which keeps the splats visible"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device")
    parser.add_argument("--splats", type=int, default=150_000)
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 720), metavar=("W", "H"))
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rate", type=float, nargs="+", default=[15.0, 30.0])
    words = parser.parse_args()
    width, height = words.size
    camera = standard_camera(width, height)
    scene = fs.Scene([random_cloud(words.splats, SCENES["r100k_720p"].median_scale)], camera=camera)
    session = Session(scene, words.device)
    pose = np.linalg.inv(camera.world_to_camera)
    start = Viewpoint(
        tuple(pose[:3, 3].tolist()),
        tuple(matrix_to_quaternion(pose[:3, :3]).tolist()),
        2 * math.atan(height / 2 / camera.fy),
        width,
        height,
    )
    title = session.state.renderer.device.title
    print(f"{words.splats:,} splats, {width} x {height}, {title}")
    print(
        "| aim | frames a second | scale | drag to JPEG, median | 95 % | rendered | JPEG | CPU time | size "
        "| exact frame |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for rate in words.rate:
        print(measured(session, start, rate, words.seconds))
    session.close()


def measured(session: Session, start: Viewpoint, rate: float, seconds: float) -> str:
    """Measure a row of the table for a frame rate."""
    latencies, sizes, scales, rendering, encoding, arguments = [], [], [], [], [], 0.0

    def moving(viewpoint: Viewpoint, scale: float) -> Callable[[], None]:
        begun = arguments
        image = session.render_moving(viewpoint, scale).to_uint8()
        rendering.append(time.perf_counter() - begun)

        def send() -> None:
            taken = time.perf_counter()
            sizes.append(len(encode_image(image, "jpeg", JPEG)))
            scales.append(scale)
            encoding.append(time.perf_counter() - taken)
            latencies.append(time.perf_counter() - begun)

        return send

    def rest(viewpoint: Viewpoint) -> None:
        encode_image(session.render(viewpoint).frame.to_uint8(), "png")

    stream = Stream(moving, rest, rate=rate)
    for warm in range(10):  # the scale converges
        stream.set_viewpoint(rotated(start, -STEP * (warm + 1)))
        arguments = time.perf_counter()
        stream.step()
    del latencies[:], sizes[:], scales[:], rendering[:], encoding[:]
    begun, worked = time.perf_counter(), time.process_time()
    while time.perf_counter() - begun < seconds:
        stream.set_viewpoint(rotated(start, SWING * math.sin(STEP / SWING * len(rendering))))
        arguments = time.perf_counter()
        stream.step()
    fps = len(rendering) / (time.perf_counter() - begun)
    work = 1e3 * (time.process_time() - worked) / len(rendering)
    begun = time.perf_counter()
    rest(start)
    exact = time.perf_counter() - begun
    middle, late = 1e3 * np.percentile(latencies, (50, 95))
    return (
        f"| {rate:g} | {fps:.1f} | {np.median(scales):.2f} | {middle:.1f} ms | {late:.1f} ms "
        f"| {1e3 * np.median(rendering):.1f} ms | {1e3 * np.median(encoding):.1f} ms | {work:.0f} ms "
        f"| {np.median(sizes) / 1e3:.0f} kB | {1e3 * exact:.0f} ms |"
    )


def rotated(start: Viewpoint, angle: float) -> Viewpoint:
    """The viewpoint rotated by an angle about the page's vertical."""
    about_vertical = np.eye(3)
    about_vertical[0, 0] = about_vertical[2, 2] = math.cos(angle)
    about_vertical[0, 2], about_vertical[2, 0] = math.sin(angle), -math.sin(angle)
    rotation = start.pose[:3, :3] @ about_vertical
    return replace(start, quaternion=tuple(matrix_to_quaternion(rotation).tolist()))


if __name__ == "__main__":
    main()
