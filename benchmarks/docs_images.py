"""Make images of the docs: docs/images/demo.jpg and captured.jpg, and with a captured scene real-scene.jpg
and ellipsoids.jpg.

python benchmarks/docs_images.py [biker.compressed.ply]
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2

HERE = Path(__file__).resolve().parent
IMAGES = HERE.parent / "docs" / "images"


def save(sheet: Path, name: str) -> None:
    """Write a JPEG without chroma subsampling, so that edges of markers stay sharp."""
    image = cv2.imread(str(sheet))
    assert image is not None
    options = [
        cv2.IMWRITE_JPEG_QUALITY,
        85,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]
    cv2.imwrite(str(IMAGES / name), image, options)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(
            [sys.executable, "-m", "fidsplat", "demo", "--captured", "playbot", "--out", folder], check=True
        )
        save(Path(folder) / "contact-sheet.png", "demo.jpg")
        save(Path(folder) / "playbot.png", "captured.jpg")
        for scene in sys.argv[1:]:
            script = str(HERE / "real_scene.py")
            subprocess.run([sys.executable, script, scene, "-o", folder], check=True)
            save(Path(folder) / "sheet.png", "real-scene.jpg")
            save(Path(folder) / "ways.png", "ellipsoids.jpg")


if __name__ == "__main__":
    main()
