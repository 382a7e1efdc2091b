"""Command `fidsplat train`: train splats on images with known cameras."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from fidsplat.commands.options import Device, Json, require_packages
from fidsplat.commands.output import console, delayed_progress, print_lines, progress_bar, report
from fidsplat.train.settings import TrainSettings
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.util.files import new_file, path_of, writable_file

if TYPE_CHECKING:
    from fidsplat.train import Step, Trainer, ViewScore


@dataclass
class Train:
    """Train splats on images with known cameras.

    DATASET is a folder with COLMAP's model (sparse/0) and images (images), one with nerfstudio's
    transforms.json, or a folder of `fidsplat demo views`. Views in its folder test are held out and evaluated
    at the end; without that folder every eighth view of 16 or more.

    The same command on the same device writes a bit-identical file. A checkpoint, FILE.training.npz next to
    FILE.ply, is written every half minute and at Ctrl-C. The same command resumes from it, also with more
    iterations; --overwrite restarts.

    Examples:
      fidsplat demo views -o yard && fidsplat train yard -o yard.ply --iterations 2000
      fidsplat train garden -o garden.ply --strategy mcmc --max-splats 300000 --report garden-report
      fidsplat train photos -o photos.ply --random-points 5000 --within-memory 4
      fidsplat train photos -o finer.ply --primitive 3d --start capture.ply --sh-every 1 --densify-until 0
    """

    dataset: tyro.conf.Positional[str]
    """DATASET: folder or transforms.json"""
    out: str
    """FILE.ply: file for the splats"""
    device: Device = None
    training: TrainSettings = field(default_factory=TrainSettings)
    within_memory: float | None = None
    """GIB: memory of splats and images during training; reduces the number of splats"""
    hold_out: int | None = None
    """N: hold out every Nth view, 0 for none (default: see above)"""
    random_points: int = 0
    """N: start from N random points instead of the data set's"""
    masks: str | None = None
    """DIR: masks NAME.png of the images, 0 for ignored pixels, in addition to those of the data set"""
    alpha_masks: bool = False
    """ignore transparent pixels instead of blending them with the background"""
    start: str | None = None
    """FILE: initial splats to refine (default: one at each point)"""
    report: str | None = None
    """DIR|FILE.md: write a page with curves and images of the held-out views"""
    overwrite: bool = False
    """restart; the old checkpoint is kept until the new run writes its first"""
    json: Json = False

    def run(self) -> int:
        from fidsplat.formats.files import load_splats
        from fidsplat.render.renderer import Renderer
        from fidsplat.train import Trainer, load_dataset, splats_within

        if path_of(self.out).suffix.lower() != ".ply":
            raise InputError(f"-o must be a .ply file, got {self.out}")
        if self.report is not None:
            require_packages()
        settings = self.training
        file = writable_file(self.out)
        checkpoint = file.with_suffix(".training.npz")
        if file.exists() and not checkpoint.exists():  # the file is not from this training
            new_file(file, self.overwrite)
        where = console(self.json)
        with delayed_progress() as progress:
            words = self.dataset, self.hold_out, self.random_points, settings.seed
            dataset = load_dataset(*words, progress, self.masks, self.alpha_masks)
        if self.within_memory is not None:
            settings = splats_within(settings, _bytes(self.within_memory), dataset)
        with where.status("opening the device"):
            renderer = Renderer(self.device)
        start = None if self.start is None else load_splats(self.start)
        trainer = Trainer(dataset, renderer, settings, checkpoint, start, restart=self.overwrite)
        before, begun = trainer.iteration, time.perf_counter()
        with interrupts.postponed() as stopped, _bar(trainer) as show:

            def progress_step(step: Step) -> None:
                show(step)
                if (stop := stopped()) is not None:
                    trainer.save_checkpoint()
                    print_lines(
                        console(True), f"the same command resumes after iteration {trainer.iteration:,}"
                    )
                    raise stop

            trainer.run(progress_step, prompt=False)
        seconds = time.perf_counter() - begun
        trainer.save(file)
        with delayed_progress() as progress:
            scores = trainer.evaluate(progress=progress)
        done = trainer.iteration - before
        facts: dict[str, Any] = _facts(trainer, scores, seconds, done) | {
            "file": str(file),
            "checkpoint": str(checkpoint),
        }
        if self.report is not None:
            from fidsplat.experiments.training_page import write_training_page

            pages = write_training_page(trainer, scores, facts, Path(self.report))
            facts["report"] = [str(page) for page in pages]
        rows = [(score.name, f"{score.psnr:.2f}", f"{score.ssim:.4f}") for score in scores]
        if scores:
            rows.append(("mean", f"{facts['psnr']:.2f}", f"{facts['ssim']:.4f}"))
        title = f"{dataset.name} on {facts['device']}: held-out views"
        rate = facts["iterations_per_second"]
        speed = "already complete" if rate is None else f"{seconds:.1f} s, {rate:.1f} it/s"
        words = f"{facts['splats']:,} splats after {trainer.iteration:,} iterations ({speed})"
        if not scores:
            words += "; no view was held out; --hold-out 8 holds out every eighth"
        if settings.refine_poses:
            moved = facts["pose_changes"]
            words += (
                f"; poses moved by {moved['mean_m']:.4g} m and {moved['mean_deg']:.3g} degrees on average, "
                f"{moved['largest_m']:.4g} m and {moved['largest_deg']:.3g} degrees at most"
            )
        if settings.refine_intrinsics:
            pairs = [(old.camera, new.camera) for old, new in zip(dataset.views, trainer.views, strict=True)]
            focal = max(abs(new.fx / old.fx - 1) for old, new in pairs)
            middle = max(abs(new.cx - old.cx) + abs(new.cy - old.cy) for old, new in pairs)
            words += f"; focal lengths changed by {100 * focal:.3g} % and principal points by {middle:.3g} px"
        table = (title, ("view", "PSNR, dB", "SSIM"), rows) if scores else None
        return report(self.json, facts, words, facts["file"], *facts.get("report", []), table=table)


