"""A small scene to train on, and settings by which a few steps show."""

import json

import numpy as np

import fidsplat as fs
from fidsplat.formats.colmap import save_colmap
from fidsplat.images.files import to_uint8, write_png
from fidsplat.train import Dataset, Trainer, TrainingView

BACKGROUND = (0.2, 0.3, 0.4)
QUICK = {
    "color_rate": 0.05,
    "initial_opacity": 0.6,
    "sh_every": 16,
    "densify_from": 7,
    "densify_every": 8,
    "reset_every": 16,
    "reset_opacity": 0.5,
    "prune_scale": 0.3,
    "gradient_threshold": 2e-3,
    "max_splats": 30,
}


def scene(views=4, held_out=1, size=(24, 18), count=16, renderer=None):
    """A data set of `count` splats viewed from an arc, and points near their centres."""
    random = np.random.default_rng(0)
    cloud = fs.SplatCloud(
        random.uniform(-0.5, 0.5, (count, 3)),
        random.normal(size=(count, 4)),
        random.uniform(0.08, 0.2, (count, 2)),
        random.uniform(0.6, 0.95, count),
        colors=random.uniform(0, 1, (count, 3)),
    )
    cameras = [
        fs.Camera.look_at(*size, 0.9, (1.6 * np.sin(a), 0.3 * np.cos(3 * a), -1.6 * np.cos(a)), (0, 0, 0))
        for a in np.linspace(-1, 1, views + held_out)
    ]
    renderer = renderer or fs.Renderer("reference")
    rendered = [
        TrainingView(
            f"{i}.png", camera, to_uint8(renderer.render(cloud, camera, background=BACKGROUND)["rgb"])
        )
        for i, camera in enumerate(cameras)
    ]
    points = cloud.world_means() + random.normal(0, 0.02, (count, 3))
    grey = np.full((count, 3), 128, np.uint8)
    return Dataset("tiny", tuple(rendered[held_out:]), tuple(rendered[:held_out]), points, grey, BACKGROUND)


def run_and_resumed(whole, renderer, settings, steps, folder):
    """Bytes of the PLY files of an uninterrupted training run, and of a run that is stopped after some
    steps and resumes from its checkpoint."""
    checkpoint = folder / "run.training.npz"
    first = Trainer(whole.dataset, renderer, checkpoint=checkpoint, **settings)
    for _ in range(steps):
        first.step()
    first.save_checkpoint()
    again = Trainer(whole.dataset, renderer, checkpoint=checkpoint, **settings)
    again.run()
    for name, trainer in (("a", whole), ("b", again)):
        trainer.save(folder / f"{name}.ply")
    return [(folder / f"{name}.ply").read_bytes() for name in "ab"]


def write(made, folder):
    """A data set as fidsplat writes one."""
    for place, views in ((folder, made.views), (folder / "test", made.held_out)):
        (place / "images").mkdir(parents=True)
        for view in views:
            write_png(place / "images" / view.name, view.image)
        names, cameras = [view.name for view in views], [view.camera for view in views]
        save_colmap(place / "sparse" / "0", names, cameras, made.points, made.colors)
    (folder / "dataset.json").write_text(json.dumps({"background": BACKGROUND}))
