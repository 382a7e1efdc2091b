"""Training runs: they raise the PSNR, write the same bytes twice and after an interruption, and lose
nothing."""

import hashlib
import json
import os
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from training_scene import BACKGROUND, QUICK, scene

import fidsplat as fs
from fidsplat.backends.gradients import CapacityExceeded
from fidsplat.train import Trainer, TrainingError, TrainSettings, splats_of, splats_within

ITERATIONS = 26


@pytest.fixture(scope="module")
def dataset():
    return scene()


@pytest.fixture(scope="module")
def whole(dataset, tmp_path_factory):
    """A run from its beginning to its end: the trainer, its steps, the PSNR at first, its file."""
    trainer = Trainer(dataset, fs.Renderer("reference"), iterations=ITERATIONS, **QUICK)
    shares = []
    at_first = trainer.evaluate(dataset.views, lambda step, fraction: shares.append(fraction))
    assert shares == [(k + 1) / len(dataset.views) for k in range(len(dataset.views))]
    steps = []
    trainer.run(steps.append)
    file = tmp_path_factory.mktemp("whole") / "scene.ply"
    trainer.save(file)
    return trainer, steps, at_first, file


def sha(file):
    return hashlib.sha256(file.read_bytes()).hexdigest()


def mean_psnr(scores):
    return np.mean([score.psnr for score in scores])


def test_splats_in_the_boxes_of_markers_are_not_saved(dataset, tmp_path):
    """Training itself is the same: the other splats have the same values."""
    renderer = fs.Renderer("reference")
    box = np.array([[0.3, 0.1, 0, 0.2], [-0.1, 0.3, 0, 0], [0, 0, 0.4, 0.1], [0, 0, 0, 1]])
    complete = Trainer(dataset, renderer, iterations=2, **QUICK).run()
    trainer = Trainer(replace(dataset, boxes=(box,)), renderer, iterations=2, **QUICK)
    trainer.run()
    trainer.save(tmp_path / "scene.ply")
    saved = fs.load_ply(tmp_path / "scene.ply")
    local = (complete.world_means() - box[:3, 3]) @ np.linalg.inv(box[:3, :3]).T
    beside = (np.abs(local[:, :2]) > 1).any(1)
    outside = beside | (local[:, 2] > 1) | (local[:, 2] < -6)  # up to 6 half thicknesses in front
    assert 0 < outside.sum() < len(outside)
    np.testing.assert_array_equal(saved.means, complete.means[outside])
    np.testing.assert_allclose(saved.opacities, complete.opacities[outside], rtol=1e-6)  # files have logits
    with pytest.raises(fs.InputError, match="a box of tiny must be an invertible matrix"):
        replace(dataset, boxes=(np.zeros((4, 4)),))


def test_a_view_may_have_a_background_of_its_own(dataset):
    trainer = Trainer(dataset, fs.Renderer("reference"), iterations=1, **QUICK)
    views = (dataset.views[0], replace(dataset.views[0], background=(1.0, 0.0, 1.0)))
    common, own = (score.image / 255.0 for score in trainer.evaluate(views))
    alpha = trainer.renderer.render(trainer.cloud(), dataset.views[0].camera, outputs=("alpha",))["alpha"]
    difference = (1 - alpha[..., None]) * (np.array((1.0, 0.0, 1.0)) - BACKGROUND)
    np.testing.assert_allclose(own - common, difference, atol=1.2 / 255)  # both are rounded
    digests = {replace(dataset, views=(view, *dataset.views[1:])).digest for view in views}
    assert len(digests) == 2


