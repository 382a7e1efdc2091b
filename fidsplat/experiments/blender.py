"""Ground truth from Blender as in the paper: Cycles renders a textured plane.

`bpy` runs in a separate process and environment, since it requires Python 3.11 and NumPy below 2, and has the
GPL.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from fidsplat.cameras import Camera
from fidsplat.experiments.setup import BACKGROUND, PROTOCOLS, Category, novel_cameras, training_cameras
from fidsplat.markers import marker
from fidsplat.util import interrupts
from fidsplat.util.errors import DeviceError, InputError, unknown
from fidsplat.util.files import from_json, read_text, user_cache, writable_folder, write_json

BPY = "bpy==5.0.1"
VIEW_NAMES = ("standard", "raw")
"""`standard`: sRGB texture and the view transform 'Standard', so that pixels average linear light, probably
as in the paper; `raw`: pixels average display values"""
FULL_SAMPLES = 64
WORKER = Path(__file__).with_name("blender_worker.py")
TEST, TRAINING = "test", "view"
"""prefixes of image files of test and training views"""


def image_file(folder: Path, view: str, category: str, index: int, kind: str, number: int) -> Path:
    """Path of an image of a marker. kind: `TEST`, or `TRAINING` (the largest training set); number: index
    of the image in its kind."""
    return folder / view / f"{category}-{index}" / f"{kind}-{number:02d}.png"


def check_images(folder: Path, view: str, seed: int, samples: int | None = None) -> dict:
    """Recorded settings of the images of a view transform; {} if unknown.

    Raises InputError for another seed or number of samples (None: any).
    """
    file = _settings_file(folder, view)
    if not file.exists():
        return {}
    try:
        settings = from_json(read_text(file))
    except ValueError as error:
        raise InputError(f"cannot read {file}: {error}; render into another folder") from error
    for name, expected in (("seed", seed), ("samples", samples)):
        if expected is not None and settings.get(name) != expected:
            raise InputError(
                f"images in {folder / view} must have {name} {expected}, got {settings.get(name)}; give "
                "another folder"
            )
    return settings


def record_images(folder: Path, view: str, seed: int, samples: int) -> None:
    """Record the settings of the images of a view transform. Raises InputError if others are recorded."""
    check_images(folder, view, seed, samples)
    writable_folder(folder / view)
    write_json(_settings_file(folder, view), {"seed": seed, "samples": samples})


def _settings_file(folder: Path, view: str) -> Path:
    return folder / view / "drawn-with.json"


def default_environment() -> Path:
    """Default folder of the Blender environment, in the user's cache."""
    return user_cache() / "fidsplat" / "blender"


def install(environment: Path, progress: Callable[[str], None] = lambda text: None) -> Path:
    """Make a virtual environment with bpy, about 1 GB; returns its Python interpreter.

    Raises InputError without Python 3.11, DeviceError if pip fails.
    """
    python = sys.executable if sys.version_info[:2] == (3, 11) else shutil.which("python3.11")
    if python is None:
        raise InputError(f"python3.11 must be on the path for {BPY}, got none; install Python 3.11")
    writable_folder(environment.parent)
    interpreter = environment_python(environment)
    for text, command in (
        (f"making the environment {environment}", [python, "-m", "venv", "--clear", str(environment)]),
        (
            f"installing {BPY}, about 400 MB",
            [str(interpreter), "-m", "pip", "install", "--quiet", BPY, "numpy<2"],
        ),
        ("first start", [str(interpreter), "-c", "import bpy"]),
    ):
        progress(text)
        _call(command)
    return interpreter


def environment_python(environment: Path) -> Path:
    """Python interpreter of a virtual environment."""
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def _call(command: list[str]) -> None:
    done = interrupts.run(command)
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines() or ["no message"]
        raise DeviceError(
            f"installing Blender failed at '{' '.join(command[1:4])}': {lines[-1]}; check the network and "
            "the free disk space, then run the command again"
        )


