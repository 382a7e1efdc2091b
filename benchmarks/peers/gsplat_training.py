"""Training of disks by fidsplat beside gsplat on one NVIDIA GPU, in the same run.

    pip install . torch gsplat       # 1.5.3
    python benchmarks/peers/gsplat_training.py r100k_720p r1m_1080p --json gsplat-training.json
    python benchmarks/peers/gsplat_training.py --dataset yard --iterations 2000

Of scenes: a step of benchmarks/training.py, SH of degree 3, in turn with gsplat's: `rasterization_2dgs`, the
same loss in PyTorch (0.8 L1 and 0.2 D-SSIM by separable convolutions), `backward`, fused Adam of all values;
beside it the time of its picture and `backward` alone. Of a data set: a whole training by each with the same
constants, gsplat's by its `DefaultStrategy` as its 2DGS trainer has it; PSNR is of the views held out, both
drawn by gsplat. (In 1.5.3 that strategy never resets opacities: its condition is never true.)
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gsplat
import numpy as np
import torch

import fidsplat as fs
from fidsplat.train import Dataset, Trainer, TrainSettings, load_dataset
from fidsplat.train.dataset import TrainingView
from fidsplat.train.parameters import Splats, first_splats
from fidsplat.vision.images import to_uint8
from fidsplat.vision.metrics import psnr

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from measuring import facts, keep, options
from training import WARM, trainer_of

SHARE = 0.2
"""of D-SSIM in the loss"""


class Peer:
    """gsplat's splats with an optimiser of each of their values, at the rates of a `TrainSettings`."""

    def __init__(self, splats: Splats, settings: TrainSettings, dataset: Dataset) -> None:
        values = splats.values
        count = len(splats)
        arrays = {
            "means": values["means"] + dataset.origin.astype(np.float32),
            "scales": np.column_stack([values["log_scales"], np.zeros(count, np.float32)]),
            "quats": values["quats"],
            "opacities": values["logits"],
            "sh0": values["sh"][:, :1],
            "shN": values["sh"][:, 1:],
        }
        self._settings, self._extent = settings, dataset.extent
        self.params = torch.nn.ParameterDict({name: tensor(array) for name, array in arrays.items()})
        rates = {
            **{"means": settings.position_rate * dataset.extent, "scales": settings.scale_rate},
            **{"quats": settings.rotation_rate, "opacities": settings.opacity_rate},
            **{"sh0": settings.color_rate, "shN": settings.color_rate / 20},
        }
        self.optimizers = {
            name: torch.optim.Adam([self.params[name]], lr=rate, eps=settings.epsilon, fused=True)
            for name, rate in rates.items()
        }
        self._background = tensor(np.array([dataset.background]))
        self._views = [
            (
                tensor(view.camera.world_to_camera[None]),
                tensor(view.camera.matrix[None]),
                torch.tensor(view.picture, device="cuda").float() / 255,
            )
            for view in dataset.views
        ]

    def draw(self, view: torch.Tensor, matrix: torch.Tensor, size: tuple[int, int], degree: int) -> Any:
        """A picture (h, w, 3), and what gsplat tells of it."""
        values = self.params
        images, *_, meta = gsplat.rasterization_2dgs(
            means=values["means"],
            quats=values["quats"],
            scales=torch.exp(values["scales"]),
            opacities=torch.sigmoid(values["opacities"]),
            colors=torch.cat([values["sh0"], values["shN"]], 1),
            viewmats=view,
            Ks=matrix,
            width=size[0],
            height=size[1],
            sh_degree=degree,
            backgrounds=self._background,
            packed=False,
        )
        return images[0], meta

    def step(self, number: int, degree: int, before: Any = None, optimise: bool = True) -> Any:
        """One view: picture, loss, derivatives, and the optimisers where they are wanted.

        before: called with what gsplat tells of the picture, before the derivatives.
        """
        view, matrix, truth = self._views[number]
        image, meta = self.draw(view, matrix, (truth.shape[1], truth.shape[0]), degree)
        if before is not None:
            before(meta)
        if optimise:
            loss_of(image, truth).backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
        else:
            image.backward(truth)
            for value in self.params.values():
                value.grad = None
        return meta

    def rate(self, iteration: int) -> None:
        """Sets the means' learning rate."""
        rate = self._settings.position_rate_at(iteration) * self._extent
        self.optimizers["means"].param_groups[0]["lr"] = rate


def tensor(array: np.ndarray) -> Any:
    """On the GPU, float32."""
    return torch.tensor(np.asarray(array, np.float32), device="cuda")


