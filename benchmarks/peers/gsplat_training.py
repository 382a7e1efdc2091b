"""Compare the training of disks by fidsplat, gsplat and the 2DGS authors' rasterizer on one NVIDIA GPU, in
one run.

    pip install . torch gsplat       # 1.5.3
    python benchmarks/peers/gsplat_training.py r100k_720p r1m_1080p --json gsplat-training.json
    python benchmarks/peers/gsplat_training.py --dataset yard --iterations 2000 --authors

Scenes: ten steps of benchmarks/training.py, with SH of degree 3, alternate with ten of each peer: frame, loss
(the same, in PyTorch: 0.8 L1 and 0.2 D-SSIM by separable convolutions), `backward`, fused Adam of all values.
The time of the peer's frame and `backward` without the optimiser is reported too. Data sets: a complete
training by each with the same constants and gsplat's `DefaultStrategy`. PSNR is of the held-out views, each
rendered by its own renderer, fidsplat's splats by gsplat too. (In gsplat 1.5.3 that strategy never resets
opacities: its condition is never true. With the authors' rasterizer they are reset, as in the authors'
trainer.)

--authors requires `pip install eden-diff-surfel-rasterization`: the authors' sources of 2024, licensed only
for research and evaluation, which PyTorch compiles at the first import.
"""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gsplat
import numpy as np
import torch
from gsplat.strategy.ops import reset_opa

import fidsplat as fs
from fidsplat.images.files import to_uint8
from fidsplat.train import Dataset, Trainer, TrainSettings, load_dataset
from fidsplat.train.dataset import TrainingView
from fidsplat.train.parameters import Splats, initial_splats
from fidsplat.vision.metrics import psnr

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from measuring import facts, keep, options
from training import trainer_of

STEPS = 10
"""consecutive steps without synchronization, as in a training"""
SHARE = 0.2
"""weight of D-SSIM in the loss"""
NEAR, FAR = 0.2, 100.0
"""near and far plane of the authors, metres"""


class Peer:
    """gsplat's splats with an optimiser for each parameter, at the rates of a `TrainSettings`."""

    resets = False
    """whether opacities are reset"""

    def __init__(self, splats: Splats, settings: TrainSettings, dataset: Dataset) -> None:
        values = splats.values
        arrays = {
            "means": values["means"] + dataset.origin.astype(np.float32),
            "scales": np.column_stack([values["log_scales"], values["log_scales"][:, :1]]),
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
                torch.tensor(view.image, device="cuda").float() / 255,
            )
            for view in dataset.views
        ]

    def draw(self, view: torch.Tensor, matrix: torch.Tensor, size: tuple[int, int], degree: int) -> Any:
        """Render an image (h, w, 3); returns it with gsplat's data."""
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
            near_plane=NEAR,
            backgrounds=self._background,
            packed=False,
        )
        return images[0], meta

    def step(
        self, number: int, degree: int, before: Any = None, after: Any = None, optimise: bool = True
    ) -> None:
        """Train on one view: frame, loss, gradients, and optionally the optimisers.

        before, after: called with gsplat's data before and after the backward pass.
        """
        view, matrix, truth = self._views[number]
        image, meta = self.draw(view, matrix, (truth.shape[1], truth.shape[0]), degree)
        if not optimise:
            image.backward(truth)
            for value in self.params.values():
                value.grad = None
            return
        if before is not None:
            before(meta)
        loss_of(image, truth).backward()
        if after is not None:
            after(meta)
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)

    def rate(self, iteration: int) -> None:
        """Set the learning rate of the means."""
        rate = self._settings.position_rate_at(iteration) * self._extent
        self.optimizers["means"].param_groups[0]["lr"] = rate