def marker_job(category: Category, index: int, seed: int, folder: Path, view: str, training: bool) -> dict:
    """Worker job for a marker's test images, and optionally its training images."""
    grid = marker(category.spec(index, seed)).grid
    cameras = {TEST: novel_cameras(category, index, seed), TRAINING: training_cameras() if training else []}
    return {
        "name": f"{category.name}-{index}",
        "grid": grid.tolist(),
        "module": PROTOCOLS["fixed-plane"].module(grid.shape[0]),
        "images": [
            image_job(image_file(folder, view, category.name, index, kind, i), camera)
            for kind, cameras_of_kind in cameras.items()
            for i, camera in enumerate(cameras_of_kind)
        ],
    }


def image_job(file: Path, camera: Camera) -> dict:
    """File and camera of an image for a worker. Raises InputError unless the pixels are square."""
    if camera.fx != camera.fy:
        raise InputError(
            f"fx and fy of a Blender camera must be equal, got {camera.fx:g} and {camera.fy:g}; use "
            "square pixels"
        )
    facts = {name: getattr(camera, name) for name in ("width", "height", "fx", "cx", "cy")}
    return {"file": str(file.absolute()), **facts, "matrix": camera.world_to_camera.tolist()}


def ready(view: str, environment: Path) -> Path:
    """Python interpreter with Blender. Raises InputError for an unknown view, or if Blender is missing."""
    if view not in VIEW_NAMES:
        raise InputError(unknown("view", view, VIEW_NAMES))
    python = environment_python(environment)
    if not python.is_file():
        raise InputError(
            f"Blender must be installed in {environment}, got none; run fidsplat experiment blender --install"
        )
    return python


def render(
    markers: Iterable[dict],
    view: str,
    environment: Path,
    samples: int = FULL_SAMPLES,
    pixel_filter: str = "BOX",
    threads: int | None = None,
) -> Iterator[Path]:
    """Render missing images; yields each complete file, existing files first.

    Args:
        markers: jobs of `marker_job`.
        view: one of `VIEW_NAMES`.
        environment: folder of `install`.
        samples: samples per pixel.
        pixel_filter: "BOX" (1 px, a mean over the pixel) or "BLACKMAN_HARRIS" (Blender's default, 1.5 px).
        threads: threads of Cycles; by default one per core.

    Raises InputError if Blender is not installed, DeviceError if it fails; complete images remain.
    """
    job = {"view": view, "samples": samples, "filter": pixel_filter, "background": BACKGROUND}
    yield from run_worker(ready(view, environment), WORKER, markers, job, threads)


def run_worker(
    python: Path, worker: Path, objects: Iterable[dict], job: dict, threads: int | None = None
) -> Iterator[Path]:
    """Render missing images of objects with a worker; yields each complete file, existing files first.

    Raises DeviceError if Blender fails; complete images remain.
    """
    missing = []
    for item in objects:
        existing = [image["file"] for image in item["images"] if Path(image["file"]).is_file()]
        yield from map(Path, existing)
        left = [image for image in item["images"] if image["file"] not in existing]
        if left:
            missing.append({**item, "images": left})
    if not missing:
        return
    for folder in {Path(image["file"]).parent for item in missing for image in item["images"]}:
        writable_folder(folder)
    with tempfile.TemporaryDirectory() as work:
        file, log = Path(work) / "job.json", Path(work) / "stderr.txt"
        job = {**job, "threads": threads or os.cpu_count() or 1, "objects": missing}
        write_json(file, job)
        environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
        with open(log, "wb") as errors:
            process = subprocess.Popen(
                [str(python), str(worker), str(file)],
                stdout=subprocess.PIPE, stderr=errors, env=environment,
            )  # fmt: skip
            try:
                assert process.stdout is not None
                for line in interrupts.lines_of(process.stdout):
                    if line.startswith("done "):  # skip Blender's own lines
                        yield Path(line.removeprefix("done "))
                status = process.wait()
            finally:
                if process.poll() is None:
                    process.terminate()
                    process.wait()
        if status:
            lines = log.read_text("utf-8", "replace").strip().splitlines() or ["no message"]
            raise DeviceError(
                f"Blender stopped with status {status}: {lines[-1]}; run the command again to render the rest"
            )