def _bytes(gibibytes: float) -> int:
    if not 0 < gibibytes < 2**20:
        raise InputError(f"--within-memory must be above 0 GiB, got {gibibytes!r}; write for example 4")
    return int(gibibytes * 2**30)


@contextmanager
def _bar(trainer: Trainer) -> Iterator:
    """Progress bar, as a callback for each step."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

    columns = (
        *(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()),
        *(TextColumn("{task.fields[now]}"), TimeRemainingColumn()),
    )
    with progress_bar(console(True), *columns) as bars:
        total, done = trainer.settings.iterations, trainer.iteration
        task = bars.add_task("training", total=total, completed=done, now="")
        first, begun = trainer.iteration, time.perf_counter()
        mean = {"loss": 0.0, "psnr": 0.0}

        def show(step: Step) -> None:
            weight = max(0.02, 1 / (step.iteration - first))  # of this step in the running mean
            mean["loss"] += weight * (step.loss - mean["loss"])
            mean["psnr"] += weight * (min(step.psnr, 100.0) - mean["psnr"])
            rate = (step.iteration - first) / (time.perf_counter() - begun)
            words = f"loss {mean['loss']:.4f}  {mean['psnr']:.1f} dB  {step.splats:,} splats  {rate:.1f} it/s"
            bars.update(task, completed=step.iteration, now=words)

        yield show


def _facts(trainer: Trainer, scores: list[ViewScore], seconds: float, done: int) -> dict:
    count, settings = max(1, len(scores)), trainer.settings
    refined: dict[str, Any] = {}
    if settings.refine_poses:
        moved = trainer.pose_changes()
        (mean_m, mean_deg), (largest_m, largest_deg) = moved.mean(axis=0), moved.max(axis=0)
        refined["pose_changes"] = {
            **{"mean_m": float(mean_m), "mean_deg": float(mean_deg)},
            **{"largest_m": float(largest_m), "largest_deg": float(largest_deg)},
        }
    if settings.refines_cameras or settings.fit_exposures:
        gains = trainer.exposures
        refined["training_views"] = [
            {
                "name": view.name,
                "world_to_camera": view.camera.world_to_camera.tolist(),
                **{key: getattr(view.camera, key) for key in ("fx", "fy", "cx", "cy")},
                "gain": gain.tolist(),
                "offset": offset.tolist(),
            }
            for view, (gain, offset) in zip(trainer.views, gains, strict=True)
        ]
    return {
        "dataset": trainer.dataset.name,
        "device": trainer.renderer.device.title,
        "iterations": trainer.iteration,
        "splats": len(trainer.cloud()),
        "seconds": seconds,
        "iterations_per_second": done / seconds if done else None,
        "psnr": sum(score.psnr for score in scores) / count if scores else None,
        "ssim": sum(score.ssim for score in scores) / count if scores else None,
        "views": [{"name": score.name, "psnr": score.psnr, "ssim": score.ssim} for score in scores],
        **refined,
    }