def loss_of(image: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """0.8 L1 and 0.2 (1 - SSIM), window of 11 pixels, sigma 1.5."""
    x = torch.arange(11, device="cuda") - 5.0
    row = torch.exp(-(x**2) / 4.5)
    row = (row / row.sum()).expand(15, 1, 1, 11)
    a, b = image.permute(2, 0, 1), truth.permute(2, 0, 1)
    stack = torch.cat([a, b, a * a, b * b, a * b])[None]
    blurred = torch.conv2d(stack, row, padding=(0, 5), groups=15)
    blurred = torch.conv2d(blurred, row.transpose(2, 3), padding=(5, 0), groups=15)
    mean_a, mean_b, square_a, square_b, both = blurred[0].split(3)
    c1, c2 = 0.01**2, 0.03**2
    similar = (2 * mean_a * mean_b + c1) * (2 * (both - mean_a * mean_b) + c2)
    similar = similar / (mean_a**2 + mean_b**2 + c1)
    similar = similar / (square_a - mean_a**2 + square_b - mean_b**2 + c2)
    return (1 - SHARE) * (image - truth).abs().mean() + SHARE * (1 - similar.mean())


def finished(work: Callable[[], Any]) -> Callable[[], float]:
    """What does the work and gives its milliseconds until the GPU is done."""

    def timed() -> float:
        torch.cuda.synchronize()
        begun = time.perf_counter()
        work()
        torch.cuda.synchronize()
        return (time.perf_counter() - begun) * 1e3

    return timed


def steps(name: str, renderer: fs.Renderer, repeats: int) -> dict[str, Any]:
    """Median milliseconds of a step by each, in turn."""
    trainer = trainer_of(name, renderer, 3, 2 * WARM + repeats)
    peer = Peer(trainer._work.store(), trainer.settings, trainer.dataset)
    backend: Any = renderer.backend

    def own() -> None:
        trainer.step()
        backend.queue.finish()

    works = {
        "fidsplat_ms": finished(own),
        "gsplat_ms": finished(lambda: peer.step(0, 3)),
        "gsplat_picture_and_backward_ms": finished(lambda: peer.step(0, 3, optimise=False)),
    }
    for work in works.values():
        for _ in range(WARM):
            work()
    rounds = [[work() for work in works.values()] for _ in range(repeats)]
    return {"scene": name, **dict(zip(works, np.median(rounds, axis=0).tolist(), strict=True))}


def train(dataset: Dataset, iterations: int) -> tuple[Peer, float]:
    """A whole training by gsplat, and its seconds."""
    settings = TrainSettings(iterations=iterations)
    peer = Peer(first_splats(dataset, settings), settings, dataset)
    strategy = gsplat.DefaultStrategy(
        prune_opa=settings.prune_opacity, key_for_gradient="gradient_2dgs", verbose=False
    )
    strategy.check_sanity(peer.params, peer.optimizers)
    state = strategy.initialize_state(scene_scale=dataset.extent)
    order = np.random.default_rng(0)
    torch.manual_seed(0)
    torch.cuda.synchronize()
    begun = time.perf_counter()
    views: list[int] = []
    for iteration in range(iterations):
        views = views or order.permutation(len(dataset.views)).tolist()
        peer.rate(iteration + 1)
        given = peer.params, peer.optimizers, state, iteration
        meta = peer.step(
            views.pop(),
            settings.degree_at(iteration + 1),
            lambda meta, given=given: strategy.step_pre_backward(*given, meta),
        )
        strategy.step_post_backward(*given, meta, packed=False)
    torch.cuda.synchronize()
    return peer, time.perf_counter() - begun


def score(peer: Peer, views: tuple[TrainingView, ...]) -> float:
    """Mean PSNR of 8-bit pictures, drawn by gsplat."""
    found = []
    for view in views:
        camera = view.camera
        place = tensor(camera.world_to_camera[None]), tensor(camera.matrix[None])
        with torch.no_grad():
            image, _ = peer.draw(*place, (camera.width, camera.height), 3)
        found.append(psnr(to_uint8(image.cpu().numpy()) / 255.0, view.picture / 255.0))
    return float(np.mean(found))


def trainings(dataset: Dataset, renderer: fs.Renderer, iterations: int) -> dict[str, Any]:
    """Seconds, splats and PSNR of both; what is compiled is compiled before ours."""
    Trainer(dataset, renderer, iterations=8, sh_every=2).run()
    begun = time.perf_counter()
    ours = Trainer(dataset, renderer, iterations=iterations)
    ours.run()
    seconds = time.perf_counter() - begun
    peer, its_seconds = train(dataset, iterations)
    drawn = Peer(ours._work.store(), ours.settings, dataset)
    return {
        "dataset": dataset.name,
        "iterations": iterations,
        "fidsplat": {
            "seconds": seconds,
            "splats": len(ours.cloud()),
            "psnr": float(np.mean([one.psnr for one in ours.evaluate()])),
            "psnr_drawn_by_gsplat": score(drawn, dataset.held_out),
        },
        "gsplat": {
            "seconds": its_seconds,
            "splats": len(peer.params["means"]),
            "psnr": score(peer, dataset.held_out),
        },
    }


def main() -> None:
    parser = options(__doc__, repeats=30, device="opencl:nvidia")
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="as in benchmarks/training.py")
    parser.add_argument("--dataset", action="append", default=[], metavar="DIR", help="as of fidsplat train")
    parser.add_argument("--iterations", type=int, default=7000, help="of a training (default: 7000)")
    given = parser.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("gsplat_training: PyTorch sees no CUDA device; gsplat draws on nothing else")
    renderer = fs.Renderer(given.device)
    found: list[dict[str, Any]] = []
    about = facts(renderer) | {"gsplat": gsplat.__version__, "torch": torch.__version__}
    for name in given.scenes:
        found.append(steps(name, renderer, given.repeats) | about)
        print(found[-1], file=sys.stderr)
    for folder in given.dataset:
        found.append(trainings(load_dataset(folder), renderer, given.iterations) | about)
        print(found[-1], file=sys.stderr)
    keep(found, given.json)


if __name__ == "__main__":
    main()
