"""Trainer: splats that look like a data set's pictures, the same in every bit on every run of a device."""

from __future__ import annotations

import math
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fidsplat.backends.gradients import CapacityExceeded
from fidsplat.backends.prepare import prepare
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.effects import FeatureSet
from fidsplat.effects.differentiable import with_distortion
from fidsplat.formats import save_ply
from fidsplat.render.renderer import Renderer
from fidsplat.splats.cloud import SplatCloud
from fidsplat.train import densify, mcmc
from fidsplat.train.checkpoint import TrainingState, load_checkpoint, save_checkpoint
from fidsplat.train.dataset import Dataset, TrainingView
from fidsplat.train.device import DeviceWork
from fidsplat.train.host import HostWork
from fidsplat.train.losses import Loss
from fidsplat.train.next_features import next_features
from fidsplat.train.optimiser import learning_rates
from fidsplat.train.parameters import Splats, TrainingError, initial_splats, splats_from_cloud
from fidsplat.train.random_numbers import Purpose, permutation
from fidsplat.train.scores import ViewScore, score_view
from fidsplat.train.settings import TrainSettings, settings_with
from fidsplat.util import interrupts
from fidsplat.util.arguments import callback, instance, invalid, items
from fidsplat.util.errors import DeviceError, InputError
from fidsplat.util.files import ordinary_file, writable_folder

_SOLID = ("rgb", "alpha", "depth", "normal")
"""outputs of pictures whose depths and normals are in the loss"""
_TOLD_SECONDS = 0.1
"""after which a run asks for losses, however few"""
CHECKPOINT_SECONDS = 30.0
"""a run writes a checkpoint when this has passed since the last"""


class Step(NamedTuple):
    """What one iteration did."""

    iteration: int
    """1 for the first"""
    view: str
    """name of the view that was looked at"""
    loss: float
    """of the picture's colours"""
    psnr: float
    """dB, of that view before the step"""
    splats: int
    """after the step"""


