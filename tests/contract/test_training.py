"""Training on every device that has gradients: it raises the PSNR, and gives the same bytes twice and after a
stop."""

import numpy as np
import pytest
from training_scene import QUICK, scene

from fidsplat.backends.derivatives import Differentiates, Trains
from fidsplat.formats import load_ply
from fidsplat.train import Trainer

BACKEND = "opencl"
ITERATIONS = 40


@pytest.fixture(scope="module")
def dataset():
    return scene()


@pytest.fixture(params=["default", "mcmc"])
def settings(request):
    return {**QUICK, "iterations": ITERATIONS, "sh_degree": 1, "strategy": request.param, "growth": 1.2}


def test_a_run_raises_the_psnr_and_repeats_to_the_byte(renderer, dataset, settings, tmp_path):
    """By 3 dB on the views that are trained on, with noise by half of that; the second run is stopped, and
    goes on from its checkpoint."""
    assert isinstance(renderer.backend, Differentiates)
    assert isinstance(renderer.backend, Trains)
    whole = Trainer(dataset, renderer, **settings)
    before = whole.evaluate(dataset.views)
    whole.run()
    after = whole.evaluate(dataset.views)
    assert np.mean([b.psnr - a.psnr for a, b in zip(before, after, strict=True)]) > (
        3 if settings["strategy"] == "default" else 1.5
    )
    assert 16 < len(whole.cloud()) <= 30

    checkpoint = tmp_path / "run.training.npz"
    first = Trainer(dataset, renderer, checkpoint=checkpoint, **settings)
    for _ in range(21):
        first.step()
    first.save_checkpoint()
    again = Trainer(dataset, renderer, checkpoint=checkpoint, **settings)
    again.run()
    for name, trainer in (("a", whole), ("b", again)):
        trainer.save(tmp_path / f"{name}.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert load_ply(tmp_path / "a.ply").sh_degree == 1


def test_kernels_and_numpy_train_alike(renderer, dataset, monkeypatch):
    """Ten steps by the kernels and by their twins, which round otherwise."""
    steps = {}
    for name in ("kernels", "numpy"):
        if name == "numpy":
            monkeypatch.setattr("fidsplat.train.trainer.Trains", type("Nobody", (), {}))
        trainer = Trainer(dataset, renderer, iterations=10, sh_degree=1, **{**QUICK, "densify_from": 99})
        trainer.run()
        steps[name] = trainer.history["losses"]
        assert type(trainer._work).__name__ == {"kernels": "DeviceWork", "numpy": "HostWork"}[name]
    np.testing.assert_allclose(steps["kernels"], steps["numpy"], rtol=1e-4)
