"""Makes the pictures of the pages anew: docs/images/demo.jpg, and real-scene.jpg when a captured scene is
given.

python benchmarks/docs_images.py [biker.compressed.ply]
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2

HERE = Path(__file__).resolve().parent
IMAGES = HERE.parent / "docs" / "images"


def save(sheet: Path, name: str, width: int) -> None:
    image = cv2.imread(str(sheet))
    assert image is not None
    height = round(image.shape[0] * width / image.shape[1])
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(IMAGES / name), small, [cv2.IMWRITE_JPEG_QUALITY, 88])


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "fidsplat.cli", "demo", "--out", folder], check=True)
        save(Path(folder) / "contact-sheet.png", "demo.jpg", 1600)
        for scene in sys.argv[1:]:
            script = str(HERE / "real_scene.py")
            subprocess.run([sys.executable, script, scene, "-o", folder], check=True)
            save(Path(folder) / "sheet.png", "real-scene.jpg", 1224)


if __name__ == "__main__":
    main()
