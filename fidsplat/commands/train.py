"""`fidsplat train`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from fidsplat.commands.output import (
    Device,
    Json,
    console,
    late_progress,
    new_file,
    option,
    progress_bar,
    say,
    switch,
    tell,
    writable_file,
)
from fidsplat.commands.sweeps import need_reports
from fidsplat.train.settings import TrainSettings
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of

if TYPE_CHECKING:
    from fidsplat.train import Step, Trainer, ViewScore


@dataclass
class Train:
    """Train splats on pictures with known cameras.

    DATASET is a folder with COLMAP's model (sparse/0) and pictures (images), one with nerfstudio's
    transforms.json, or what `fidsplat demo views` and `fidsplat experiment dataset` write. Views in its
    folder test, or else every eighth of 16 and more, are held out and compared with at the end.

    The same command gives the same file, in every bit, on the same device. A run that was stopped goes on
    where its last checkpoint is, FILE.training.npz beside FILE.ply, which is written every half minute and
    at Ctrl-C, and stays: with more iterations the same command goes on from there. --overwrite begins again.

    Examples:
      fidsplat demo views -o yard && fidsplat train yard -o yard.ply --iterations 2000
      fidsplat train garden -o garden.ply --strategy mcmc --max-splats 300000 --report garden-report
      fidsplat train photos -o photos.ply --random-points 5000 --within-memory 4
    """

    dataset: Annotated[tyro.conf.Positional[str], option("DATASET", "folder, or transforms.json")]
    out: Annotated[str, option("FILE.ply", "where the splats go", "-o")]
    device: Device = None
    settings: TrainSettings = field(default_factory=TrainSettings)
    within_memory: Annotated[
        float | None, option("GIB", "of splats and pictures while training: fewer splats where it needs them")
    ] = None
    hold_out: Annotated[
        int | None, option("N", "keep every N-th view to compare with, 0 for none (default: see above)")
    ] = None
    random_points: Annotated[
        int, option("N", "start from so many random points, not the data set's (default: 0)")
    ] = 0
    report: Annotated[
        str | None, option("DIR|FILE.md", "write a page with curves and pictures of the views held out")
    ] = None
    overwrite: Annotated[
        bool, switch("begin again; the checkpoint stays until the new run writes its first")
    ] = False
    json: Json = False

    def run(self) -> int:
        from fidsplat.render.renderer import Renderer
        from fidsplat.train import Trainer, load_dataset, splats_within

        if path_of(self.out).suffix.lower() != ".ply":
            raise InputError(f"-o is {self.out}; splats are written as PLY: name a file that ends in .ply")
        if self.report is not None:
            need_reports()
        settings = self.settings
        file = writable_file(self.out)
        checkpoint = file.with_suffix(".training.npz")
        if file.exists() and not checkpoint.exists():  # it is not of this training
            new_file(file, self.overwrite)
        where = console(self.json)
        with late_progress(console(True)) as progress:
            dataset = load_dataset(self.dataset, self.hold_out, self.random_points, settings.seed, progress)
        if self.within_memory is not None:
            settings = splats_within(settings, _bytes(self.within_memory), dataset)
        with where.status("opening the device"):
            renderer = Renderer(self.device)
        trainer = Trainer(dataset, renderer, settings, checkpoint, restart=self.overwrite)
        before, begun = trainer.iteration, time.perf_counter()
        with interrupts.postponed() as stopped, _bar(trainer) as show:

            def told(step: Step) -> None:
                show(step)
                if (stop := stopped()) is not None:
                    trainer.save_checkpoint()
                    say(console(True), f"the same command goes on after iteration {trainer.iteration:,}")
                    raise stop

            trainer.run(told, prompt=False)
        seconds = time.perf_counter() - begun
        trainer.save(file)
        scores = trainer.evaluate()
        done = trainer.iteration - before
        facts = _facts(trainer, scores, seconds, done) | {"file": str(file), "checkpoint": str(checkpoint)}
        if self.report is not None:
            from fidsplat.experiments.training_page import write_training_page

            pages = write_training_page(trainer, scores, facts, Path(self.report))
            facts["report"] = [str(page) for page in pages]
        rows = [(score.name, f"{score.psnr:.2f}", f"{score.ssim:.4f}") for score in scores]
        if scores:
            rows.append(("mean", f"{facts['psnr']:.2f}", f"{facts['ssim']:.4f}"))
        title = f"{dataset.name} on {facts['device']}: views held out"
        rate = facts["iterations_per_second"]
        speed = "nothing was left to do" if rate is None else f"{seconds:.1f} s, {rate:.1f} it/s"
        words = f"{facts['splats']:,} splats after {trainer.iteration:,} iterations ({speed})"
        if not scores:
            words += "; no view was held out: --hold-out 8 keeps every eighth"
        table = (title, ("view", "PSNR, dB", "SSIM"), rows) if scores else None
        return tell(self.json, facts, words, facts["file"], *facts.get("report", []), table=table)


def _bytes(gibibytes: float) -> int:
    if not 0 < gibibytes < 2**20:
        raise InputError(f"--within-memory is {gibibytes!r}; give GiB, above 0, e.g. 4")
    return int(gibibytes * 2**30)


@contextmanager
def _bar(trainer: Trainer) -> Iterator:
    """A progress bar, and what to call with each step."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

    columns = (
        *(TextColumn("training"), BarColumn(), MofNCompleteColumn()),
        *(TextColumn("{task.description}"), TimeRemainingColumn()),
    )
    with progress_bar(console(True), *columns) as bars:
        task = bars.add_task("", total=trainer.settings.iterations, completed=trainer.iteration)
        first, begun = trainer.iteration, time.perf_counter()
        mean = {"loss": 0.0, "psnr": 0.0}

        def show(step: Step) -> None:
            share = max(0.02, 1 / (step.iteration - first))  # of the last in the mean that is shown
            mean["loss"] += share * (step.loss - mean["loss"])
            mean["psnr"] += share * (min(step.psnr, 100.0) - mean["psnr"])
            rate = (step.iteration - first) / (time.perf_counter() - begun)
            words = f"loss {mean['loss']:.4f}  {mean['psnr']:.1f} dB  {step.splats:,} splats  {rate:.1f} it/s"
            bars.update(task, completed=step.iteration, description=words)

        yield show


def _facts(trainer: Trainer, scores: list[ViewScore], seconds: float, done: int) -> dict:
    count = max(1, len(scores))
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
    }
