"""Replayed steps and deferred losses: bit-identical to steps that are recorded and waited for."""

import math
import threading

import numpy as np
import pyopencl as cl
import pytest
from training_scene import QUICK, scene

import fidsplat as fs
from fidsplat.backends.gradients import CapacityExceeded
from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.gradients import OpenCLGradients
from fidsplat.backends.opencl.recorded_frame import RecordedFrame
from fidsplat.backends.prepare import prepare
from fidsplat.train import Trainer, TrainingError
from fidsplat.train.losses import Loss

BACKEND = "opencl"
STEADY = {**QUICK, "iterations": 40, "densify_from": 99, "sh_degree": 1}
REFINED = {"refine_poses": True, "refine_intrinsics": True, "fit_exposures": True}


@pytest.fixture
def on_groups(renderer, monkeypatch):
    """The device with the schedule of GPUs, whose images no one waits for."""
    backend = renderer.backend
    monkeypatch.setattr(backend, "config", next(iter(backend.configs("schedule").values())))
    backend.limit_memory(backend.memory_budget)
    yield renderer
    monkeypatch.undo()
    backend.limit_memory(backend.memory_budget)


@pytest.fixture(scope="module")
def dataset():
    return scene()


def splats_of(trainer):
    return {name: array.tobytes() for name, array in trainer._model.read().values.items()}


