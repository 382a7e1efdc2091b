"""Kernels of training: they agree with NumPy, and the depth losses have their intended effect."""

import numpy as np
import pytest
from derivative_errors import COSINE, NORM, derivatives, differences, random_scene
from training_scene import QUICK, scene

import fidsplat as fs
from fidsplat.backends.prepare import prepare
from fidsplat.backends.reference.backend import ReferenceBackend
from fidsplat.effects.differentiable import with_distortion
from fidsplat.train import Trainer, TrainSettings, densify
from fidsplat.train.host_model import HostModel
from fidsplat.train.losses import normal_loss

BACKEND = "opencl"
ITERATIONS = 40


@pytest.fixture(scope="module")
def dataset():
    return scene()


SOLID = {"distortion_weight": 50.0, "distortion_from": 2, "normal_weight": 0.5, "normal_from": 2}


@pytest.mark.parametrize("losses", [{}, SOLID, {"primitive": "3d"}])
def test_kernels_and_numpy_train_alike(renderer, dataset, monkeypatch, losses):
    """Ten steps by the kernels and by their twins, which round otherwise."""
    steps = {}
    settings = {**QUICK, "densify_from": 99, **losses}
    for name in ("kernels", "numpy"):
        if name == "numpy":
            has = renderer.backend.has
            monkeypatch.setattr(
                renderer.backend, "has", lambda name, has=has: name != "training" and has(name)
            )
        trainer = Trainer(dataset, renderer, iterations=10, sh_degree=0, **settings)
        trainer.run()
        steps[name] = trainer.history["losses"]
        assert type(trainer._model).__name__ == {"kernels": "DeviceModel", "numpy": "HostModel"}[name]
    np.testing.assert_allclose(steps["kernels"], steps["numpy"], rtol=1e-4)
    assert steps["numpy"][-2:].mean() < 0.9 * steps["numpy"][:2].mean()


def test_splats_are_made_by_kernels_as_by_numpy(renderer, dataset):
    """Bit for bit: a round of densification, and a reset of opacities."""
    settings = TrainSettings(**{**QUICK, "iterations": 20, "sh_degree": 1, "densify_from": 99})
    trainer = Trainer(dataset, renderer, settings)
    for _ in range(17):  # harmonics too have moved
        trainer.step()
    work = trainer._model
    densified = densify.densification(work.geometry(), settings, 8, dataset.extent)
    assert 0 < densified.remaining < 16 < len(densified.rows)
    expected = HostModel(renderer.backend, dataset.views, settings)
    expected.load(work.read())
    for each in (work, expected):
        each.densify(densified)
        each.reset_opacities()
    assert len(work) == len(densified.rows)
    for group in ("values", "first", "second"):
        for name, array in getattr(expected.read(), group).items():
            assert np.array_equal(getattr(work.read(), group)[name], array), (group, name)
    actual = work.read()
    assert actual.first["sh"][:, 1:].any()
    assert actual.opacities.max() <= 0.5 + 1e-6
    assert all(
        not array.any() for array in (actual.first["logits"], actual.gradient_sums, actual.visible_counts)
    )


def test_depths_and_normals_without_distortions_have_the_references_derivatives(renderer):
    """As the loss of normals asks for them, whose kernels are others than those of distortions."""
    cloud, capture = random_scene(8, degree=None, quality="surfel")
    expected = derivatives(ReferenceBackend(), cloud, capture, distorted=False)
    backend = renderer.backend
    for shape in (None, *backend.configs("schedule").values()):
        actual = derivatives(backend, cloud, capture, distorted=False, config=shape)
        off = list(differences(actual, expected))
        assert all(one.norm < NORM and one.turned < COSINE for one in off), (shape, off)


def test_the_loss_of_normals_does_what_it_is_for(renderer, dataset):
    """With it normals are closer to those of the surface that the depths make."""
    off = []
    for weight in (0.0, 0.2):
        losses = {"normal_weight": weight, "normal_from": 0, "densify_from": 99, "sh_degree": 0}
        trainer = Trainer(dataset, renderer, **{**QUICK, "iterations": 40, **losses})
        cloud, results = trainer.run(), []
        for view in dataset.views:
            camera = view.camera
            frame = renderer.render(cloud, camera, ("rgb", "alpha", "depth", "normal"), "surfel")
            lens = (camera.fx, camera.fy), (camera.cx, camera.cy)
            results.append(normal_loss(frame["depth"], frame["normal"], frame["alpha"], *lens)[0])
        off.append(np.mean(results))
    assert off[1] < 0.8 * off[0]


def test_the_loss_of_distortions_does_what_it_is_for(renderer, dataset):
    """With it fragments are closer together than they were, and than without it. One disk of the scene lies
    nearly along its plane to the first camera, and reaches up to it."""
    assert renderer.backend.has("gradient_pipeline")
    after = {}
    for weight in (0.0, 10.0):
        losses = {"distortion_weight": weight, "distortion_from": 0, "densify_from": 99, "sh_degree": 0}
        trainer = Trainer(dataset, renderer, **{**QUICK, "iterations": 40, **losses})
        before = distortion_of(trainer)
        trainer.run()
        after[weight] = distortion_of(trainer)
    assert after[10.0] < 0.5 * before
    assert after[10.0] < 0.9 * after[0.0]


def distortion_of(trainer):
    """Mean over the views that are trained on."""
    backend, results = trainer.renderer.backend, []
    resident = backend.upload(trainer.cloud())
    for view in trainer.dataset.views:
        capture = fs.Capture(view.camera, quality="surfel")
        features, visible = prepare(resident, capture)
        pipeline = backend.gradient_pipeline(with_distortion(features))
        results.append(pipeline.forward(resident, visible).read("distortion", 0).mean())
    return np.mean(results)