class Trainer:
    """Trains splats on a data set.

    ```python
    trainer = Trainer(load_dataset("yard"), Renderer("opencl"), iterations=2000, seed=0)
    cloud = trainer.run()
    ```

    Args:
        dataset: views and points.
        renderer: opens the device that draws; None: the default device.
        settings: of the run; None: the defaults. `changes` are fields of it, given by name.
        checkpoint: a file that the run goes on from if it is there, and that `run` writes.
        restart: begin again though there is a checkpoint, which stays until the first new one replaces it.
        start: splats to begin with, in place of one at each of the data set's points; SH grow from degree 0
            all the same.

    Raises:
        DeviceError: the device has no gradients.
        InputError: a setting that cannot be used, or a checkpoint that is damaged or of another run.
    """

    def __init__(
        self,
        dataset: Dataset,
        renderer: Renderer | None = None,
        settings: TrainSettings | None = None,
        checkpoint: str | Path | None = None,
        start: SplatCloud | None = None,
        restart: bool = False,
        **changes: Any,
    ) -> None:
        self.dataset = instance("dataset", dataset, Dataset, remedy="load_dataset reads one")
        if renderer is not None and not hasattr(renderer, "backend"):
            raise invalid("renderer", "an fs.Renderer or None", renderer)
        if start is not None:
            instance("start", start, SplatCloud, "an fs.SplatCloud or None")
        self.settings = settings_with(settings, changes)
        self.renderer = Renderer() if renderer is None else renderer
        self.checkpoint = None if checkpoint is None else _writable(checkpoint)
        backend = self.renderer.backend
        if not backend.traits.differentiates:
            raise DeviceError(backend.lacks("have gradients", "use device='opencl', 'warp' or 'reference'"))
        self._differentiate = backend.differentiate
        self._quality = Quality.of(self.settings.quality)
        if self.renderer.device.kind == "cpu" and "arithmetic" not in self.settings.quality:
            self._quality = self._quality.with_(arithmetic="fast")
        self._captures = [self._capture(view) for view in dataset.views]
        self._solid = [replace(each, outputs=_SOLID) for each in self._captures]
        self._work = (
            DeviceWork(backend.training(), dataset.views, self.settings)
            if backend.traits.trains
            else HostWork(backend, dataset.views, self.settings)
        )
        self._made = self._begin(start, restart)
        self._work.load(self._made.splats)
        self._waiting: deque[tuple[int, str, Callable[[], Loss]]] = deque()
        """iterations and their views whose losses the host has not asked for"""
        self._found: deque[tuple[int, str, Loss]] = deque()
        """those of which nobody has been told"""
        self._failure: TrainingError | None = None
        """of an iteration that others have followed"""
        self._features: FeatureSet | None = None
        """of the last picture"""
        self._order: tuple[int, np.ndarray] = (-1, np.zeros(0, int))

    @property
    def iteration(self) -> int:
        """Iterations that are done."""
        return self._made.iteration

    @property
    def done(self) -> bool:
        """Whether all iterations are done."""
        return self.iteration >= self.settings.iterations

    @property
    def history(self) -> dict[str, np.ndarray]:
        """Of each iteration that is done: `losses`, `psnrs` float32, `counts` int32 of splats; read them, do
        not write. Raises as `step`."""
        self._settle()
        return {name: array[: self.iteration] for name, array in self._made.history.items()}

    def step(self) -> Step:
        """Look at one view, and change the splats so that they look more like it.

        Raises:
            InputError: all iterations are done.
            TrainingError: the loss is not finite, no splat is left, or making splats was stopped before.
            DeviceError: the device fails or lacks memory.
        """
        self._advance(late=False)
        return list(self._steps())[-1]

    def run(self, progress: Callable[[Step], None] | None = None, prompt: bool = True) -> SplatCloud:
        """Train to the end, and write checkpoints on the way where there is a file for them.

        progress: called after each iteration.
        prompt: before the next one begins; False: a few iterations later, so that a GPU does not wait.

        Raises:
            InputError: as `step`; or a checkpoint cannot be written, and the last one is whole.
            TrainingError: as `step`.
        """
        callback("progress", progress)
        last = told = time.monotonic()
        while not self.done:
            self._advance(late=progress is None or not prompt)
            if self.done or time.monotonic() - told > _TOLD_SECONDS:
                self._settle()
                told = time.monotonic()
            for step in self._steps():
                if progress is not None:
                    progress(step)
            if self.done or time.monotonic() - last > CHECKPOINT_SECONDS:
                self.save_checkpoint()
                last = time.monotonic()
        return self.cloud()

    def cloud(self) -> SplatCloud:
        """The splats as they are now. Raises TrainingError where a value is not finite."""
        return self._stored().cloud(self.settings.sh_degree, self.dataset.origin)

    def save(self, path: str | Path) -> None:
        """Write the splats as they are now to a PLY file. Raises InputError when it cannot be written,
        TrainingError where a value is not finite."""
        save_ply(self.cloud(), path)

    def save_checkpoint(self) -> None:
        """Write the checkpoint, if there is a file for it.

        Raises:
            InputError: it cannot be written; an older one then stays.
            TrainingError: a value of the splats is not finite.
        """
        if self.checkpoint is None:
            return
        self._made.splats = self._stored()
        kept = TrainingState(self.iteration, self._made.splats, self.history)
        title = self.renderer.device.title
        save_checkpoint(self.checkpoint, kept, self.settings, self.dataset, title)

    def evaluate(self, views: tuple[TrainingView, ...] | None = None) -> list[ViewScore]:
        """Compare the splats with views: those that were held out, unless others are given."""
        views = self.dataset.held_out if views is None else views
        views = items("views", views, TrainingView, "a list of TrainingView")
        captures = [self._capture(view) for view in views]
        frames = self.renderer.render_views(self.cloud(), captures)
        return [score_view(view, frame["rgb"]) for view, frame in zip(views, frames, strict=True)]

    def _advance(self, late: bool) -> None:
        """An iteration. late: its loss may be asked for when others have followed."""
        interrupts.check()
        made, settings = self._made, self.settings
        if self._failure is not None:
            raise self._failure
        if self.done:
            raise InputError(f"all {settings.iterations} iterations are done; give a trainer more of them")
        while self._waiting and self._waiting[-1][0] > made.iteration:  # of one that was interrupted
            self._waiting.pop()
        self._make_splats()
        iteration = made.iteration + 1
        number = self._view_at(iteration)
        view = self.dataset.views[number]
        try:
            value, taken = self._compared(iteration, number, waits=False)
        except CapacityExceeded:
            value, taken = self._compared(iteration, number, waits=True)
        self._waiting.append((iteration, view.name, value))
        if not late or len(self._waiting) > self._work.late or settings.densifies_after(iteration):
            self._settle()  # not before: the device goes on meanwhile
        self._change(taken, iteration, view)
        made.iteration = iteration
        made.history["counts"][iteration - 1] = len(self._work)

    def _settle(self) -> None:
        """Asks for the losses that are waited for.

        Raises:
            TrainingError: one is not finite, and it or one that others have followed was not before.
        """
        while self._failure is None and self._waiting:
            iteration, view, value = self._waiting[0]
            loss = value()
            if not math.isfinite(loss.value):
                failure = TrainingError(
                    f"the loss is {loss.value} at iteration {iteration}, in the view {view}; "
                    + self._what_is_kept()
                )
                self._waiting.clear()
                if iteration > self.iteration:  # the splats are those before it
                    raise failure
                self._failure = failure
            else:
                history = self._made.history
                history["losses"][iteration - 1], history["psnrs"][iteration - 1] = loss.value, loss.psnr
                self._found.append((iteration, view, loss))
                self._waiting.popleft()
        if self._failure is not None:
            raise self._failure

    def _steps(self) -> Iterator[Step]:
        """Those that nobody has been told of."""
        while self._found:
            iteration, view, loss = self._found.popleft()
            count = int(self._made.history["counts"][iteration - 1])
            yield Step(iteration, view, loss.value, loss.psnr, count)

    def _compared(self, iteration: int, number: int, waits: bool) -> tuple[Callable[[], Loss], Any]:
        """Draws a view: what waits for its loss, and the picture taken back, from which splats learn.

        waits: as `GradientPipeline.forward`.
        """
        resident = self._work.resident(self.settings.degree_at(iteration), self.dataset.origin)
        by_normals, by_distortions = self.settings.surface_weights_at(iteration)
        plain, solid = self._captures[number], self._solid[number]
        features, seen = prepare(resident, solid if by_normals else plain)
        if by_distortions:
            features = with_distortion(features)
        if features != self._features:
            self._features = features
            later = next_features(self.settings, iteration, plain, solid)
            if later is not None:
                self.renderer.backend.compile_ahead(later)
        pipeline = self._differentiate(features)
        images = pipeline.forward(resident, seen, waits)
        value, slope = self._work.loss(images, number)
        slopes = {"rgb": slope}
        if by_normals:
            slopes |= self._work.surface(images, number, by_normals)
        if by_distortions:
            view = self.dataset.views[number]
            counts = np.ones(view.image.shape[:2], np.float32) if view.mask is None else view.mask
            slopes["distortion"] = counts * np.float32(by_distortions / counts.size)
        return value, self._work.backward_to_tiles(pipeline, images, slopes)

    def _stored(self) -> Splats:
        self._settle()
        splats = self._work.store()
        splats.check(f"after iteration {self.iteration}; {self._what_is_kept()}")
        return splats

    def _capture(self, view: TrainingView) -> Capture:
        return Capture(view.camera, quality=self._quality, background=self.dataset.background)

    def _begin(self, start: SplatCloud | None, restart: bool) -> TrainingState:
        settings = self.settings
        if self.checkpoint is not None and self.checkpoint.exists() and not restart:
            title = self.renderer.device.title
            made, others = load_checkpoint(self.checkpoint, settings, self.dataset.digest, title)
            if others:
                warnings.warn(
                    f"{self.checkpoint} was made by {' and '.join(others)}; the run goes on, but its "
                    "bits will not be those of a run that was made by one: --overwrite begins again",
                    stacklevel=3,
                )
        else:
            dataset = self.dataset
            splats = (
                initial_splats(dataset, settings)
                if start is None
                else splats_from_cloud(start, settings, dataset.origin)
            )
            made = TrainingState.initial(splats)
        left = settings.iterations - made.iteration
        made.history = {name: np.append(a, np.zeros(left, a.dtype)) for name, a in made.history.items()}
        return made

    def _view_at(self, iteration: int) -> int:
        """The number of a view: all of them in a random order, then all in another."""
        count = len(self.dataset.views)
        round_, place = divmod(iteration - 1, count)
        if self._order[0] != round_:
            self._order = round_, permutation(self.settings.seed, Purpose.VIEWS, round_, count)
        return int(self._order[1][place])

    def _make_splats(self) -> None:
        """By the default rule, after the last iteration that was done. It comes before the next one: a run
        that ends here keeps splats that were fitted, and opacities that were not reset, as the authors'
        trainer, which saves them first."""
        settings, iteration = self.settings, self.iteration
        if settings.strategy == "mcmc" or not settings.densifies_after(iteration):
            return
        self._settle()
        made = densify.densification(self._work.shapes(), settings, iteration, self.dataset.extent)
        with self._not_half():
            self._work.make(made)
            if iteration % settings.reset_every == 0:
                self._work.reset()

    def _change(self, taken: Any, iteration: int, view: TrainingView) -> None:
        """The optimiser's step; none where the default rule makes splats next, as in the authors' trainer, in
        which new splats have no gradient yet."""
        settings, mcmc_runs = self.settings, self.settings.strategy == "mcmc"
        origin = self.dataset.origin
        if not mcmc_runs and settings.densifies_after(iteration):
            self._work.count(taken, view.camera, origin)
            return
        camera = view.camera if not mcmc_runs and iteration < settings.densify_until else None
        rate = learning_rates(settings, iteration, self.dataset.extent)
        self._work.step(taken, rate, settings.adam_steps(iteration), camera, origin)
        if mcmc_runs:
            with self._not_half():
                if settings.densifies_after(iteration):
                    self._work.load(mcmc.relocate_and_grow(self._work.store(), settings, iteration))
                self._work.shake(iteration, rate["means"])

    @contextmanager
    def _not_half(self) -> Iterator[None]:
        """Splats are made and taken away: if that ends on the way (no memory, an interrupt), nobody draws or
        keeps what is there, arrays of two lengths maybe."""
        try:
            yield
        except BaseException:
            self._failure = TrainingError(
                f"making splats was stopped after iteration {self.iteration}; {self._what_is_kept('')}"
            )
            raise

    def _what_is_kept(self, advice: str = "; lower the rates, or check the data set's cameras") -> str:
        if self.checkpoint is None or not self.checkpoint.exists():
            return f"nothing was kept{advice}"
        return f"the checkpoint {self.checkpoint} is whole, as it was written last"


def _writable(checkpoint: str | Path) -> Path:
    """The path, after a proof that a file can be written beside it: before the work, not half a minute in."""
    file = ordinary_file(checkpoint)
    writable_folder(file.parent)
    return file
