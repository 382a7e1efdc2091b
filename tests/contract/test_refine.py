"""Markers whose Gaussians are refined by gradient, on every device that has gradients."""

from functools import partial

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.backends.interface import Backend
from fidsplat.capture.quality import LADDER
from fidsplat.train import refine
from fidsplat.util.errors import DeviceError, InputError

BACKEND = "opencl"
SPEC = "aruco:4x4_50:7"
GREY = (0.5, 0.5, 0.5)


def made(**changes):
    return fs.marker(SPEC, size=0.1, mixture="fitted", **changes)


def shown(renderer, marker):
    """Error from the print inside the sheet's outline, and alpha there: 12 px a module, 3 x 3 samples."""
    side = 12 * len(marker.grid)
    focal = 1000.0 * side
    pose = np.eye(4)
    pose[2, 3] = focal * marker.module / 12
    camera = fs.Camera.pinhole(side, side, focal, focal, side / 2, side / 2, pose)
    quality = fs.Quality(lowpass="none", samples=3)
    frame = renderer.render(marker.gaussians, camera, ("rgb", "alpha"), quality, background=GREY)
    ideal = np.kron(1.0 - marker.grid, np.ones((12, 12)))
    return frame["rgb"].mean(2) - ideal, frame["alpha"][1:-1, 1:-1]


def psnr(error):
    return -10 * np.log10(np.mean(error**2))


def test_refined_gaussians_are_nearer_to_the_print_and_leak_less(renderer):
    """As many as before."""
    before = made()
    steps = []
    after = refine(before, renderer, 60, leak=0.001, progress=steps.append)
    assert [step.iteration for step in steps] == list(range(1, 61))
    assert steps[-1].transmittance < steps[0].transmittance
    assert after.mixture == "refined"
    assert len(after.cloud) == len(before.cloud)
    assert after.gaussians is after.cloud
    assert after.cloud.coplanar_groups is not None
    assert 0 <= after.cloud.colors.min() <= after.cloud.colors.max() <= 1
    (old_error, old_alpha), (error, alpha) = shown(renderer, before), shown(renderer, after)
    assert old_alpha.min() < 0.6
    assert alpha.min() > 0.68
    assert psnr(error) > psnr(old_error)
    middle = np.tile(np.arange(12) // 3 % 3 > 0, len(error) // 12)  # half of a cell
    cells = np.ix_(middle, middle)
    assert np.abs(error[cells]).max() < 0.08 < np.abs(old_error[cells]).max()


def test_more_gaussians_become_opaque(renderer):
    """A tenth of the light came through at corners."""
    before = made(template=LADDER)
    assert shown(renderer, before)[1].min() < 0.92
    assert shown(renderer, refine(before, renderer, 40))[1].min() > 0.97


def test_runs_are_bit_identical_and_differ_with_another_seed(renderer):
    first, again, other = (refine(made(template=5), renderer, 4, seed) for seed in (0, 0, 1))
    assert np.array_equal(first.cloud.means, again.cloud.means)
    assert np.array_equal(first.cloud.scales, again.cloud.scales)
    assert not np.array_equal(first.cloud.means, other.cloud.means)


def test_a_refined_marker_has_its_size(renderer):
    """Work is in modules: a marker ten times as large is the same."""
    small = refine(made(template=5), renderer, 3)
    large = refine(fs.marker(SPEC, size=1.0, mixture="fitted", template=5), renderer, 3)
    assert np.allclose(small.cloud.means * 10, large.cloud.means, rtol=0, atol=1e-5)
    assert np.allclose(small.cloud.scales * 10, large.cloud.scales, rtol=1e-4)


def test_what_cannot_be_refined_is_reported(renderer, tmp_path):
    drawing = tmp_path / "slant.svg"
    drawing.write_text('<svg viewBox="0 0 10 10"><path d="M1 1 L9 2 L5 9 Z" fill="#f00"/></svg>')
    with pytest.raises(InputError, match="with edges across its modules; give"):
        refine(fs.marker(f"svg-10:{drawing}"), renderer)
    with pytest.raises(InputError, match=r"iterations must be .* got 0"):
        refine(made(), renderer, 0)
    with pytest.raises(InputError, match=r"leak must be .* got -1"):
        refine(made(), renderer, leak=-1)
    with pytest.raises(InputError, match=r"fs\.train\.refine"):
        fs.marker(SPEC, mixture="refined")
    plain = fs.Renderer("reference")
    plain.backend.gradient_pipeline = partial(Backend.gradient_pipeline, plain.backend)
    with pytest.raises(DeviceError, match="must have gradients, got reference"):
        refine(made(), plain)
