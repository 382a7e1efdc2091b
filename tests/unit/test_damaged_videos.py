"""Damaged videos: frames or one error, and no lines of FFmpeg's threads."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

READ = """import sys
import fidsplat as fs
from fidsplat.images.files import read_images
for path in sys.argv[1:]:
    try:
        print(sum(1 for _ in read_images(path)))
    except fs.InputError as error:
        print("refused", len(str(error).splitlines()))
"""


@pytest.mark.parametrize(("suffix", "codec"), [(".mp4", "mp4v"), (".avi", "XVID"), (".avi", "MJPG")])
def test_damaged_videos_print_nothing(tmp_path, suffix, codec):
    random = np.random.default_rng(0)
    whole = tmp_path / f"whole{suffix}"
    video = cv2.VideoWriter(str(whole), cv2.VideoWriter_fourcc(*codec), 10, (64, 48))
    if not video.isOpened():
        pytest.skip(f"OpenCV cannot write {codec}")
    for _ in range(6):
        video.write(random.integers(0, 256, (48, 64, 3)).astype(np.uint8))
    video.release()
    content, paths = whole.read_bytes(), []
    for k in range(30):
        data = bytearray(content)
        for at in random.integers(0 if k % 2 else len(data) // 3, len(data), 20):
            data[at] = random.integers(256)
        if k % 5 == 0:
            del data[random.integers(len(data)) :]
        paths.append(tmp_path / f"{k}{suffix}")
        paths[-1].write_bytes(data)
    done = subprocess.run(
        [sys.executable, "-c", READ, str(whole), *map(str, paths)],
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert lines[0] == "6"
    assert len(lines) == 31
    assert all(line in ("0", "1", "2", "3", "4", "5", "6", "refused 1") for line in lines)
