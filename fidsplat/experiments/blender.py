"""Ground truth from Blender as in the paper: Cycles renders a textured plane, by `bpy` in a separate process
and environment (bpy needs Python 3.11 and NumPy below 2, and has the GPL)."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from fidsplat.cameras import Camera
from fidsplat.experiments.methods import plain_marker
from fidsplat.experiments.setup import (
    BACKGROUND,
    COLLECTIONS,
    PROTOCOLS,
    Category,
    novel_cameras,
    training_cameras,
)
from fidsplat.util import interrupts
from fidsplat.util.errors import DeviceError, InputError
from fidsplat.util.files import atomic_write, from_json, read_text, user_cache, writable_folder

BPY = "bpy==5.0.1"
VIEW_NAMES = ("standard", "raw")
"""`standard`: sRGB texture, linear light, the 'Standard' view, probably as in the paper; `raw`: display
values, so edges are means of displayed values"""
FULL_SAMPLES = 64
WORKER = Path(__file__).with_name("blender_worker.py")


def novel_image(folder: Path, view: str, category: str, index: int, number: int) -> Path:
    """File of a test view."""
    return folder / view / f"{category}-{index}" / f"test-{number:02d}.png"


def training_image(folder: Path, view: str, category: str, index: int, number: int) -> Path:
    """File of a training view of the densest collection."""
    return folder / view / f"{category}-{index}" / f"view-{number:02d}.png"


def check_images(folder: Path, view: str, seed: int, samples: int | None = None) -> dict:
    """Settings of the images of a view; {} if unknown.

    Raises InputError for another seed or number of samples (None: any).
    """
    if not _note(folder, view).exists():
        return {}
    try:
        about = from_json(read_text(_note(folder, view)))
    except ValueError as error:
        raise InputError(f"cannot read {_note(folder, view)}: {error}") from error
    for name, wanted in (("seed", seed), ("samples", samples)):
        if wanted is not None and about.get(name) != wanted:
            raise InputError(
                f"{folder / view} holds images of {name} {about.get(name)}, not {wanted}; give another folder"
            )
    return about


def record_images(folder: Path, view: str, seed: int, samples: int) -> None:
    """Record the settings of the images of a view. Raises InputError for other settings."""
    check_images(folder, view, seed, samples)
    writable_folder(folder / view)
    with atomic_write(_note(folder, view)) as stream:
        stream.write(json.dumps({"seed": seed, "samples": samples}).encode())


def _note(folder: Path, view: str) -> Path:
    return folder / view / "drawn-with.json"


def default_environment() -> Path:
    """Default folder of the Blender environment, in the user's cache."""
    return user_cache() / "fidsplat" / "blender"


def install(environment: Path, progress: Callable[[str], None] = lambda text: None) -> Path:
    """Make a virtual environment with bpy, about 1 GB; returns its Python.

    Raises InputError when there is no Python 3.11, DeviceError when pip fails.
    """
    python = sys.executable if sys.version_info[:2] == (3, 11) else shutil.which("python3.11")
    if python is None:
        raise InputError(f"{BPY} needs Python 3.11, and python3.11 is not on the path; install it first")
    writable_folder(environment.parent)
    progress(f"making the environment {environment}")
    _call([python, "-m", "venv", "--clear", str(environment)])
    own = environment_python(environment)
    progress(f"installing {BPY}, about 400 MB to fetch")
    _call([str(own), "-m", "pip", "install", "--quiet", BPY, "numpy<2"])
    progress("starting it once")
    _call([str(own), "-c", "import bpy"])
    return own


def environment_python(environment: Path) -> Path:
    """Python interpreter of a virtual environment."""
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def _call(command: list[str]) -> None:
    done = interrupts.run(command)
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines() or ["no message"]
        raise DeviceError(f"installing Blender failed at '{' '.join(command[1:4])}': {lines[-1]}")


