"""Trainer of splats on the images of a data set; bit-identical on every run of a device."""

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
from fidsplat.backends.view import View
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.effects import FeatureSet, select
from fidsplat.effects.differentiable import with_distortion
from fidsplat.formats import save_ply
from fidsplat.render.renderer import Renderer
from fidsplat.render.resident import ResidentCloud
from fidsplat.splats.cloud import SplatCloud
from fidsplat.train import densify, mcmc
from fidsplat.train.boxes import outside_boxes
from fidsplat.train.checkpoint import TrainingState, load_checkpoint, save_checkpoint
from fidsplat.train.dataset import Dataset, TrainingView
from fidsplat.train.device_model import DeviceModel
from fidsplat.train.host_model import HostModel
from fidsplat.train.losses import Loss
from fidsplat.train.optimiser import learning_rates
from fidsplat.train.parameters import Splats, TrainingError, initial_splats, splats_from_cloud
from fidsplat.train.random_numbers import RandomStream, permutation
from fidsplat.train.scores import ViewScore, score_view
from fidsplat.train.settings import TrainSettings
from fidsplat.train.view_refinement import ViewRefinement, ViewStep, with_exposure_of
from fidsplat.util import interrupts
from fidsplat.util.arguments import callback, instance, invalid, items, settings_with
from fidsplat.util.errors import DeviceError, InputError
from fidsplat.util.files import ordinary_file, writable_folder
from fidsplat.util.progress import Progress

_SURFACE = ("rgb", "alpha", "depth", "normal")
"""outputs of frames with normal consistency in the loss"""
_READ_SECONDS = 0.1
"""time between two readbacks of pending losses [s]"""
CHECKPOINT_SECONDS = 30.0
"""time between checkpoints of a run [s]"""


class Step(NamedTuple):
    """Result of one iteration."""

    iteration: int
    """number of the iteration, from 1"""
    view: str
    """name of the rendered view"""
    loss: float
    """image loss"""
    psnr: float
    """PSNR of the view before the step [dB]"""
    splats: int
    """number of splats after the step"""


class _Properties(NamedTuple):
    """`CloudProperties` of splats in training."""

    sh_degree: int
    ellipsoids: str
    has_coplanar_groups: bool = False
    footprint: str = "gaussian"


