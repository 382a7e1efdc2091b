"""Plants from Blender: meshes rendered by Cycles from many poses, and splats trained on the images, starting
from disks on the mesh."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.experiments.blender import camera_facts, drawn, ready
from fidsplat.formats import save_ply
from fidsplat.formats.colmap import save_colmap
from fidsplat.render.renderer import Renderer
from fidsplat.splats.cloud import SplatCloud
from fidsplat.train import Step, Trainer, TrainSettings, load_dataset
from fidsplat.util.arguments import whole_number
from fidsplat.util.errors import InputError, unknown
from fidsplat.util.files import atomic_write, from_json, read_text, writable_folder
from fidsplat.util.provenance import code_hash
from fidsplat.worlds.plants import GOLDEN, KINDS, Mesh

BACKGROUND = (0.9, 0.2, 0.9)
"""background of training, a colour that no plant has, so that holes are visible"""
WORKER = Path(__file__).with_name("blender_plants.py")
NOTE = "plants.json"
HEIGHT, FOCAL = 320, 480.0
"""height and focal length of the images in pixels"""
_LOW, _HIGH = math.radians(-15), math.radians(60)
"""range of camera elevations"""
_FAINT = 0.05
"""minimum opacity of trained splats"""
Tell = Callable[[str, float], None]


@dataclass(frozen=True)
class PlantSettings:
    """Number and training of plants. Raises InputError for numbers out of range, or an unknown kind."""

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
        for name, (least, most) in ranges.items():
            whole_number(f"plants: {name}", getattr(self, name), least, most)

    @property
    def names(self) -> list[tuple[str, int]]:
        """Kind and number of each plant, one of each kind first."""
        return [(kind, number) for number in range(self.each) for kind in self.kind or KINDS]

    def mesh(self, kind: str, number: int) -> Mesh:
        """Mesh of a plant."""
        return KINDS[kind](np.random.default_rng([self.seed, list(KINDS).index(kind), number]))


def cameras_around(mesh: Mesh, count: int, shift: float = 0.0) -> list[Camera]:
    """Cameras on a spiral around a plant, from below to far above; shift moves them between those of shift
    0."""
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    off = mesh.vertices - middle
    reach, aside = (float(np.linalg.norm(part, axis=1).max()) for part in (off, off[:, :2]))
    away = 1.01 * reach * math.hypot(1, 2 * FOCAL / HEIGHT)  # its bounding sphere fills the height
    width = min(HEIGHT, 2 * math.ceil(FOCAL * aside / (away - reach)))
    found = []
    for i in range(count):
        rise = _LOW + (_HIGH - _LOW) * (i + 0.5) / count
        turn = GOLDEN * (i + shift)
        ray = np.array([math.cos(rise) * math.cos(turn), math.cos(rise) * math.sin(turn), math.sin(rise)])
        fov = 2 * math.atan(width / 2 / FOCAL)
        found.append(Camera.look_at(width, HEIGHT, fov, middle + away * ray, middle, (0, 0, 1)))
    return found


def write_plants(
    wanted: PlantSettings,
    folder: Path,
    environment: Path,
    device: str | None = None,
    tell: Tell = lambda words, share: None,
) -> Iterator[tuple[Path, float | None]]:
    """Make missing plants: yields each PLY file, and the mean PSNR of held-out views if it was trained now.

    Args:
        folder: for KIND-NUMBER.ply, and folders KIND-NUMBER of images.
        environment: of `fidsplat.experiments.blender.install`.
        tell: called with the step and the completed share.

    Raises:
        InputError: Blender is not installed, or the folder holds plants of other numbers or sources.
        DeviceError: Blender fails; finished images stay.
    """
    python = ready("standard", environment) if wanted.iterations else None
    _note(wanted, writable_folder(folder))
    renderer = Renderer(device) if wanted.iterations else None
    for done, (kind, number) in enumerate(wanted.names):
        file = folder / f"{kind}-{number}.ply"

        def part(words: str, share: float, name: str = file.stem, done: int = done) -> None:
            tell(f"{name}: {words}", (done + share) / len(wanted.names))

        part("mesh", 0.0)
        score = None
        if not file.exists():
            mesh = wanted.mesh(kind, number)
            if python is None or renderer is None:
                save_ply(mesh.splats(wanted.splats, wanted.seed), file)
            else:
                place = folder / file.stem
                _draw(wanted, mesh, place, python, part)
                score = _train(wanted, mesh, place, file, renderer, part)
        yield file, score


def _note(wanted: PlantSettings, folder: Path) -> None:
    """Check and record the settings of the plants of a folder."""
    file = folder / NOTE
    # plants may be added later
    own = {name: value for name, value in asdict(wanted).items() if name not in ("kind", "each")}
    own["sources"] = code_hash()
    try:
        before = from_json(read_text(file)) if file.exists() else own
    except ValueError as error:
        raise InputError(f"cannot read {file}: {error}") from error
    if before != own:
        raise InputError(f"{folder} holds plants of {before}, not {own}; give another folder")
    with atomic_write(file) as stream:
        stream.write(json.dumps(own).encode())


def _draw(wanted: PlantSettings, mesh: Mesh, place: Path, python: Path, tell: Tell) -> None:
    """Write the data set of a plant; existing images stay."""
    views, shots = [], []
    for folder, stem, cameras in (
        (place, "view", cameras_around(mesh, wanted.views)),
        (place / "test", "test", cameras_around(mesh, wanted.test, 0.5)),
    ):
        names = [f"{stem}-{i:03d}.png" for i in range(len(cameras))]
        views.append((folder, names, cameras))
        files = [str((folder / "images" / name).absolute()) for name in names]
        shots += [{"file": f, **camera_facts(c)} for f, c in zip(files, cameras, strict=True)]
    plant = {
        "name": place.name,
        "vertices": mesh.vertices.tolist(),
        "quads": mesh.quads.tolist(),
        "colors": mesh.colors.tolist(),
        "shots": shots,
    }
    job = {
        "view": "standard",
        "samples": wanted.samples,
        "filter": "BOX",
        "threads": os.cpu_count() or 1,
        "background": 0.9,
    }
    for done, _ in enumerate(drawn(python, WORKER, [plant], job)):
        tell("Blender", 0.5 * (done + 1) / len(shots))
    disks = mesh.splats(wanted.splats, wanted.seed)
    assert disks.colors is not None  # meshes have plain colours
    points, colors = disks.world_means(), np.rint(255 * disks.colors).astype(np.uint8)
    for folder, names, cameras in views:
        save_colmap(folder / "sparse" / "0", names, cameras, points, colors)
    with atomic_write(place / "dataset.json") as stream:
        stream.write(json.dumps({"background": BACKGROUND, "seed": wanted.seed}).encode())


def _train(
    wanted: PlantSettings, mesh: Mesh, place: Path, file: Path, renderer: Renderer, tell: Tell
) -> float:
    """Train on the images from disks on the mesh, and write the visible splats; returns the mean test
    PSNR."""
    settings = TrainSettings(
        iterations=wanted.iterations,
        seed=wanted.seed,
        sh_degree=0,  # plants are rotated, with light from above
        densify_until=0,
        position_steps=wanted.iterations,
    )
    dataset = load_dataset(place)
    start = mesh.splats(wanted.splats, wanted.seed)
    trainer = Trainer(dataset, renderer, settings, place / "training.npz", start)

    def step(made: Step) -> None:
        tell(f"training, {made.psnr:.1f} dB", 0.5 + 0.5 * made.iteration / wanted.iterations)

    trainer.run(step)
    score = float(np.mean([view.psnr for view in trainer.evaluate()]))
    cloud = trainer.cloud()
    assert cloud.sh is not None  # trainers make SH
    seen = cloud.opacities > _FAINT
    parts = (getattr(cloud, name)[seen] for name in ("means", "quats", "scales", "opacities"))
    save_ply(SplatCloud(*parts, sh=cloud.sh[seen], origin=cloud.origin), file)
    return score
