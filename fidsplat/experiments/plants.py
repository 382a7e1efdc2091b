"""Plants from Blender: meshes rendered by Cycles, and splats trained on these images."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.experiments.blender import image_job, ready, run_worker
from fidsplat.formats import save_ply
from fidsplat.formats.colmap import save_colmap
from fidsplat.render.renderer import Renderer
from fidsplat.splats.cloud import SplatCloud
from fidsplat.train import Step, Trainer, TrainSettings, load_dataset
from fidsplat.util.arguments import whole_number
from fidsplat.util.errors import InputError, unknown
from fidsplat.util.files import from_json, read_text, writable_folder, write_json
from fidsplat.util.progress import Progress, no_progress
from fidsplat.util.provenance import code_hash
from fidsplat.worlds.plants import GOLDEN, KINDS, Mesh

BACKGROUND = (0.9, 0.2, 0.9)
"""background colour of training, which no plant has, so that holes are visible"""
WORKER = Path(__file__).with_name("blender_plants.py")
SETTINGS = "plants.json"
HEIGHT, FOCAL = 320, 480.0
"""height and focal length of the images in pixels"""
_LOW, _HIGH = math.radians(-15), math.radians(60)
"""range of camera elevations"""
_MIN_OPACITY = 0.05
"""minimum opacity of trained splats"""


@dataclass(frozen=True)
class PlantSettings:
    """Number and training of plants.

    Raises:
        InputError: numbers out of range, or an unknown kind.
    """

    kind: tuple[str, ...] = ()
    """Kind of plant: tomato, cucumber or lettuce. By default all; repeat for several."""
    each: int = 2
    """Number of plants of a kind."""
    views: int = 24
    """Number of images of each plant to train on."""
    test: int = 4
    """Number of images of each plant to compare with."""
    samples: int = 16
    """Samples per pixel of Blender's Cycles."""
    splats: int = 5000
    """Number of splats of a plant."""
    iterations: int = 1500
    """Training iterations. 0 writes the disks on the mesh without images or training."""
    seed: int = 0
    """Seed of the plants."""

    def __post_init__(self) -> None:
        for kind in self.kind:
            if kind not in KINDS:
                raise InputError(unknown("kind of plant", kind, KINDS))
        ranges = {"each": (1, 1000), "views": (2, 1000), "test": (1, 1000), "samples": (1, 10_000)}
        ranges |= {"splats": (100, 1_000_000), "iterations": (0, 1_000_000), "seed": (0, 2**32 - 1)}
        for name, (low, high) in ranges.items():
            whole_number(f"plants: {name}", getattr(self, name), low, high)

    @property
    def names(self) -> list[tuple[str, int]]:
        """Kind and number of each plant, starting with one of each kind."""
        return [(kind, number) for number in range(self.each) for kind in self.kind or KINDS]

    def mesh(self, kind: str, number: int) -> Mesh:
        return KINDS[kind](np.random.default_rng([self.seed, list(KINDS).index(kind), number]))


def cameras_around(mesh: Mesh, count: int, shift: float = 0.0) -> list[Camera]:
    """Cameras on a spiral around a mesh, from below it to far above.

    shift: 0.5 shifts the cameras by half of their spacing.
    """
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    offsets = mesh.vertices - middle
    radius, side = (float(np.linalg.norm(part, axis=1).max()) for part in (offsets, offsets[:, :2]))
    distance = 1.01 * radius * math.hypot(1, 2 * FOCAL / HEIGHT)  # the bounding sphere fills the image height
    width = min(HEIGHT, 2 * math.ceil(FOCAL * side / (distance - radius)))
    fov = 2 * math.atan(width / 2 / FOCAL)
    cameras = []
    for i in range(count):
        elevation, azimuth = _LOW + (_HIGH - _LOW) * (i + 0.5) / count, GOLDEN * (i + shift)
        flat = math.cos(elevation)
        ray = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
        cameras.append(Camera.look_at(width, HEIGHT, fov, middle + distance * ray, middle, (0, 0, 1)))
    return cameras