class Trainer:
    """Trains splats on a data set.

    ```python
    trainer = Trainer(load_dataset("yard"), Renderer("opencl"), iterations=2000, seed=0)
    cloud = trainer.run()
    ```

    Args:
        dataset: views and points.
        renderer: device to train on; None: the default device.
        settings: settings of the run; None: the defaults. `changes` are settings by name.
        checkpoint: file from which the run resumes if it exists, and which `run` writes.
        restart: start again even if a checkpoint exists; the first new checkpoint replaces it.
        start: initial splats; None: one at each point of the data set. The SH degree grows from 0.

    Raises:
        DeviceError: the device has no gradients.
        InputError: a setting is outside its range, or the checkpoint is damaged or of another run.
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
        self.settings = settings_with(TrainSettings, settings, changes)
        self.renderer = Renderer() if renderer is None else renderer
        self.checkpoint = None if checkpoint is None else ordinary_file(checkpoint)
        if self.checkpoint is not None:
            writable_folder(self.checkpoint.parent)
        backend = self.renderer.backend
        if not backend.has("gradient_pipeline"):
            raise DeviceError(
                backend.unsupported_message("have gradients", "use device='opencl', 'warp' or 'reference'")
            )
        self._gradient_pipeline = backend.gradient_pipeline
        self._quality = Quality.of(self.settings.quality)
        if self.renderer.device.kind == "cpu" and "arithmetic" not in self.settings.quality:
            self._quality = self._quality.with_(arithmetic="fast")
        self._captures = [self._capture(view) for view in dataset.views]
        self._surface_captures = [replace(capture, outputs=_SURFACE) for capture in self._captures]
        self._model = (
            DeviceModel(backend.training(), dataset.views, self.settings)
            if backend.has("training")
            else HostModel(backend, dataset.views, self.settings)
        )
        self._refinement = None
        if self.settings.refines_cameras or self.settings.fit_exposures:
            self._refinement = ViewRefinement(dataset, self.settings)
        self._state = self._begin(start, restart)
        self._model.load(self._state.splats)
        if self._refinement is not None:
            uniforms = [View.of(capture, dataset.origin) for capture in self._captures]
            self._model.refine(self._refinement, uniforms)
        self._pending: deque[tuple[int, int, Callable[[], Loss]]] = deque()
        """iterations and indices of views whose losses are not read yet"""
        self._unreported: deque[tuple[int, str, Loss]] = deque()
        """iterations, names of views and losses of steps that are not reported yet"""
        self._failure: TrainingError | None = None
        """error that every later step raises"""
        self._features: FeatureSet | None = None
        """features of the last frame"""
        self._order: tuple[int, np.ndarray] = (-1, np.zeros(0, int))

    @property
    def iteration(self) -> int:
        """Number of completed iterations."""
        return self._state.iteration

    @property
    def done(self) -> bool:
        """Whether all iterations are completed."""
        return self.iteration >= self.settings.iterations

    @property
    def history(self) -> dict[str, np.ndarray]:
        """`losses`, `psnrs` (float32) and numbers of splats `counts` (int32) of completed iterations;
        read-only. Raises TrainingError if a loss is not finite."""
        self._read_losses()
        return {name: array[: self.iteration] for name, array in self._state.history.items()}

    def step(self) -> Step:
        """Run one iteration: render a view and update the splats.

        Raises:
            InputError: all iterations are completed.
            TrainingError: the loss is not finite, all splats are pruned, or densification was interrupted.
            DeviceError: the device fails or lacks memory.
        """
        self._advance(late=False)
        return list(self._steps())[-1]

    def run(self, progress: Callable[[Step], None] | None = None, prompt: bool = True) -> SplatCloud:
        """Run all remaining iterations, with regular checkpoints if the trainer has a file for them.

        progress: called after each iteration.
        prompt: True: call `progress` before the next iteration; False: a few iterations later, which is
            faster on a GPU.

        Raises:
            InputError: a checkpoint cannot be written (the last one is kept).
            TrainingError: the loss is not finite, all splats are pruned, or densification was interrupted.
        """
        callback("progress", progress)
        saved = read = time.monotonic()
        while not self.done:
            self._advance(late=progress is None or not prompt)
            if self.done or time.monotonic() - read > _READ_SECONDS:
                self._read_losses()
                read = time.monotonic()
            for step in self._steps():
                if progress is not None:
                    progress(step)
            if self.done or time.monotonic() - saved > CHECKPOINT_SECONDS:
                self.save_checkpoint()
                saved = time.monotonic()
        return self.cloud()

    @property
    def views(self) -> tuple[TrainingView, ...]:
        """The training views, with refined cameras."""
        self._read_refinement()
        if self._refinement is None:
            return self.dataset.views
        refinement = self._refinement
        cameras = refinement.aligned() if self.settings.refine_poses else refinement.cameras
        pairs = zip(self.dataset.views, cameras, strict=True)
        return tuple(replace(view, camera=camera) for view, camera in pairs)

    def pose_changes(self) -> np.ndarray:
        """(views, 2): metres and degrees by which the refined poses differ from the data set's."""
        self._read_refinement()
        if self._refinement is None or not self.settings.refine_poses:
            return np.zeros((len(self.dataset.views), 2))
        return self._refinement.pose_changes()

    @property
    def exposures(self) -> np.ndarray:
        """(views, 2, 3): gains, and offsets in display values, by channel, that map rendered colours to each
        training image."""
        self._read_refinement()
        if self._refinement is None:
            return np.tile([[[1.0] * 3, [0.0] * 3]], (len(self.dataset.views), 1, 1))
        gains = np.exp(self._refinement.exposures[:, :1])
        return np.concatenate([gains, self._refinement.exposures[:, 1:]], axis=1)

    def cloud(self) -> SplatCloud:
        """The current splats, without those in the data set's boxes. If poses are refined, the splats are
        transformed by the similarity that aligns the refined poses with those of the data set.

        Raises TrainingError if a value is not finite.
        """
        splats, origin, matrix = self._checked_splats(), self.dataset.origin, np.eye(4)
        if self._refinement is not None and self.settings.refine_poses:
            self._read_refinement()
            matrix = self._refinement.to_dataset()
        if self.dataset.boxes:
            means = (splats.values["means"] + origin) @ matrix[:3, :3].T + matrix[:3, 3]
            splats = splats.select(outside_boxes(means, self.dataset.boxes))
        cloud = splats.cloud(self.settings.sh_degree, origin)
        return cloud.transformed(matrix) if self.settings.refine_poses else cloud

    def save(self, path: str | Path) -> None:
        """Write the current splats to a PLY file. Raises InputError if it cannot be written, TrainingError
        if a value is not finite."""
        save_ply(self.cloud(), path)

    def save_checkpoint(self) -> None:
        """Write the checkpoint, if the trainer has a file for it.

        Raises:
            InputError: the file cannot be written; the last checkpoint is kept.
            TrainingError: a value of the splats is not finite.
        """
        if self.checkpoint is None:
            return
        self._state.splats = self._checked_splats()
        self._read_refinement()
        views = {} if self._refinement is None else self._refinement.arrays()
        state = TrainingState(self.iteration, self._state.splats, self.history, views)
        title = self.renderer.device.title
        save_checkpoint(self.checkpoint, state, self.settings, self.dataset, title)

    def evaluate(
        self, views: tuple[TrainingView, ...] | None = None, progress: Progress | None = None
    ) -> list[ViewScore]:
        """Metrics of views, by default of the held-out views.

        If poses are refined, each view is first localised, starting at its pose in the data set. If exposures
        are fitted, gains and offsets are fitted to each view.

        Args:
            progress: called with a description and the fraction of views done, 0 to 1.
        """
        progress = callback("progress", progress)
        views = self.dataset.held_out if views is None else views
        views = items("views", views, TrainingView, "a list of TrainingView")
        resident = self.renderer.upload(self.cloud())
        refined = self._refinement
        if refined is not None:
            self._read_refinement()
            cameras = (refined.with_intrinsics(view.camera, view.camera) for view in views)
            views = tuple(replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True))
        captures = [self._capture(view) for view in views]
        if self.settings.refine_poses:
            captures = [self._localised(*pair, resident) for pair in zip(views, captures, strict=True)]
        frames = self.renderer.render_views(resident, captures)
        scores, fitted = [], self.settings.fit_exposures
        for number, (view, frame) in enumerate(zip(views, frames, strict=True)):
            rgb = frame["rgb"]
            scores.append(score_view(view, with_exposure_of(rgb, view) if fitted else rgb))
            if progress is not None:
                progress("held-out views", (number + 1) / len(views))
        return scores

    def _localised(self, view: TrainingView, capture: Capture, resident: ResidentCloud) -> Capture:
        """The capture of a view at its localised pose; unchanged if its own pose matches the image better."""
        # lazy, since these modules import marker detectors
        from fidsplat.localisation.direct_alignment import align
        from fidsplat.localisation.normal_equations import rendered_scene

        scene = rendered_scene(self.renderer, resident, capture.with_(outputs=("rgb", "depth")))
        try:
            alignment = align(view.image, view.mask, view.camera, scene)
        except InputError:  # all pixels of the coarsest level are masked
            return capture
        both = capture, capture.with_(camera=alignment.camera)
        frames = self.renderer.render_views(resident, both)
        psnr = [score_view(view, with_exposure_of(frame["rgb"], view)).psnr for frame in frames]
        return both[psnr[1] > psnr[0]]

    def _advance(self, late: bool) -> None:
        """Run one iteration. late: whether the host may read its loss after later iterations have been
        submitted."""
        interrupts.check()
        state, settings = self._state, self.settings
        if self._failure is not None:
            raise self._failure
        if self.done:
            raise InputError(
                f"iterations must be more than the completed {self.iteration}, got {settings.iterations}"
            )
        while self._pending and self._pending[-1][0] > state.iteration:  # left by an interrupted iteration
            self._pending.pop()
        self._densify()
        iteration = state.iteration + 1
        number = self._view_at(iteration)
        self._use_camera(number)
        if settings.fit_exposures and (iteration - 1) % len(self.dataset.views) == 0:
            self._model.centre_exposures()
        try:
            loss, gradients = self._differentiated(iteration, number, waits=False)
        except CapacityExceeded:
            loss, gradients = self._differentiated(iteration, number, waits=True)
        self._pending.append((iteration, number, loss))
        full = len(self._pending) > self._model.max_pending_losses
        if not late or full or settings.densifies_after(iteration):
            self._read_losses()
        self._update(gradients, iteration, number)
        state.iteration = iteration
        state.history["counts"][iteration - 1] = len(self._model)

    def _read_losses(self) -> None:
        """Read pending losses into the history.

        Raises:
            TrainingError: one is not finite, now or in an earlier call.
        """
        while self._failure is None and self._pending:
            iteration, number, read = self._pending[0]
            view, loss = self.dataset.views[number].name, read()
            if not math.isfinite(loss.value):
                failure = TrainingError(
                    f"the loss is {loss.value} at iteration {iteration}, in the view {view}; "
                    + self._checkpoint_state()
                )
                self._pending.clear()
                if iteration > self.iteration:  # the splats have not been updated yet
                    raise failure
                self._failure = failure
            else:
                history = self._state.history
                history["losses"][iteration - 1], history["psnrs"][iteration - 1] = loss.value, loss.psnr
                self._unreported.append((iteration, view, loss))
                self._pending.popleft()
        if self._failure is not None:
            raise self._failure

    def _read_refinement(self) -> None:
        """Copy refined cameras and exposures from the device. Raises TrainingError if one is not finite."""
        self._model.read_refinement()
        if self._refinement is not None:
            for name, array in self._refinement.arrays().items():
                if not np.isfinite(array).all():
                    raise TrainingError(
                        f"the {name} of the views are not finite after iteration {self.iteration}; "
                        + self._checkpoint_state()
                    )

    def _use_camera(self, number: int) -> None:
        """Set the current camera in the captures of a training view."""
        camera = self._model.camera(number)
        if self._captures[number].camera is not camera:
            self._captures[number] = replace(self._captures[number], camera=camera)
            self._surface_captures[number] = replace(self._surface_captures[number], camera=camera)

    def _steps(self) -> Iterator[Step]:
        """Yield the finished steps that were not reported yet."""
        while self._unreported:
            iteration, view, loss = self._unreported.popleft()
            count = int(self._state.history["counts"][iteration - 1])
            yield Step(iteration, view, loss.value, loss.psnr, count)

    def _differentiated(self, iteration: int, number: int, waits: bool) -> tuple[Callable[[], Loss], Any]:
        """Render a view and differentiate its loss.

        waits: whether to wait for the device and enlarge buffers that are too small; False raises
            CapacityExceeded for these.

        Returns a function that reads the loss, and the gradients for `_update`.
        """
        resident = self._model.resident(self.settings.degree_at(iteration), self.dataset.origin)
        by_normals, by_distortions = self.settings.surface_weights_at(iteration)
        plain, surface = self._captures[number], self._surface_captures[number]
        features, prepared = prepare(resident, surface if by_normals else plain)
        if by_distortions:
            features = with_distortion(features)
        if features != self._features:
            self._features = features
            self._compile_next(iteration, plain, surface)
        pipeline = self._gradient_pipeline(features)
        prepared = self._model.refined_view(pipeline, prepared, number)
        images = pipeline.forward(resident, prepared, waits)
        loss, by_rgb = self._model.loss(images, number)
        by_images = {"rgb": by_rgb}
        if by_normals:
            by_images |= self._model.normal_loss_gradients(images, number, by_normals)
        if by_distortions:
            view = self.dataset.views[number]
            mask = np.ones(view.image.shape[:2], np.float32) if view.mask is None else view.mask
            by_images["distortion"] = mask * np.float32(by_distortions / mask.size)
        return loss, self._model.backward_per_tile(pipeline, images, by_images)

    def _compile_next(self, iteration: int, plain: Capture, surface: Capture) -> None:
        """Compile in the background the kernels for the next SH degree or the next additional loss."""
        if (change := self.settings.changes_after(iteration)) is None:
            return
        by_normals, by_distortions = self.settings.surface_weights_at(change)
        properties = _Properties(
            self.settings.degree_at(change), "all" if self.settings.axes == 3 else "none"
        )
        features = select(properties, surface if by_normals else plain)
        features = with_distortion(features) if by_distortions else features
        self.renderer.backend.compile_in_background(features, self._refinement is not None)

    def _checked_splats(self) -> Splats:
        self._read_losses()
        splats = self._model.read()
        splats.check(f"after iteration {self.iteration}; {self._checkpoint_state()}")
        return splats

    def _capture(self, view: TrainingView) -> Capture:
        background = self.dataset.background if view.background is None else view.background
        return Capture(view.camera, quality=self._quality, background=background)

    def _begin(self, start: SplatCloud | None, restart: bool) -> TrainingState:
        settings = self.settings
        if self.checkpoint is not None and self.checkpoint.exists() and not restart:
            title = self.renderer.device.title
            state, others = load_checkpoint(self.checkpoint, settings, self.dataset.digest, title)
            if others:
                warnings.warn(
                    f"{self.checkpoint} was made by {' and '.join(others)}; the run resumes, but its results "
                    "differ from those of an uninterrupted run; --overwrite starts again",
                    stacklevel=3,
                )
        else:
            dataset = self.dataset
            splats = (
                initial_splats(dataset, settings)
                if start is None
                else splats_from_cloud(start, settings, dataset.origin)
            )
            state = TrainingState.initial(splats)
        if self._refinement is not None and state.views:
            try:
                self._refinement.restore(state.views)
            except (ValueError, LookupError) as error:
                raise InputError(
                    f"cannot read {self.checkpoint} as a checkpoint: {error}; remove it, or give --overwrite "
                    "to start again"
                ) from error
        remaining = settings.iterations - state.iteration
        state.history = {
            name: np.append(a, np.zeros(remaining, a.dtype)) for name, a in state.history.items()
        }
        return state

    def _view_at(self, iteration: int) -> int:
        """Index of the view of an iteration; each epoch has a new random order."""
        count = len(self.dataset.views)
        epoch, index = divmod(iteration - 1, count)
        if self._order[0] != epoch:
            self._order = epoch, permutation(self.settings.seed, RandomStream.VIEWS, epoch, count)
        return int(self._order[1][index])

    def _densify(self) -> None:
        """Densify by the default strategy, before an iteration and not after the last one: the splats of a
        completed run are optimised and not reset, as in 2DGS."""
        settings, iteration = self.settings, self.iteration
        if settings.strategy == "mcmc" or not settings.densifies_after(iteration):
            return
        self._read_losses()
        splats = self._model.geometry()
        free = outside_boxes(splats.values["means"] + self.dataset.origin, self.dataset.boxes)
        change = densify.densification(splats, settings, iteration, self.dataset.extent, free)
        with self._all_or_failed():
            self._model.densify(change)
            if iteration % settings.reset_every == 0:
                self._model.reset_opacities()

    def _update(self, gradients: Any, iteration: int, number: int) -> None:
        """Update the splats and the view by Adam, unless densification by the default strategy follows, as in
        2DGS (whose new splats have no gradient yet)."""
        settings, mcmc_runs = self.settings, self.settings.strategy == "mcmc"
        origin, camera = self.dataset.origin, self._model.camera(number)
        if not mcmc_runs and settings.densifies_after(iteration):
            self._model.accumulate_statistics(gradients, camera, origin)
            return
        counted = camera if not mcmc_runs and iteration < settings.densify_until else None
        rate = learning_rates(settings, iteration, self.dataset.extent)
        view_step = None
        if self._refinement is not None:
            view_step = ViewStep(number, iteration, self._view_at(iteration + 1))
        self._model.step(gradients, rate, settings.adam_steps(iteration), counted, origin, view_step)
        if mcmc_runs:
            with self._all_or_failed():
                if settings.densifies_after(iteration):
                    self._model.load(mcmc.relocate_and_grow(self._model.read(), settings, iteration))
                self._model.add_noise(iteration, rate["means"])

    @contextmanager
    def _all_or_failed(self) -> Iterator[None]:
        """Context manager that makes later steps fail if densification is interrupted (for instance by too
        little memory), as arrays may then have different lengths."""
        try:
            yield
        except BaseException:
            self._failure = TrainingError(
                f"densification was interrupted after iteration {self.iteration}; "
                + self._checkpoint_state("")
            )
            raise

    def _checkpoint_state(self, advice: str = "; lower the rates, or check the data set's cameras") -> str:
        if self.checkpoint is None or not self.checkpoint.exists():
            return f"there is no checkpoint{advice}"
        return f"the last checkpoint {self.checkpoint} is complete"
