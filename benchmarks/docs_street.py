"""Make docs/images/street.jpg: a street of `fidsplat store demo --markers 1000`.

python benchmarks/docs_street.py [--splats 2000000]
"""

import math
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
from docs_images import save
from measuring import options

import fidsplat as fs


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--splats", default="2000000", help="of the city")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        city = ["store", "demo", "--splats", arguments.splats, "--markers", "1000", "--views", "0", "--out"]
        subprocess.run([sys.executable, "-m", "fidsplat", *city, f"{folder}/city"], check=True)
        scene = fs.Scene.load(f"{folder}/city/city.toml")
        camera = fs.Camera.look_at(960, 540, math.radians(65), (97.5, -3.0, 20.0), (93.0, -3.5, 60.0))
        rgb = fs.Renderer(arguments.device).render(scene, fs.Capture(camera)).to_uint8()
        sheet = Path(folder) / "street.png"
        cv2.imwrite(str(sheet), rgb[:, :, ::-1])
        save(sheet, "street.jpg")


if __name__ == "__main__":
    main()
