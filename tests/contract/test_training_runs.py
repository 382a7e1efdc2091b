"""Training on every device with gradients: it raises the PSNR, and writes the same bytes twice and after
an interruption."""

import hashlib

import numpy as np
import pytest
from training_scene import QUICK, run_and_resumed, scene

from fidsplat.formats import load_ply
from fidsplat.train import Trainer

BACKEND = ("opencl", "warp")
ITERATIONS = 40


@pytest.fixture(scope="module")
def dataset():
    return scene()


@pytest.fixture(params=["default", "mcmc"])
def settings(request):
    return {**QUICK, "iterations": ITERATIONS, "sh_degree": 1, "strategy": request.param, "growth": 1.2}


def test_a_run_raises_the_psnr_and_repeats_to_the_byte(renderer, dataset, settings, tmp_path):
    """By 3 dB on the training views, with noise by half of that; the second run is interrupted and
    resumes from its checkpoint."""
    uninterrupted = Trainer(dataset, renderer, **settings)
    before = uninterrupted.evaluate(dataset.views)
    uninterrupted.run()
    after = uninterrupted.evaluate(dataset.views)
    assert np.mean([b.psnr - a.psnr for a, b in zip(before, after, strict=True)]) > (
        3 if settings["strategy"] == "default" else 1.5
    )
    assert 16 < len(uninterrupted.cloud()) <= 30

    first, second = run_and_resumed(uninterrupted, renderer, settings, 21, tmp_path)
    assert hashlib.sha256(first).hexdigest() == hashlib.sha256(second).hexdigest()
    assert load_ply(tmp_path / "a.ply").sh_degree == 1
