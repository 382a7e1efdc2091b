"""Measure gradients: differences from the reference renderer, and time (docs/gradients.md).

    PYTHONPATH=.:tests python benchmarks/gradients.py [--device D] [--scenes 200] [--solid SHARE]
        [--quality Q] [--json FILE]
    PYTHONPATH=.:tests python benchmarks/gradients.py --time r100k_720p r1m_1080p [--quality surfel]

Errors are of the random scenes of tests/contract/test_gradients.py: for the array of each parameter the
relative error and one less the cosine, as median and maximum over the scenes; the number of scenes with
errors above 1e-4; and the largest of these relative to the change by units in the last place of means and
quaternions. Times are of a frame and of its gradients with respect to colour, with resident splats: medians
of each stage by the device's clock.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from derivative_errors import (
    NORM,
    certain_loss,
    conditioning,
    derivatives,
    differences,
    random_loss,
    random_picture,
)
from measuring import PROGRESS, facts, keep, options, show
from rich.progress import track

import fidsplat as fs
from fidsplat.backends.interface import Backend
from fidsplat.backends.prepare import prepare
from fidsplat.backends.reference.backend import ReferenceBackend
from fidsplat.scenes.random_clouds import load_scene
from fidsplat.util.errors import InputError
from fidsplat.util.timing import Timer, time_interleaved


def errors(backend: Backend, scenes: int, solid: float, quality: str | None) -> list[dict[str, float | str]]:
    """Median and largest error of each parameter over all scenes."""
    reference, found, beyond = ReferenceBackend(), defaultdict(list), defaultdict(list)
    for seed in track(range(scenes), "Scenes", console=PROGRESS):
        cloud, capture = random_picture(seed, solid=solid, quality=quality)
        loss = certain_loss(cloud, capture)
        truth = derivatives(reference, cloud, capture, loss)
        off = list(differences(derivatives(backend, cloud, capture, loss), truth))
        for one in off:
            found[one.parameter].append(one[1:])
        if any(one.norm > NORM for one in off):
            for one, known in zip(off, conditioning(cloud, capture, loss), strict=True):
                if one.norm > NORM:
                    beyond[one.parameter].append(one.norm / known.norm)
    return [
        {
            "parameter": name,
            "median": float(np.median(values, axis=0)[0]),
            **dict(zip(("largest", "turned"), np.max(values, axis=0).tolist(), strict=True)),
            "beyond": sum(norm > NORM for norm, _ in values),
            "last_places": max(beyond[name], default=0.0),
        }
        for name, values in found.items()
    ]


def times(backend: Backend, scene: str, quality: str | None, repeats: int) -> dict[str, float | str]:
    """Median milliseconds of a frame and its gradients, and of each stage."""
    cloud, camera = load_scene(scene)
    features, view = prepare(cloud, fs.Capture(camera, quality=quality))
    pipeline, resident = backend.gradient_pipeline(features), backend.upload(cloud)
    loss = random_loss(features, view)

    def step() -> dict[str, float]:
        images = pipeline.forward(resident, view)
        pipeline.backward(images, loss)
        return dict(images.timings)

    timer = Timer(step)
    time_interleaved([timer], repeats)
    stages = {name: float(np.median(ms)) for name, ms in timer.parts.items()}
    return {"scene": scene, "step": sum(stages.values()), **stages}


def main() -> None:
    parser = options(__doc__, repeats=15)
    parser.add_argument("--scenes", type=int, default=200, help="random scenes (default: 200)")
    parser.add_argument("--time", nargs="+", metavar="SCENE", help="time these standard scenes instead")
    parser.add_argument("--solid", type=float, default=0.0, help="share of 3D Gaussians (default: 0)")
    parser.add_argument("--quality", help="render quality (default: standard)")
    given = parser.parse_args()
    renderer = fs.Renderer(given.device)
    if not renderer.backend.has("gradient_pipeline"):
        raise InputError(f"--device must have gradients, got {given.device}; use an OpenCL or a Warp device")
    backend = renderer.backend
    if given.time:
        rows = [times(backend, scene, given.quality, given.repeats) for scene in given.time]
        heads, title = list(rows[0]), "Milliseconds of a frame and its gradients"
    else:
        rows = errors(backend, given.scenes, given.solid, given.quality)
        heads, title = list(rows[0]), f"Derivatives of {given.scenes} random scenes against float64"
    if not keep({**facts(renderer), "figures": rows}, given.json):
        cells = [[one if isinstance(one, str) else f"{one:.3g}" for one in row.values()] for row in rows]
        show(f"{title}, {renderer.device.title}", heads, cells)


if __name__ == "__main__":
    main()
