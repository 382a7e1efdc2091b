"""Make the image of docs/from-photographs.md: a photograph, the trained scene from its camera, a robot's
image.

python benchmarks/photographs.py -o /tmp/photographs --up
fidsplat train /tmp/photographs/scene -o /tmp/photographs/scene/splats.ply
python benchmarks/docs_photographs.py /tmp/photographs/scene docs/images/from-photographs.jpg
"""

import re
import runpy
import sys
import tempfile
from pathlib import Path

import numpy as np

import fidsplat as fs
from fidsplat.images.files import encode_image, read_image, to_uint8
from fidsplat.images.visualize import resize_to_width, write

WIDTH, VIEW = 400, 7
PAGE = Path(__file__).resolve().parents[1] / "docs" / "from-photographs.md"


def robot_image(scene: Path) -> np.ndarray:
    """Image that the page's MuJoCo program renders."""
    found = re.search(r"```python\n(import mujoco.*?)```", PAGE.read_text(), re.DOTALL)
    assert found is not None
    with tempfile.TemporaryDirectory() as folder:
        image, script = Path(folder, "eye.png"), Path(folder, "robot.py")
        program = found[1].replace("bench/scene.toml", str(scene)).replace('"eye.png"', repr(str(image)))
        script.write_text(program)
        runpy.run_path(str(script))
        return read_image(image)


def main() -> None:
    """Write the image."""
    folder, target = Path(sys.argv[1]), Path(sys.argv[2])
    cameras = fs.load_cameras(folder / "sparse" / "0")
    name = sorted(cameras)[VIEW]
    frame = fs.Renderer().render(fs.Scene.load(folder / "scene.toml"), fs.Capture(cameras[name]))
    panels = {
        "photograph": read_image(folder / "work" / "photos" / name),
        "trained scene, exact markers": to_uint8(frame["rgb"]),
        "a robot's camera in MuJoCo": robot_image(folder / "scene.toml"),
    }
    images = []
    for words, image in panels.items():
        images.append(resize_to_width(image, WIDTH))
        write(images[-1], words, (10, images[-1].shape[0] - 10))
    target.write_bytes(encode_image(np.concatenate(images, axis=1), "jpeg", 88))


if __name__ == "__main__":
    main()