def views_of(trainer):
    """Refined poses, intrinsics and exposures."""
    cameras = [view.camera for view in trainer.views]
    poses = [camera.world_to_camera.tobytes() for camera in cameras]
    intrinsics = [(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras]
    return poses, intrinsics, trainer.exposures.tobytes()


@pytest.mark.parametrize("refined", [{}, REFINED])
def test_replayed_steps_are_bit_identical(on_groups, dataset, monkeypatch, refined):
    """Also after frames of another kind, and after their buffers are released."""
    again, planned = (Trainer(dataset, on_groups, **STEADY, **refined) for _ in range(2))
    launched, unrefined = [], views_of(again)
    for _ in range(8):
        again.step()
    record = CommandList.record
    monkeypatch.setattr(CommandList, "record", lambda *given: launched.append(given[1]) or record(*given))
    for _ in range(6):  # not to iteration 16, where the degree grows
        again.step()
    assert {*launched} <= {"refine_intrinsics"}  # first at iteration 11
    launched.clear()
    again.evaluate()
    on_groups.backend.release_scratch()
    assert launched
    for _ in range(6):
        again.step()
    launched.clear()
    again.step()
    assert not {*launched} - {"refine_intrinsics"}
    again.run()
    never_replay(monkeypatch)
    monkeypatch.setattr(CommandList, "set", set_all)
    planned.run()
    assert splats_of(again) == splats_of(planned)
    assert views_of(again) == views_of(planned)
    assert all(a != b for a, b in zip(views_of(again), unrefined, strict=True)) == bool(refined)
    for name, array in planned.history.items():
        np.testing.assert_array_equal(again.history[name], array)


def never_replay(monkeypatch):
    """Record every frame and every step."""
    monkeypatch.setattr(RecordedFrame, "set_view", lambda *_: False)
    monkeypatch.setattr(CommandList, "key", property(lambda _: object(), lambda *_: None), raising=False)


set_changed = CommandList.set


def set_all(self, values):
    """Set every argument, whatever it was."""
    self._named = {}
    for command in self._commands:
        command._bound = [object()] * len(command._bound)
    set_changed(self, values)


def test_a_replayed_frame_that_exceeds_its_capacity_is_rendered_again(on_groups, monkeypatch):
    """Larger splats cover more tiles: the replay exceeds its capacity, and the frame is rendered again."""
    wide, losses, refused = scene(size=(80, 64)), [], []
    check_capacity = OpenCLGradients._check_capacity

    def checked(self, frame):
        try:
            return check_capacity(self, frame)
        except CapacityExceeded:
            refused.append(frame)
            raise

    monkeypatch.setattr(OpenCLGradients, "_check_capacity", checked)
    for keeps_capacity in (True, False):
        if not keeps_capacity:
            never_replay(monkeypatch)
        trainer = Trainer(wide, on_groups, **STEADY)
        kernels, splats = trainer._model._kernels, trainer._model.read()
        splats.values["log_scales"] -= np.float32(2.5)
        trainer._model.load(splats)
        for _ in range(6):
            trainer.step()
        large = np.exp(trainer._model.read().values["log_scales"] + np.float32(2.5))
        cl.enqueue_copy(on_groups.backend.queue, kernels._bound["activated_scales"], large)
        losses.append([trainer.step().loss for _ in range(3)])
        assert len(refused) == 1
    assert losses[0] == losses[1]


@pytest.mark.parametrize("refined", [{}, REFINED])
def test_steps_are_the_same_if_they_are_reported_later(renderer, dataset, refined):
    """At the end of a run all are reported, in their order."""
    settings = {**QUICK, **refined, "iterations": 40}
    prompt, late, at_once = (Trainer(dataset, renderer, **settings) for _ in range(3))
    reported, ahead = [], []
    prompt.run(lambda step: ahead.append(prompt.iteration - step.iteration))
    late.run(reported.append, prompt=False)
    steps = [at_once.step() for _ in range(40)]
    assert reported == steps
    assert set(ahead) == {0}
    assert splats_of(prompt) == splats_of(late) == splats_of(at_once)
    assert views_of(prompt) == views_of(late) == views_of(at_once)


def test_a_step_reads_no_refined_camera(renderer, dataset, monkeypatch):
    """Only a report reads them from the device, which a step would wait for."""
    trainer = Trainer(dataset, renderer, **STEADY, **REFINED)
    read, reads = trainer._model.read_refinement, []
    monkeypatch.setattr(trainer._model, "read_refinement", lambda: reads.append(trainer.iteration) or read())
    for _ in range(12):
        trainer.step()
    assert not reads
    trainer.pose_changes()
    assert reads == [12]


def test_a_late_loss_that_is_not_finite_has_its_iteration_and_keeps_the_checkpoint(
    renderer, dataset, tmp_path, monkeypatch
):
    """Others have followed by then: there is no step, no file and no checkpoint any more."""
    file = tmp_path / "scene.training.npz"
    trainer = Trainer(dataset, renderer, checkpoint=file, **STEADY)
    trainer.step()
    trainer.save_checkpoint()
    contents, loss, views = file.read_bytes(), trainer._model.loss, []

    def failing(images, view):
        value, slope = loss(images, view)
        views.append(dataset.views[view].name)
        if len(views) == 4:
            value = lambda: Loss(math.nan, 0.1)  # noqa: E731
        return value, slope

    monkeypatch.setattr(trainer._model, "loss", failing)
    monkeypatch.setattr("fidsplat.train.trainer._READ_SECONDS", 60.0)
    with pytest.raises(
        TrainingError, match=r"the loss is nan at iteration 5, in the view (\S+); .*is complete"
    ) as caught:
        trainer.run()
    assert f"in the view {views[3]}" in str(caught.value)
    assert len(views) > 5
    for after in (trainer.step, trainer.run, trainer.cloud, trainer.save_checkpoint, lambda: trainer.history):
        with pytest.raises(TrainingError, match="at iteration 5"):
            after()
    assert file.read_bytes() == contents
    again = Trainer(dataset, renderer, checkpoint=file, **STEADY)
    assert again.iteration == 1


def test_an_interrupt_during_compilation_leaves_the_statistics_unchanged(renderer, dataset, monkeypatch):
    uninterrupted, stopped = (Trainer(dataset, renderer, **STEADY) for _ in range(2))
    uninterrupted.step()

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(OpenCLGradients, "compile_step", interrupted)
        with pytest.raises(KeyboardInterrupt):
            stopped.step()
    stopped.step()
    ours, theirs = (trainer._model.read() for trainer in (stopped, uninterrupted))
    assert np.array_equal(ours.visible_counts, theirs.visible_counts)
    assert np.array_equal(ours.gradient_sums, theirs.gradient_sums)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_a_failed_densification_keeps_the_checkpoint(renderer, dataset, tmp_path, monkeypatch, strategy):
    """Arrays of two lengths are neither rendered nor saved: the last checkpoint remains, and yields the
    same run."""
    settings = {**QUICK, "iterations": 24, "sh_degree": 1, "strategy": strategy, "growth": 1.5}
    file, pool = tmp_path / "run.training.npz", renderer.backend.pool
    uninterrupted = Trainer(dataset, renderer, **settings)
    uninterrupted.run()
    trainer, fresh, requested = Trainer(dataset, renderer, checkpoint=file, **settings), pool.allocate, []
    for _ in range(15):
        trainer.step()
    trainer.save_checkpoint()
    contents = file.read_bytes()

    def full(name, size):
        requested.append(name)
        if len(requested) == 4:
            raise fs.DeviceError("no memory")
        return fresh(name, size)

    with monkeypatch.context() as patch:
        patch.setattr(pool, "allocate", full)
        with pytest.raises(fs.DeviceError, match="no memory"):
            trainer.run()
    for after in (trainer.step, trainer.run, trainer.cloud, trainer.save_checkpoint):
        with pytest.raises(TrainingError, match=r"densification was interrupted .* is complete"):
            after()
    assert file.read_bytes() == contents
    again = Trainer(dataset, renderer, checkpoint=file, **settings)
    again.run()
    assert splats_of(again) == splats_of(uninterrupted)


def test_an_interrupt_keeps_pending_losses(renderer, dataset, monkeypatch):
    uninterrupted, stopped = (Trainer(dataset, renderer, **STEADY) for _ in range(2))
    uninterrupted.run()
    monkeypatch.setattr("fidsplat.train.trainer._READ_SECONDS", 60.0)
    make, calls = stopped._model.step, []

    def interrupted(*given):
        make(*given)
        calls.append(None)
        if len(calls) == 20:
            raise KeyboardInterrupt

    monkeypatch.setattr(stopped._model, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        stopped.run()
    done = stopped.iteration
    assert done == 19
    np.testing.assert_array_equal(stopped.history["losses"], uninterrupted.history["losses"][:done])


@pytest.mark.parametrize("losses", [{}, {"normal_from": 24, "distortion_from": 30, "distortion_weight": 1.0}])
def test_upcoming_kernels_are_compiled_in_the_background(renderer, dataset, monkeypatch, losses):
    """Each set of kernels before the first iteration that renders by it, and all that are rendered by."""
    begun, rendered = [], []
    backend = renderer.backend
    differentiate = backend.gradient_pipeline
    monkeypatch.setattr(
        backend, "compile_in_background", lambda features, _: begun.append((trainer.iteration + 1, features))
    )
    trainer = Trainer(dataset, renderer, **{**STEADY, "sh_degree": 2, **losses})
    monkeypatch.setattr(
        trainer, "_gradient_pipeline", lambda features: rendered.append(features) or differentiate(features)
    )
    trainer.run()
    expected = list(dict.fromkeys(rendered))
    assert [features for _, features in begun] == expected[1:]
    changes = [1, 16, 25, 31] if losses else [1, 16]
    assert [iteration for iteration, _ in begun] == changes


def test_background_compilation_returns_kernels_and_errors(renderer, dataset, monkeypatch):
    """What fails there is an error where it is needed."""
    backend = renderer.backend
    capture = fs.Capture(dataset.views[0].camera, quality="surfel")
    cloud = fs.marker("apriltag:36h11:5", size=0.16, mixture="fitted").cloud
    features, _ = prepare(cloud, capture)
    monkeypatch.setattr(backend, "_gradients", {})
    where, pipeline = [], backend.pipeline

    def seen(*given):
        where.append(threading.current_thread())
        return pipeline(*given)

    monkeypatch.setattr(backend, "pipeline", seen)
    for _ in range(2):
        backend.compile_in_background(features)
    actual = backend.gradient_pipeline(features)
    assert backend.gradient_pipeline(features) is actual
    assert [thread is threading.main_thread() for thread in where] == [False, True, True]
    backend.compile_in_background(features)  # it is there
    assert len(where) == 3

    monkeypatch.setattr(backend, "_gradients", {})

    def failing(*_):
        raise fs.DeviceError("no compiler")

    monkeypatch.setattr(backend, "pipeline", failing)
    backend.compile_in_background(features)
    with pytest.raises(fs.DeviceError, match="no compiler"):
        backend.gradient_pipeline(features)