def test_training_raises_the_psnr_and_lowers_the_loss(whole, dataset):
    """By 3 dB on the views that are trained on, and 1 dB on one that is not."""
    trainer, steps, at_first, _ = whole
    assert mean_psnr(trainer.evaluate(dataset.views)) > mean_psnr(at_first) + 3
    start = Trainer(dataset, trainer.renderer, iterations=1, **QUICK)
    assert mean_psnr(trainer.evaluate()) > mean_psnr(start.evaluate()) + 1
    losses = trainer.history["losses"]
    assert losses[-8:].mean() < 0.8 * losses[:8].mean()
    assert [step.iteration for step in steps] == list(range(1, ITERATIONS + 1))
    for first in range(0, 24, 4):  # every view once, then every view again
        assert {step.view for step in steps[first : first + 4]} == {"1.png", "2.png", "3.png", "4.png"}
    counts = trainer.history["counts"]
    assert counts[0] == 16
    assert 16 < counts[-1] <= 30
    assert len(trainer.cloud()) == counts[-1]


def test_a_run_that_was_stopped_goes_on_to_the_same_bytes(whole, dataset, tmp_path):
    """Interrupted between two checkpoints, within sums of gradients, and continued with more iterations."""
    renderer, checkpoint = whole[0].renderer, tmp_path / "scene.training.npz"
    first = Trainer(dataset, renderer, iterations=20, checkpoint=checkpoint, **QUICK)
    for _ in range(13):
        first.step()
    first.save_checkpoint()
    first.step()  # lost
    again = Trainer(dataset, renderer, iterations=ITERATIONS, checkpoint=checkpoint, **QUICK)
    assert again.iteration == 13
    again.run()
    again.save(tmp_path / "scene.ply")
    assert sha(tmp_path / "scene.ply") == sha(whole[3])
    for name, array in whole[0].history.items():
        np.testing.assert_array_equal(again.history[name], array)
    done = Trainer(dataset, renderer, iterations=ITERATIONS, checkpoint=checkpoint, **QUICK)
    assert done.done
    done.save(tmp_path / "scene.ply")
    assert sha(tmp_path / "scene.ply") == sha(whole[3])


def test_a_frame_that_exceeds_its_capacity_is_rendered_again(whole, dataset, tmp_path):
    """A device that did not wait detects the error when it reads the image: the run writes the same bytes."""
    trainer, refused = Trainer(dataset, whole[0].renderer, iterations=ITERATIONS, **QUICK), []
    differentiate = trainer._gradient_pipeline

    class Narrow:
        """A pipeline in which every third image that no one waits for has too little room."""

        def __init__(self, features):
            self.own = differentiate(features)

        def forward(self, resident, view, waits=True):
            self.waits = waits
            return self.own.forward(resident, view, waits)

        def backward(self, images, gradients):
            if trainer.iteration % 3 == 0 and not self.waits:
                refused.append(trainer.iteration)
                raise CapacityExceeded
            return self.own.backward(images, gradients)

    trainer._gradient_pipeline = Narrow
    trainer.run()
    trainer.save(tmp_path / "scene.ply")
    assert refused == list(range(0, ITERATIONS, 3))
    assert sha(tmp_path / "scene.ply") == sha(whole[3])


def test_a_run_that_ends_where_opacities_fall_keeps_its_own(whole, dataset, tmp_path):
    """Splats are added and opacities reset at iteration 16, where the resumed run starts."""
    checkpoint = tmp_path / "scene.training.npz"
    renderer = whole[0].renderer
    ended = Trainer(dataset, renderer, iterations=16, checkpoint=checkpoint, **QUICK)
    assert ended.run().opacities.max() > QUICK["reset_opacity"] + 0.1
    with pytest.raises(fs.InputError, match="iterations must be more than the completed 16"):
        ended.step()
    again = Trainer(dataset, renderer, iterations=ITERATIONS, checkpoint=checkpoint, **QUICK)
    again.run()
    again.save(tmp_path / "scene.ply")
    assert sha(tmp_path / "scene.ply") == sha(whole[3])