class AuthorsPeer(Peer):
    """gsplat's training with the 2DGS authors' rasterizer, which assumes principal points at the image
    centre."""

    resets = True

    def draw(self, view: torch.Tensor, matrix: torch.Tensor, size: tuple[int, int], degree: int) -> Any:
        """Render an image (h, w, 3); returns it with the data for gsplat's strategy."""
        surfels, values, (width, height) = authors_rasterizer(), self.params, size
        slopes = width / (2 * float(matrix[0, 0, 0])), height / (2 * float(matrix[0, 1, 1]))
        projection = torch.zeros((4, 4), device="cuda")
        projection[0, 0], projection[1, 1] = 1 / slopes[0], 1 / slopes[1]
        projection[2, 2], projection[2, 3] = FAR / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR)
        projection[3, 2] = 1
        settings = surfels.GaussianRasterizationSettings(
            image_height=height,
            image_width=width,
            tanfovx=slopes[0],
            tanfovy=slopes[1],
            bg=self._background[0],
            scale_modifier=1.0,
            viewmatrix=view[0].T.contiguous(),
            projmatrix=(projection @ view[0]).T.contiguous(),
            sh_degree=degree,
            campos=torch.inverse(view[0])[:3, 3].contiguous(),
            prefiltered=False,
            debug=False,
            near_n=NEAR,
            far_n=FAR,
        )
        count = len(values["means"])
        screen = torch.zeros((1, count, 2), device="cuda", requires_grad=True)
        image, radii, _ = surfels.GaussianRasterizer(settings)(
            means3D=values["means"],
            means2D=torch.nn.functional.pad(screen[0], (0, 1)),
            opacities=torch.sigmoid(values["opacities"])[:, None],
            shs=torch.cat([values["sh0"], values["shN"]], 1),
            scales=torch.exp(values["scales"][:, :2]),
            rotations=torch.nn.functional.normalize(values["quats"]),
        )
        # gradients with respect to positions are already in half image sizes; gsplat would scale them
        meta = {"gradient_2dgs": screen, "width": 2, "height": 2, "n_cameras": 1, "gaussian_ids": None}
        return image.permute(1, 2, 0), meta | {"radii": radii[None, :, None].expand(1, count, 2)}


def authors_rasterizer() -> Any:
    """Module of the authors' rasterizer."""
    return importlib.import_module("diff_surfel_rasterization")


def tensor(array: np.ndarray) -> Any:
    """A float32 tensor on the GPU."""
    return torch.tensor(np.asarray(array, np.float32), device="cuda")


