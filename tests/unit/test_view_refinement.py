"""Refinement of training views: poses, exposures, and masks."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from training_scene import BACKGROUND

import fidsplat as fs
from fidsplat.cameras.pose_offset import offset_camera
from fidsplat.images.files import to_uint8, write_png
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.train import Dataset, Trainer, TrainingView, load_dataset
from fidsplat.train.scores import score_view
from fidsplat.train.settings import TrainSettings
from fidsplat.train.view_refinement import ViewRefinement, alignment, camera_intrinsics, moved
from fidsplat.vision.pose import pose_error

FIXED = {
    **dict.fromkeys(("position_rate", "position_rate_end", "color_rate", "opacity_rate"), 0.0),
    **dict.fromkeys(("scale_rate", "rotation_rate", "dssim_weight"), 0.0),
    **{"sh_degree": 0, "densify_until": 0, "quality": "surfel"},
}
"""splats that do not change"""
RATES = {"pose_rate": 5e-3, "pose_rate_end": 5e-5}
"""for cameras that are far off"""
ALL = {"refine_poses": True, "refine_intrinsics": True, "fit_exposures": True}


@pytest.fixture(scope="module")
def renderer():
    return fs.Renderer("opencl")


@pytest.fixture(scope="module")
def cloud():
    random = np.random.default_rng(0)
    return fs.SplatCloud(
        random.uniform(-0.5, 0.5, (40, 3)) + np.array([2.0, -1.0, 3.0]),
        random.normal(size=(40, 4)),
        random.uniform(0.05, 0.15, (40, 2)),
        random.uniform(0.6, 0.95, 40),
        colors=random.uniform(0, 1, (40, 3)),
    )


@pytest.fixture(scope="module")
def original(renderer, cloud):
    """Views from an arc away from the origin, with fx other than fy."""
    views = []
    for k, angle in enumerate(np.linspace(-1, 1, 4)):
        position = (2 + 1.6 * np.sin(angle), -1 + 0.3 * np.cos(3 * angle), 3 - 1.6 * np.cos(angle))
        pose = fs.Camera.look_at(32, 24, 0.9, position, (2, -1, 3)).world_to_camera
        camera = fs.Camera.pinhole(32, 24, 33.0, 36.0, 16.5, 11.5, pose)
        rgb = renderer.render(cloud, camera, quality="surfel", background=BACKGROUND)["rgb"]
        views.append(TrainingView(f"{k}.png", camera, to_uint8(rgb)))
    points = cloud.world_means()
    return Dataset("arc", tuple(views), (), points, np.full(points.shape, 128, np.uint8), BACKGROUND)


@pytest.fixture(scope="module")
def disturbed(original):
    random = np.random.default_rng(1)
    motions = random.normal(size=(4, 6)) * np.repeat([0.01, 0.02], 3)
    pairs = zip(original.views, motions, strict=True)
    return replace(original, views=tuple(replace(v, camera=offset_camera(v.camera, m)) for v, m in pairs))


def errors(views, truth):
    """Largest distance [m] and angle [rad] between cameras."""
    pairs = zip(views, truth.views, strict=True)
    return np.max([pose_error(a.camera.camera_to_world, b.camera.camera_to_world) for a, b in pairs], axis=0)


def test_poses_return_to_the_truth(renderer, cloud, original, disturbed):
    rates = RATES | {"pose_rate_end": 1e-4}
    trainer = Trainer(disturbed, renderer, start=cloud, iterations=400, refine_poses=True, **rates, **FIXED)
    trained = trainer.run()
    # aligned with the disturbed poses, the cameras and splats are moved by one similarity
    matrix = alignment([view.camera for view in original.views], [view.camera for view in trainer.views])
    expected = cloud.world_means() @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.abs(trained.world_means() - expected).max() < 0.003
    reference = replace(
        original, views=tuple(replace(view, camera=moved(view.camera, matrix)) for view in original.views)
    )
    before, after = errors(disturbed.views, original), errors(trainer.views, reference)
    assert (before > (0.02, 0.008)).all()
    assert (after < (0.002, 0.001)).all()
    psnr = []
    for splats, views in ((cloud, disturbed.views), (trained, trainer.views)):
        cameras = [view.camera for view in views]
        frames = renderer.render_views(splats, cameras, quality="surfel", background=BACKGROUND)
        psnr.append(np.mean([score_view(v, f["rgb"]).psnr for v, f in zip(views, frames, strict=True)]))
    assert psnr[0] < 30 < 50 < psnr[1]
    changes = trainer.pose_changes()
    expected = [
        pose_error(a.camera.camera_to_world, b.camera.camera_to_world)
        for a, b in zip(disturbed.views, trainer.views, strict=True)
    ]
    np.testing.assert_allclose(changes, np.array(expected) * (1, 180 / np.pi), rtol=1e-6)


def wrong_intrinsics(dataset, held_out=0):
    """Wrong focal lengths and principal point in all cameras, which the first `held_out` views share."""
    change = {"fx": 34.0, "fy": 35.0, "cx": 16.1, "cy": 12.0}
    views = tuple(replace(view, camera=replace(view.camera, **change)) for view in dataset.views)
    return replace(dataset, views=views[held_out:], held_out=views[:held_out])


def test_intrinsics_return_to_the_truth(renderer, cloud, original):
    wrong = wrong_intrinsics(original, held_out=1)
    trainer = Trainer(wrong, renderer, start=cloud, iterations=400, refine_intrinsics=True, **RATES, **FIXED)
    before = trainer.evaluate()[0].psnr
    trainer.run()
    for actual, view in zip(trainer.views, original.views[1:], strict=True):
        camera, true = actual.camera, view.camera
        assert abs(camera.fx - true.fx) < 0.1
        assert abs(camera.fy - true.fy) < 0.1
        assert abs(camera.cx - true.cx) < 0.05
        assert abs(camera.cy - true.cy) < 0.05
        np.testing.assert_array_equal(camera.world_to_camera, true.world_to_camera)
    assert before < 28
    assert trainer.evaluate()[0].psnr > 35


def test_a_held_out_view_with_too_sparse_a_mask_is_evaluated(renderer, cloud, original):
    """Localisation has no pixel whose neighbours are not ignored."""
    mask = np.indices((24, 32)).sum(axis=0) % 2 == 0
    dataset = replace(original, views=original.views[1:], held_out=(replace(original.views[0], mask=mask),))
    trainer = Trainer(dataset, renderer, start=cloud, iterations=1, refine_poses=True, **FIXED)
    assert trainer.evaluate()[0].psnr > 40


def test_a_localisation_that_matches_worse_is_not_used(renderer, cloud, original, monkeypatch):
    """Scores are those at the held-out view's own pose."""
    from fidsplat.localisation import direct_alignment

    dataset = replace(original, views=original.views[1:], held_out=original.views[:1])
    trainer = Trainer(dataset, renderer, start=cloud, iterations=1, refine_poses=True, **FIXED)
    expected = trainer.evaluate()[0].psnr
    wrong = replace(original.views[0].camera, cx=original.views[0].camera.cx + 4)
    localisation = SimpleNamespace(camera=wrong, inliers=0.9)
    monkeypatch.setattr(direct_alignment, "align", lambda *arguments: localisation)
    assert trainer.evaluate()[0].psnr == pytest.approx(expected, abs=0.5)
    assert expected > 40


