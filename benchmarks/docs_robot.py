"""Make the animation of the robot in the README: camera images along an aisle of the greenhouse, detected
tags, and the estimated path, as an animated WebP.

pip install '.[sim,video]' && PYTHONPATH=. python benchmarks/docs_robot.py docs/images/robot.webp
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np

import fidsplat as fs
from fidsplat.experiments.localise import FAMILY, RATE, VARIANTS, Drive
from fidsplat.images.files import write_png
from fidsplat.images.visualize import draw_outlines, resize_to_width
from fidsplat.vision.detect import detect
from fidsplat.worlds.greenhouse import BENCH
from fidsplat.worlds.robot import Run

START, END, FASTER = 23.0, 43.0, 3.0
"""shown seconds of the drive, and the speed-up"""
WIDTH, MAP = 480, 260
"""widths in pixels of the camera image and of the map next to it"""
GROUND, WOOD, TAG = (245, 243, 238), (205, 190, 165), (60, 60, 60)
WAYS = {"as it was": (150, 150, 150), "by wheels and gyroscope": (209, 73, 91), "by tags": (0, 121, 140)}


def main(out: str) -> None:
    """Render the drive and write the file."""
    arguments, whole, renderer = Drive(), Drive().run(), fs.Renderer()
    part = slice(*np.searchsorted(whole.times, (START, END)).tolist())
    run = Run(whole.times[part], whole.poses[part], whole.wheels[part], whole.gyro[part])
    images, detections = [], []
    for image in arguments.images(VARIANTS["exact"], run, renderer):
        codes = detect(image, (FAMILY,), qr=False)
        marks = [(code.corners, str(code.id)) for code in codes]
        images.append(resize_to_width(draw_outlines(image, marks, thickness=2, size=0.6), WIDTH))
        detections.append(codes)
        print(f"{len(images)} of {len(arguments.image_indices(run))}", end="\r", file=sys.stderr)
    paths = [
        run.poses,
        *(arguments.localise(run, found, arguments.camera)[0].poses for found in (None, detections)),
    ]
    with tempfile.TemporaryDirectory() as folder:
        for number, (image, k) in enumerate(zip(images, arguments.image_indices(run).tolist(), strict=True)):
            sheet = floor_plan(arguments, [way[: k + 1, :2, 3] for way in paths], image.shape[0])
            write_png(Path(folder) / f"{number:06d}.png", np.concatenate([image, sheet], axis=1))
        words = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]
        words += ["-framerate", str(FASTER * RATE), "-i", f"{folder}/%06d.png"]
        subprocess.run([*words, "-c:v", "libwebp_anim", "-quality", "55", "-loop", "0", out], check=True)


def floor_plan(arguments: Drive, paths: list[np.ndarray], height: int) -> np.ndarray:
    """Map of the greenhouse with the paths (n, 2) [m] so far, (height, MAP, 3) uint8; x is up."""
    house = arguments.house
    sheet = np.full((height, MAP, 3), GROUND, np.uint8)
    scale = min((height - 90) / (house.length + 2), MAP / (house.row_positions[-1] + 2))

    def pixel(x: float, y: float) -> tuple[int, int]:
        return round(MAP / 2 + (house.row_positions[-1] / 2 - y) * scale), round(
            height - 70 - (x + 1) * scale
        )

    for y in house.row_positions:
        half = BENCH[0] / 2
        cv2.rectangle(sheet, pixel(0, y + half), pixel(house.length, y - half), WOOD, -1)
    for tag in arguments.tags.values():
        cv2.circle(sheet, pixel(*tag.pose[:2, 3]), 2, TAG, -1, cv2.LINE_AA)
    for number, ((name, color), way) in enumerate(zip(WAYS.items(), paths, strict=True)):
        points = np.array([pixel(x, y) for x, y in way[::5]], np.int32)
        cv2.polylines(sheet, [points], False, color, 4 if number == 0 else 1, cv2.LINE_AA)
        foot = height - 44 + 16 * number
        cv2.line(sheet, (12, foot - 4), (34, foot - 4), color, 3)
        cv2.putText(sheet, name, (42, foot), cv2.FONT_HERSHEY_SIMPLEX, 0.42, TAG, 1, cv2.LINE_AA)
    cv2.circle(sheet, pixel(*paths[0][-1]), 4, TAG, -1, cv2.LINE_AA)
    return sheet


if __name__ == "__main__":
    main(*sys.argv[1:])
