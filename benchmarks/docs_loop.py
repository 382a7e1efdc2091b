"""Make the animation of the README: a flight past the markers of the demo, as a WebP file.

pip install '.[video]' && PYTHONPATH=. python benchmarks/docs_loop.py docs/images/flight.webp
"""

import math
import subprocess
import sys
import tempfile
from dataclasses import replace

import imageio_ffmpeg
import numpy as np

import fidsplat as fs
from fidsplat.render.flight import Flight, FlightFolder
from fidsplat.worlds.yard import demo_scene

WIDTH, HEIGHT, RATE = 480, 270, 16.0
AIM = (0.0, 0.05, 0.0)
WAY = ((-35, 2.4, -0.25), (-12, 1.7, -0.05), (12, 1.9, -0.15), (35, 2.3, -0.3))
"""degrees to the side, metres away, metres down, of a closed path"""


def main(out: str) -> None:
    """Render the flight and write the file."""
    scene, poses = demo_scene(), []
    for degrees, away, down in (*WAY, *WAY[-2::-1]):
        angle = math.radians(degrees)
        place = (away * math.sin(angle), down, -away * math.cos(angle))
        poses.append(fs.Camera.look_at(WIDTH, HEIGHT, 1.0, place, AIM).world_to_camera)
    path = fs.Trajectory(np.arange(len(poses)) * 0.75, np.array(poses), smooth=True).inverse()
    camera = fs.Camera.look_at(WIDTH, HEIGHT, math.radians(60.0), (0, 0, -2), (0, 0, 0))
    scene = replace(scene, camera=camera, outputs=("rgb",))
    flight = Flight(scene, path, path.sampled(RATE).times[:-1], scene.capture)
    with tempfile.TemporaryDirectory() as folder:
        renderer = fs.Renderer()
        frames = FlightFolder(folder, flight, renderer.device.title)
        for number in frames.render(renderer):
            print(f"{number + 1} of {len(flight)}", end="\r", file=sys.stderr)
        words = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-framerate", str(RATE)]
        words += ["-i", f"{folder}/rgb/%06d.png", "-c:v", "libwebp_anim", "-quality", "60", "-loop", "0", out]
        subprocess.run(words, check=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