def test_refinement_does_not_drift_by_a_similarity(original):
    """Cameras that are rotated, moved and scaled together are aligned with the original ones."""
    refinement = ViewRefinement(original, TrainSettings(refine_poses=True))
    drift = 1.03 * rigid_matrix((0.2, -0.1, 0.4), (0.98, 0.1, -0.1, 0.15))
    drift[3, 3] = 1.0
    for pose, view in zip(refinement.poses, original.views, strict=True):
        pose[:] = moved(view.camera, drift).world_to_camera
        pose[:3, 3] += pose[:3, :3] @ original.origin
    np.testing.assert_allclose(refinement.to_dataset() @ drift, np.eye(4), atol=1e-12)
    assert refinement.pose_changes().max() < 1e-10


def test_exposures_return_to_the_truth(renderer, cloud, original):
    gains = np.exp(np.random.default_rng(2).normal(0, 0.1, (4, 3)))
    gains /= np.exp(np.log(gains).mean(axis=0))
    pairs = zip(original.views, gains, strict=True)
    exposed = replace(
        original, views=tuple(replace(v, image=to_uint8(v.image / 255 * gain)) for v, gain in pairs)
    )
    trainer = Trainer(exposed, renderer, start=cloud, iterations=240, fit_exposures=True, **FIXED)
    trainer.run()
    assert np.abs(trainer.exposures[:, 0] - gains).max() < 0.06
    assert np.abs(trainer.exposures[:, 1]).max() < 0.03
    assert trainer.evaluate(exposed.views)[0].psnr > 40
    unfitted = Trainer(exposed, renderer, start=cloud, iterations=1, **FIXED)
    assert unfitted.evaluate(exposed.views)[0].psnr < 30