@pytest.mark.parametrize(
    ("every", "expected"), [(8, [8, 16, 24]), (16, [16]), (24, [24]), (12, [24]), (9, [])]
)
def test_opacities_are_reset_at_multiples_of_an_interval_that_densification_follows(
    dataset, every, expected, monkeypatch
):
    trainer = Trainer(
        dataset, fs.Renderer("reference"), iterations=ITERATIONS, **QUICK | {"reset_every": every}
    )
    results, limit = [], QUICK["reset_opacity"] + 1e-6
    reset = type(trainer._model).reset_opacities

    def counted(model):
        reset(model)
        results.append(trainer.iteration)
        assert model.read().opacities.max() <= limit

    monkeypatch.setattr(type(trainer._model), "reset_opacities", counted)
    trainer.run()
    assert results == expected


def test_a_run_that_restarts_keeps_the_old_checkpoint_until_it_has_its_own(dataset, tmp_path):
    file, renderer = tmp_path / "scene.training.npz", fs.Renderer("reference")
    Trainer(dataset, renderer, iterations=2, checkpoint=file, **QUICK).run()
    digest = sha(file)
    again = Trainer(dataset, renderer, iterations=2, checkpoint=file, restart=True, seed=1, **QUICK)
    assert again.iteration == 0
    again.step()
    assert sha(file) == digest
    again.run()
    assert sha(file) != digest
    with pytest.raises(fs.InputError, match="must be a regular file"):  # before any work
        Trainer(dataset, renderer, checkpoint=tmp_path, **QUICK)


KILLED = """
import fidsplat as fs
from fidsplat.train import Trainer, trainer
from training_scene import QUICK, scene

trainer.CHECKPOINT_SECONDS = 0
run = Trainer(scene(), fs.Renderer("reference"), checkpoint="scene.training.npz", iterations=20, **QUICK)
run.run(lambda step: print(step.iteration, flush=True))
"""


def test_a_run_that_was_killed_goes_on_to_the_same_bytes(whole, dataset, tmp_path):
    """At some moment of an iteration or of the writing of a checkpoint."""
    path = os.pathsep.join([str(Path(__file__).parents[1]), str(Path(fs.__file__).parents[1])])
    child = subprocess.Popen(
        [sys.executable, "-c", KILLED],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        text=True,
    )
    with child:
        assert child.stdout is not None
        while child.stdout.readline().strip() != "11":
            assert child.poll() is None
        child.kill()
    checkpoint = tmp_path / "scene.training.npz"
    again = Trainer(dataset, whole[0].renderer, iterations=ITERATIONS, checkpoint=checkpoint, **QUICK)
    assert 10 <= again.iteration < 20
    again.run()
    again.save(tmp_path / "scene.ply")
    assert sha(tmp_path / "scene.ply") == sha(whole[3])


def test_a_run_says_that_a_checkpoint_is_of_another_device_or_other_sources(dataset, tmp_path, monkeypatch):
    file, renderer = tmp_path / "scene.training.npz", fs.Renderer("reference")
    settings = {"iterations": 2, "checkpoint": file, **QUICK}
    Trainer(dataset, renderer, **settings).run()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert Trainer(dataset, renderer, **settings).done
    monkeypatch.setattr("fidsplat.train.checkpoint.code_hash", lambda: "f00d")
    with pytest.warns(UserWarning, match=r"another fidsplat \(.*, not .*f00d\); the run resumes") as caught:
        assert Trainer(dataset, renderer, **settings).done
    assert "another device" not in str(caught[0].message)
    file.unlink()
    Trainer(dataset, renderer, **settings).run()
    monkeypatch.setattr(renderer.backend, "info", replace(renderer.device, title="abacus"))
    with pytest.warns(UserWarning, match=r"another device \(.*, not abacus\); the run resumes"):
        assert Trainer(dataset, renderer, **settings).done