def write_plants(
    settings: PlantSettings,
    folder: Path,
    environment: Path,
    device: str | None = None,
    progress: Progress = no_progress,
) -> Iterator[tuple[Path, float | None]]:
    """Make missing plants; yields each PLY file, and the mean PSNR of held-out views if it was trained now.

    Args:
        folder: folder for KIND-NUMBER.ply, and for KIND-NUMBER with the images.
        environment: folder of `fidsplat.experiments.blender.install`.

    Raises:
        InputError: Blender is not installed, or the folder has plants of other settings or sources.
        DeviceError: Blender fails; complete images remain.
    """
    python = ready("standard", environment) if settings.iterations else None
    _record(settings, writable_folder(folder))
    renderer = Renderer(device) if settings.iterations else None
    for done, (kind, number) in enumerate(settings.names):
        file = folder / f"{kind}-{number}.ply"

        def report(step: str, fraction: float, name: str = file.stem, done: int = done) -> None:
            progress(f"{name}: {step}", (done + fraction) / len(settings.names))

        report("mesh", 0.0)
        score = None
        if not file.exists():
            mesh = settings.mesh(kind, number)
            if python is None or renderer is None:
                save_ply(mesh.splats(settings.splats, settings.seed), file)
            else:
                _render(settings, mesh, folder / file.stem, python, report)
                score = _train(settings, mesh, folder / file.stem, file, renderer, report)
        yield file, score


def _record(settings: PlantSettings, folder: Path) -> None:
    """Record the settings in the folder. Raises InputError if other settings are recorded there."""
    file = folder / SETTINGS
    # the numbers of plants may be increased later
    requested = {name: value for name, value in asdict(settings).items() if name not in ("kind", "each")}
    requested["sources"] = code_hash()
    try:
        recorded = from_json(read_text(file)) if file.exists() else requested
    except ValueError as error:
        raise InputError(f"cannot read {file}: {error}; give another folder") from error
    if recorded != requested:
        raise InputError(
            f"plants in {folder} must have the settings {requested}, got {recorded}; give another folder"
        )
    write_json(file, requested)


def _render(settings: PlantSettings, mesh: Mesh, out: Path, python: Path, progress: Progress) -> None:
    """Write the data set of a mesh; existing images are unchanged."""
    sets, images = [], []
    for folder, stem, cameras in (
        (out, "view", cameras_around(mesh, settings.views)),
        (out / "test", "test", cameras_around(mesh, settings.test, 0.5)),
    ):
        names = [f"{stem}-{i:03d}.png" for i in range(len(cameras))]
        sets.append((folder, names, cameras))
        images += [image_job(folder / "images" / name, c) for name, c in zip(names, cameras, strict=True)]
    arrays = {name: getattr(mesh, name).tolist() for name in ("vertices", "quads", "colors")}
    job = {"view": "standard", "samples": settings.samples, "filter": "BOX", "background": 0.9}
    worker = run_worker(python, WORKER, [{"name": out.name, "images": images, **arrays}], job)
    for done, _ in enumerate(worker, 1):
        progress("Blender", 0.5 * done / len(images))
    disks = mesh.splats(settings.splats, settings.seed)
    assert disks.colors is not None  # meshes have plain colours
    points, colors = disks.world_means(), np.rint(255 * disks.colors).astype(np.uint8)
    for folder, names, cameras in sets:
        save_colmap(folder / "sparse" / "0", names, cameras, points, colors)
    write_json(out / "dataset.json", {"background": BACKGROUND, "seed": settings.seed})


def _train(
    settings: PlantSettings, mesh: Mesh, folder: Path, file: Path, renderer: Renderer, progress: Progress
) -> float:
    """Train splats from disks on the mesh and write the visible ones; returns the mean PSNR of test views."""
    training = TrainSettings(
        iterations=settings.iterations,
        seed=settings.seed,
        sh_degree=0,  # copies of plants are rotated, so their colours must not depend on the view
        densify_until=0,
        position_steps=settings.iterations,
    )
    start = mesh.splats(settings.splats, settings.seed)
    trainer = Trainer(load_dataset(folder), renderer, training, folder / "training.npz", start)

    def report(step: Step) -> None:
        progress(f"training, {step.psnr:.1f} dB", 0.5 + 0.5 * step.iteration / settings.iterations)

    trainer.run(report)
    score = float(np.mean([view.psnr for view in trainer.evaluate()]))
    cloud = trainer.cloud()
    assert cloud.sh is not None  # trainers produce SH
    rows = cloud.opacities > _MIN_OPACITY
    arrays = (getattr(cloud, name)[rows] for name in ("means", "quats", "scales", "opacities"))
    save_ply(SplatCloud(*arrays, sh=cloud.sh[rows], origin=cloud.origin), file)
    return score