def marker_job(category: Category, index: int, seed: int, folder: Path, view: str, training: bool) -> dict:
    """Worker job for the test views of a marker, and optionally its training views."""
    grid = plain_marker(category.spec(index, seed)).grid
    shots = [
        (novel_image(folder, view, category.name, index, i), camera)
        for i, camera in enumerate(novel_cameras(category, index, seed))
    ]
    if training:
        shots += [
            (training_image(folder, view, category.name, index, i), camera)
            for i, camera in enumerate(training_cameras(COLLECTIONS[-1]))
        ]
    return {
        "name": f"{category.name}-{index}",
        "grid": grid.tolist(),
        "module": PROTOCOLS["fixed-plane"].module(grid.shape[0]),
        "shots": [{"file": str(file.absolute()), **camera_facts(camera)} for file, camera in shots],
    }


def ready(view: str, environment: Path) -> Path:
    """Python interpreter with Blender. Raises InputError for an unknown view or without Blender."""
    if view not in VIEW_NAMES:
        raise InputError(f"unknown view {view!r}; known: {', '.join(VIEW_NAMES)}")
    python = environment_python(environment)
    if not python.is_file():
        raise InputError(
            f"Blender is not installed in {environment}; run fidsplat experiment blender --install"
        )
    return python


def camera_facts(camera: Camera) -> dict:
    """Camera of a worker job. Raises InputError unless its pixels are square."""
    if camera.fx != camera.fy:
        raise InputError("fx and fy of a Blender camera must be equal")
    names = ("width", "height", "fx", "cx", "cy")
    return {name: getattr(camera, name) for name in names} | {"matrix": camera.world_to_camera.tolist()}


def render(
    markers: Iterable[dict],
    view: str,
    environment: Path,
    samples: int = FULL_SAMPLES,
    pixel_filter: str = "BOX",
    threads: int | None = None,
) -> Iterator[Path]:
    """Render missing images; yields each file when it is done, existing ones first.

    Args:
        markers: jobs of `marker_job`.
        view: one of `VIEW_NAMES`.
        environment: folder of `install`.
        samples: per pixel.
        pixel_filter: "BOX" (1 px, a mean over the pixel) or "BLACKMAN_HARRIS" (Blender's default, 1.5 px).
        threads: of Cycles; all by default.

    Raises InputError when Blender is not installed, DeviceError if it fails; finished images stay.
    """
    python = ready(view, environment)
    job = {
        "view": view,
        "samples": samples,
        "filter": pixel_filter,
        "threads": threads or os.cpu_count() or 1,
        "background": BACKGROUND,
    }
    yield from drawn(python, WORKER, markers, job)


def drawn(python: Path, worker: Path, things: Iterable[dict], job: dict) -> Iterator[Path]:
    """Render the missing images of some objects with a worker; yields each file when it is done, existing
    ones first. Raises DeviceError if Blender fails; finished images stay."""
    missing = []
    for thing in things:
        there = [Path(shot["file"]) for shot in thing["shots"] if Path(shot["file"]).is_file()]
        yield from there
        left = [shot for shot in thing["shots"] if Path(shot["file"]) not in there]
        if left:
            missing.append({**thing, "shots": left})
    if not missing:
        return
    for folder in {Path(shot["file"]).parent for thing in missing for shot in thing["shots"]}:
        writable_folder(folder)
    with tempfile.TemporaryDirectory() as work:
        file = Path(work) / "job.json"
        file.write_text(json.dumps({**job, "things": missing}), "utf-8")
        log = Path(work) / "stderr.txt"
        with open(log, "wb") as errors:
            process = subprocess.Popen(
                [str(python), str(worker), str(file)],
                stdout=subprocess.PIPE, stderr=errors, env=_clean_environment(),
            )  # fmt: skip
            try:
                assert process.stdout is not None
                for line in interrupts.lines_of(process.stdout):
                    if line.startswith("done "):  # other output of Blender
                        yield Path(line.removeprefix("done "))
                status = process.wait()
            finally:
                if process.poll() is None:
                    process.terminate()
                    process.wait()
        if status:
            lines = log.read_text("utf-8", "replace").strip().splitlines() or ["no message"]
            raise DeviceError(f"Blender stopped with status {status}: {lines[-1]}")


def _clean_environment() -> dict[str, str]:
    """Environment variables without Python paths."""
    return {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