def test_a_checkpoint_of_another_run_is_refused(dataset, tmp_path):
    file = tmp_path / "scene.training.npz"
    renderer = fs.Renderer("reference")
    trainer = Trainer(dataset, renderer, iterations=3, checkpoint=file, **QUICK)
    trainer.run()
    for change, words in (
        ({"seed": 1}, r"another seed \(0, not 1\)"),
        ({"iterations": 2}, "number of iterations"),
        ({"strategy": "mcmc"}, "another strategy"),
    ):
        with pytest.raises(fs.InputError, match=words):
            Trainer(dataset, renderer, checkpoint=file, **{"iterations": 3, **QUICK, **change})
    with pytest.raises(fs.InputError, match="another data set"):
        Trainer(scene(views=3), renderer, checkpoint=file, iterations=3, **QUICK)
    contents = file.read_bytes()
    flag = contents.index(b"PK\1\2") + 8
    np.save(tmp_path / "array.npy", np.zeros(3))
    for damaged in (
        contents[:200],
        contents[:flag] + b"\1" + contents[flag + 1 :],  # says that it is encrypted
        (tmp_path / "array.npy").read_bytes(),
    ):
        file.write_bytes(damaged)
        with pytest.raises(fs.InputError, match=r"cannot read .* as a checkpoint"):
            Trainer(dataset, renderer, checkpoint=file, iterations=3, **QUICK)


def test_a_checkpoint_whose_arrays_do_not_fit_is_refused(dataset, tmp_path):
    """Raised before a device writes beyond a buffer that is too short, or trains on misread data."""
    file, renderer = tmp_path / "scene.training.npz", fs.Renderer("reference")
    settings = {"iterations": 4, "checkpoint": file, **QUICK}
    Trainer(dataset, renderer, iterations=3, checkpoint=file, **QUICK).run()
    arrays = dict(np.load(file))
    facts = json.loads(arrays["facts"].tobytes())

    def refused(words, changes, of_viewer=False):
        np.savez(file, **{name: array for name, array in (arrays | changes).items() if array is not None})
        with pytest.raises(fs.InputError, match=f"{words}.*remove it, or give --overwrite"):
            Trainer(dataset, renderer, **settings)
        if of_viewer:
            with pytest.raises(fs.InputError, match=words):
                splats_of(file)

    for name, array in arrays.items():
        if name == "facts":
            continue
        spoiled = np.full_like(array, np.nan) if array.dtype.kind == "f" else array.astype(np.float32)
        shown = name.startswith("values.")
        refused(f"the array '{name}' is missing|{name}", {name: None}, shown)
        refused(f"{name} must be|its splats must be", {name: array[None]}, shown)
        refused(f"{name} must be", {name: array.astype(np.float64)}, shown)
        refused(f"{name} must be", {name: spoiled}, shown)
        if name != "values.means":
            refused(f"{name} must be .* of the shape", {name: array[:-1]}, shown)
        if name in ("gradients", "seen") or name.startswith("second."):
            refused("must be at least 0, got -1", {name: np.full_like(array, -1)})
    for change in (
        {"iteration": 2.5},
        {"iteration": -1},
        {"iteration": True},
        {"by": None},
        {"settings": []},
    ):
        refused("", {"facts": np.frombuffer(json.dumps(facts | change).encode(), np.uint8)})
    more = {name: np.concatenate([array] * 2) for name, array in arrays.items() if len(array) == 16}
    refused("at most max_splats, 30, got 32", more)


def test_a_data_set_has_the_digest_of_all_that_training_depends_on(dataset):
    """One change at a time, so that each is tested."""

    def other(place, **changes):
        views = list(dataset.views)
        views[place] = replace(views[place], **changes)
        return replace(dataset, views=tuple(views)).digest

    view, points = dataset.views[1], dataset.points.copy()
    picture, colors, mask = view.image.copy(), dataset.colors.copy(), np.ones(view.image.shape[:2], bool)
    picture[3, 4, 1] ^= 1
    points[5, 2] += 1e-9
    colors[5, 2] ^= 1
    hole = mask.copy()
    hole[3, 4] = False
    pose = view.camera.world_to_camera.copy()
    pose[0, 3] += 1e-9
    names = ("fx", "fy", "cx", "cy", "near")
    digests = [
        dataset.digest,
        other(1, name="other.png"),
        other(1, image=picture),
        other(1, mask=mask),
        other(1, mask=hole),
        other(2, mask=mask),
        other(1, camera=replace(view.camera, world_to_camera=pose)),
        other(1, camera=replace(view.camera, far=100.0)),
        *(other(1, camera=replace(view.camera, **{n: getattr(view.camera, n) * 1.001})) for n in names),
        replace(dataset, points=points).digest,
        replace(dataset, colors=colors).digest,
        replace(dataset, background=(0.2, 0.3, 0.41)).digest,
        replace(dataset, views=dataset.views[::-1]).digest,
    ]
    assert len(set(digests)) == len(digests)
    assert scene().digest == dataset.digest