@pytest.mark.parametrize("other_schedule", [False, True])
def test_devices_agree_on_refinement(renderer, cloud, disturbed, monkeypatch, other_schedule):
    """Kernels of the derivatives by camera and exposure, of CPUs and GPUs, against the float64 reference."""
    if other_schedule:
        config = next(iter(renderer.backend.configs("schedule").values()))
        monkeypatch.setattr(renderer.backend, "config", config)
    monkeypatch.setattr("fidsplat.train.view_refinement.INTRINSICS_EVERY", 2)
    results = []
    for device in (renderer, fs.Renderer("reference")):
        settings = {"iterations": 7, "sh_degree": 0} | RATES | ALL
        trainer = Trainer(disturbed, device, start=cloud, **settings)
        trainer.run()
        (intrinsics,) = {camera_intrinsics(view.camera)[2:] for view in trainer.views}
        poses = np.array([view.camera.world_to_camera for view in trainer.views])
        results.append((poses, trainer.exposures, np.array(intrinsics)))
    assert np.abs(results[0][0] - [view.camera.world_to_camera for view in disturbed.views]).max() > 5e-4
    np.testing.assert_allclose(results[0][0], results[1][0], atol=2e-6)
    np.testing.assert_allclose(results[0][1], results[1][1], atol=2e-6)
    np.testing.assert_allclose(results[0][2], results[1][2], atol=1e-5)
    assert np.abs(results[0][2] - (33, 36, 16.5, 11.5)).min() > 3e-4  # 30 times the tolerance


def test_a_resumed_run_is_bit_identical(renderer, cloud, disturbed, tmp_path, monkeypatch):
    monkeypatch.setattr("fidsplat.train.view_refinement.INTRINSICS_EVERY", 4)
    settings = {"iterations": 9, "sh_degree": 0} | ALL
    complete = Trainer(disturbed, renderer, start=cloud, **settings)
    complete.run()
    stopped = Trainer(disturbed, renderer, start=cloud, checkpoint=tmp_path / "a.npz", **settings)
    for _ in range(6):
        stopped.step()
    stopped.save_checkpoint()
    resumed = Trainer(disturbed, renderer, start=cloud, checkpoint=tmp_path / "a.npz", **settings)
    assert resumed.iteration == 6
    resumed.run()
    for a, b in zip(resumed.views, complete.views, strict=True):
        np.testing.assert_array_equal(a.camera.world_to_camera, b.camera.world_to_camera)
        assert camera_intrinsics(a.camera) == camera_intrinsics(b.camera)
    np.testing.assert_array_equal(resumed.exposures, complete.exposures)
    np.testing.assert_array_equal(resumed.cloud().means, complete.cloud().means)


def test_masks_of_a_folder_and_of_alpha(original, tmp_path):
    import cv2

    from fidsplat.formats.colmap import save_colmap

    cameras = [view.camera for view in original.views]
    names = [view.name for view in original.views]
    save_colmap(tmp_path / "set" / "sparse" / "0", names, cameras, original.points, original.colors)
    (tmp_path / "set" / "images").mkdir()
    alpha = np.full((24, 32), 255, np.uint8)
    alpha[:5] = 0
    for view in original.views:
        cv2.imwrite(str(tmp_path / "set" / "images" / view.name), np.dstack([view.image[:, :, ::-1], alpha]))
    (tmp_path / "masks").mkdir()
    mask = np.ones((24, 32), bool)
    mask[:, :7] = False
    write_png(tmp_path / "masks" / "0.png.png", mask)
    plain = load_dataset(tmp_path / "set")
    assert all(view.mask is None for view in plain.views)
    assert (plain.views[0].image[:5] == 0).all()
    dataset = load_dataset(tmp_path / "set", masks=tmp_path / "masks", alpha_masks=True)
    np.testing.assert_array_equal(dataset.views[0].mask, mask & (alpha > 0))
    np.testing.assert_array_equal(dataset.views[1].mask, alpha > 0)
    with pytest.raises(fs.InputError, match=r"--masks must be a folder of masks NAME.png, got .*missing"):
        load_dataset(tmp_path / "set", masks=tmp_path / "missing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(fs.InputError, match=r"must have masks of the images, e\.g\. 0\.png\.png, got none"):
        load_dataset(tmp_path / "set", masks=tmp_path / "empty", alpha_masks=True)
    with pytest.raises(fs.InputError, match="refine_poses must be True or False, got 'yes'"):
        Trainer(original, refine_poses="yes")


def test_rates_need_their_switches():
    for switch in ("refine_poses", "refine_intrinsics"):
        assert TrainSettings(pose_rate=1e-3, **{switch: True}).pose_rate == 1e-3
    for rate in ("pose_rate", "exposure_rate_end"):
        with pytest.raises(
            fs.InputError, match=rf"{rate} must be its default .* without .*, got 0.1; add --"
        ):
            TrainSettings(**{rate: 0.1})