def loss_of(image: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Loss 0.8 L1 + 0.2 (1 - SSIM), window of 11 pixels, sigma 1.5."""
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


def finished(
    work: Callable[[], Any], finish: Callable[[], Any] = torch.cuda.synchronize
) -> Callable[[], float]:
    """Function that runs the work `STEPS` times and returns the milliseconds of one, with all GPU work."""

    def timed() -> float:
        finish()
        begun = time.perf_counter()
        for _ in range(STEPS):
            work()
        finish()
        return (time.perf_counter() - begun) * 1e3 / STEPS

    return timed


def steps(name: str, renderer: fs.Renderer, repeats: int, kinds: dict[str, type[Peer]]) -> dict[str, Any]:
    """Median milliseconds of a step of each renderer, interleaved."""
    trainer = trainer_of(name, renderer, 3, STEPS * (1 + repeats))
    splats = trainer._model.read()
    backend: Any = renderer.backend

    works = {"fidsplat_ms": finished(trainer.step, backend.finish)}
    for title, kind in kinds.items():
        peer = kind(splats, trainer.settings, trainer.dataset)
        works[f"{title}_ms"] = finished(partial(peer.step, 0, 3))
        works[f"{title}_picture_and_backward_ms"] = finished(partial(peer.step, 0, 3, optimise=False))
    for work in works.values():
        work()
    rounds = [[work() for work in works.values()] for _ in range(repeats)]
    return {"scene": name, **dict(zip(works, np.median(rounds, axis=0).tolist(), strict=True))}


def train(dataset: Dataset, iterations: int, kind: type[Peer]) -> tuple[Peer, float]:
    """Train a peer completely; returns the peer and the seconds."""
    settings = TrainSettings(iterations=iterations)
    peer = kind(initial_splats(dataset, settings), settings, dataset)
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
    for iteration in range(1, iterations + 1):
        views = views or order.permutation(len(dataset.views)).tolist()
        peer.rate(iteration)
        given = peer.params, peer.optimizers, state, iteration

        def after(meta: Any, given: Any = given) -> None:
            strategy.step_post_backward(*given, meta, packed=False)
            if kind.resets and given[-1] % settings.reset_every == 0:
                reset_opa(*given[:3], value=settings.reset_opacity)

        # no densification after the last iteration: new splats would not be optimised
        makes = after if iteration < iterations else None
        peer.step(
            views.pop(), settings.degree_at(iteration), partial(strategy.step_pre_backward, *given), makes
        )
    torch.cuda.synchronize()
    return peer, time.perf_counter() - begun


def score(peer: Peer, views: tuple[TrainingView, ...]) -> float:
    """Mean PSNR of 8-bit images rendered by the peer."""
    found = []
    for view in views:
        camera = view.camera
        place = tensor(camera.world_to_camera[None]), tensor(camera.matrix[None])
        with torch.no_grad():
            image, _ = peer.draw(*place, (camera.width, camera.height), 3)
        found.append(psnr(to_uint8(image.cpu().numpy()) / 255.0, view.image / 255.0))
    return float(np.mean(found))


def trainings(
    dataset: Dataset, renderer: fs.Renderer, iterations: int, kinds: dict[str, type[Peer]]
) -> dict[str, Any]:
    """Seconds, splats and PSNR of all trainings; kernels are compiled before fidsplat's."""
    Trainer(dataset, renderer, iterations=8, sh_every=2).run()
    begun = time.perf_counter()
    ours = Trainer(dataset, renderer, iterations=iterations)
    ours.run()
    seconds = time.perf_counter() - begun
    by_gsplat = Peer(ours._model.read(), ours.settings, dataset)
    found: dict[str, Any] = {
        "dataset": dataset.name,
        "iterations": iterations,
        "fidsplat": {
            "seconds": seconds,
            "splats": len(ours.cloud()),
            "psnr": float(np.mean([one.psnr for one in ours.evaluate()])),
            "psnr_drawn_by_gsplat": score(by_gsplat, dataset.held_out),
        },
    }
    for title, kind in kinds.items():
        peer, its_seconds = train(dataset, iterations, kind)
        found[title] = {
            "seconds": its_seconds,
            "splats": len(peer.params["means"]),
            "psnr": score(peer, dataset.held_out),
        }
        print(title, found[title], file=sys.stderr)
    return found


def main() -> None:
    parser = options(__doc__, repeats=30, device="opencl:nvidia")
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="as in benchmarks/training.py")
    parser.add_argument("--dataset", action="append", default=[], metavar="DIR", help="as of fidsplat train")
    parser.add_argument("--iterations", type=int, default=7000, help="of a training (default: 7000)")
    parser.add_argument(
        "--authors", action="store_true", help="compare with the 2DGS authors' rasterizer too"
    )
    given = parser.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("gsplat_training: PyTorch must have a CUDA device, which gsplat requires")
    kinds: dict[str, type[Peer]] = {"gsplat": Peer}
    if given.authors:
        authors_rasterizer()
        kinds["authors"] = AuthorsPeer
    renderer = fs.Renderer(given.device)
    found: list[dict[str, Any]] = []
    about = facts(renderer) | {"gsplat": gsplat.__version__, "torch": torch.__version__}
    for name in given.scenes:
        found.append(steps(name, renderer, given.repeats, kinds) | about)
        print(found[-1], file=sys.stderr)
    for folder in given.dataset:
        found.append(trainings(load_dataset(folder), renderer, given.iterations, kinds) | about)
        print(found[-1], file=sys.stderr)
    keep(found, given.json)


if __name__ == "__main__":
    main()