def test_steps_of_adam_are_those_of_iterations_that_make_no_splats():
    for strategy, start, until, every in (("default", 7, 40, 8), ("default", 8, 24, 8), ("mcmc", 7, 40, 8)):
        settings = TrainSettings(
            strategy=strategy,
            densify_from=start,
            densify_until=until,
            relocate_until=until,
            densify_every=every,
        )
        rests = [strategy == "default" and settings.densifies_after(i) for i in range(1, 61)]
        steps = np.cumsum(np.logical_not(rests))
        assert [settings.adam_steps(i) for i in range(1, 61)] == steps.tolist()
        assert strategy == "mcmc" or any(rests)
    settings = TrainSettings(densify_until=0)
    assert settings.adam_steps(5000) == 5000


def test_what_is_not_finite_ends_the_run_and_leaves_the_checkpoint(dataset, tmp_path, monkeypatch):
    file = tmp_path / "scene.training.npz"
    renderer = fs.Renderer("reference")
    trainer = Trainer(dataset, renderer, iterations=9, checkpoint=file, **QUICK)
    trainer.step()
    synced = []
    monkeypatch.setattr(os, "fsync", synced.append)
    trainer.save_checkpoint()
    assert len(synced) == 2  # the file and its folder: a power cut loses neither
    digest = sha(file)
    splats = trainer._model.read()
    splats.values["sh"][:] = np.nan
    with pytest.raises(TrainingError, match=r"the loss is nan at iteration 2.*is complete"):
        trainer.run()
    with pytest.raises(TrainingError, match=r"sh of 16 splats .* are not finite after iteration 1"):
        trainer.save_checkpoint()
    assert sha(file) == digest
    alone = Trainer(dataset, renderer, iterations=9, **QUICK)
    alone._model.read().values["means"][3] = np.nan
    with pytest.raises(TrainingError, match=r"means of 1 splats \(the first is 3\).*there is no checkpoint"):
        alone.save(tmp_path / "scene.ply")
    assert [each.name for each in tmp_path.iterdir()] == [file.name]


def test_a_full_disk_leaves_the_last_checkpoint(dataset, tmp_path, monkeypatch):
    file = tmp_path / "scene.training.npz"
    trainer = Trainer(dataset, fs.Renderer("reference"), iterations=9, checkpoint=file, **QUICK)
    trainer.save_checkpoint()
    digest = sha(file)

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(fs.InputError, match="No space left on device"):
        trainer.save_checkpoint()
    assert sha(file) == digest
    assert [each.name for each in tmp_path.iterdir()] == [file.name]


def test_memory_that_runs_out_leaves_the_last_checkpoint(whole, dataset, tmp_path, monkeypatch):
    """The same command resumes from the checkpoint, with the same bytes as a run on an empty disk."""
    _, _, _, file = whole
    checkpoint, renderer = tmp_path / "run.training.npz", fs.Renderer("reference")
    trainer = Trainer(dataset, renderer, iterations=ITERATIONS, checkpoint=checkpoint, **QUICK)
    while trainer.iteration < 10:
        trainer.step()
    trainer.save_checkpoint()

    def full(*_):
        raise fs.DeviceError("no memory for moments (12 MiB)")

    monkeypatch.setattr(trainer._model, "accumulate_statistics", full)
    with pytest.raises(fs.DeviceError, match="no memory for moments"):
        trainer.run()
    assert not list(tmp_path.glob("*.tmp*"))
    again = Trainer(dataset, renderer, iterations=ITERATIONS, checkpoint=checkpoint, **QUICK)
    assert again.iteration == 10
    again.run()
    again.save(tmp_path / "again.ply")
    assert sha(tmp_path / "again.ply") == sha(file)


def test_mcmc_grows_to_its_limit(dataset):
    trainer = Trainer(
        dataset,
        fs.Renderer("reference"),
        iterations=10,
        strategy="mcmc",
        growth=1.5,
        **{**QUICK, "max_splats": 18},
    )
    trainer.run()
    assert trainer.history["counts"].tolist() == [16] * 7 + [18] * 3


def test_mcmc_begins_with_splats_that_learn_their_size(dataset):
    """Behind the low-pass `screen` scales far below a pixel have no gradient: splats as small as gsplat's
    first ones, which are 0.002 in the end, never grow to the 0.08 to 0.2 of those in the images."""
    rates = {"sh_degree": 0, "color_rate": 0.05, "scale_rate": 0.05}
    trainer = Trainer(dataset, fs.Renderer("opencl"), iterations=150, strategy="mcmc", **rates)
    assert 0.08 < np.median(trainer.run().scales) < 0.2


def test_settings_and_devices_that_cannot_be_used_are_named(dataset):
    with pytest.raises(fs.InputError, match="did you mean 'iterations'"):
        Trainer(dataset, fs.Renderer("reference"), iteration=3)
    with pytest.raises(fs.InputError, match="samples must be 1 for gradients, got 2"):
        Trainer(dataset, fs.Renderer("reference"), iterations=1, quality="surfel,samples=2").step()


def test_a_run_may_start_from_splats(whole, dataset):
    cloud = whole[0].cloud()
    start = Trainer(dataset, whole[0].renderer, iterations=5, start=cloud, **QUICK)
    again = start.cloud()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(again, name), getattr(cloud, name), rtol=1e-5, atol=1e-6)
    assert start.step().psnr > whole[0].history["psnrs"][:4].mean() + 1
    boxes = cloud.with_boxes(np.arange(len(cloud)) < 1)
    with pytest.raises(fs.InputError, match="start must be a cloud of disks"):
        Trainer(dataset, whole[0].renderer, iterations=5, start=boxes)
    third = np.where(np.arange(len(cloud)) % 3, 0.05, 0)
    solid = fs.SplatCloud(
        cloud.means, cloud.quats, np.column_stack([cloud.scales, third]), cloud.opacities, sh=cloud.sh
    )
    with pytest.raises(fs.InputError, match="train 3D Gaussians with primitive='3d'"):
        Trainer(dataset, whole[0].renderer, iterations=5, start=solid)
    start = Trainer(
        dataset, whole[0].renderer, iterations=9, start=solid, primitive="3d", **QUICK | {"max_splats": 60}
    )
    np.testing.assert_allclose(start.cloud().thickness[third > 0], 0.05, rtol=1e-5)
    grown = start.run()
    assert len(grown) > len(solid)
    assert (grown.thickness > 0).all()
    with pytest.raises(fs.InputError, match="start must have 1 to 3 splats"):
        Trainer(dataset, whole[0].renderer, iterations=5, max_splats=3, start=cloud)


def test_memory_bounds_the_number_of_splats(dataset):
    settings = splats_within(TrainSettings(), 2**30, dataset)
    assert 400_000 < settings.max_splats < 700_000
    assert splats_within(TrainSettings(sh_degree=0), 2**30, dataset).max_splats == 1_000_000
    with pytest.raises(fs.InputError, match=r"must be more than .* of the images"):
        splats_within(TrainSettings(), 1000, dataset)


def test_scores_are_those_of_the_rendered_images(whole, dataset):
    score = whole[0].evaluate()[0]
    difference = score.image / 255.0 - dataset.held_out[0].image / 255.0
    assert score.psnr == pytest.approx(-10 * np.log10((difference**2).mean()))
    assert 0 < score.ssim < 1
    assert json.dumps([score.name, score.psnr, score.ssim])
