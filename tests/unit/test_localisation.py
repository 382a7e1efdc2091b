"""Localisation: recovered poses, their covariance, initial poses and errors."""

import gc
import json
import math
import os
import runpy
import signal
import weakref
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.backends.alignment import AlignmentFit, Estimate, PerturbedFrame
from fidsplat.cameras.pose_offset import offset_camera
from fidsplat.cli import main
from fidsplat.images.files import write_png
from fidsplat.localisation import Localisation, direct_alignment
from fidsplat.localisation.direct_alignment import stages_of
from fidsplat.localisation.normal_equations import HostAlignment, kernels_for, rendered_scene
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.vision.pose import pose_error

START = np.array([0.03, -0.04, 0.03, 0.02, -0.015, 0.03])
"""motion of a start from the truth [rad, m]: 3.3 degrees, 39 mm"""


def scene_with(count=60, marker=None):
    """Disks in a room of 1.2 m, far from the world origin, and a camera with fx other than fy."""
    random = np.random.default_rng(3)
    means = random.uniform((-0.7, -0.5, 0.6), (0.7, 0.5, 1.6), (count, 3)) + np.array([3.0, -2.0, 5.0])
    cloud = fs.SplatCloud(
        means,
        random.normal(size=(count, 4)),
        random.uniform(0.04, 0.15, (count, 2)),
        random.uniform(0.7, 0.99, count),
        colors=random.uniform(0.1, 0.9, (count, 3)),
    )
    pose = fs.Camera.look_at(64, 48, 0.9, (3.1, -2.05, 4.7), (3.0, -2.0, 6.0)).world_to_camera
    camera = fs.Camera.pinhole(64, 48, 62.0, 66.0, 33.0, 23.0, pose)
    markers = () if marker is None else (marker,)
    return fs.Scene([cloud], camera, markers, background=(0.3, 0.35, 0.4))


@pytest.fixture(scope="module")
def renderer():
    return fs.Renderer("opencl")


@pytest.fixture(scope="module")
def room(renderer):
    scene = scene_with()
    return scene, renderer.upload(scene), renderer.render(scene)["rgb"]


def pose_difference(estimate, camera):
    """Millimetres and degrees between two cameras."""
    position, angle = pose_error(estimate.camera_to_world, camera.camera_to_world)
    return 1e3 * position, math.degrees(angle)


def test_the_pose_of_a_noisy_image_is_recovered(renderer, room):
    scene, resident, image = room
    noisy = image + np.random.default_rng(0).normal(0, 0.01, image.shape)
    start = offset_camera(scene.camera, START)
    localisation = fs.localise(noisy, scene, start, renderer=renderer, resident=resident)
    assert localisation.found
    assert localisation.start == "start"
    millimetres, degrees = pose_difference(localisation.camera, scene.camera)
    assert millimetres < 2
    assert degrees < 0.15
    assert pose_difference(start, scene.camera)[0] > 30
    assert localisation.inliers > 0.95
    assert localisation.noise == pytest.approx(0.01, rel=0.2)
    assert localisation.camera.fx == 62.0


def test_small_splats_are_aligned_to_a_fraction_of_a_pixel(renderer):
    """Edges that Tukey's loss ignores after the stages at lower resolution."""
    scene = scene_with(2000)
    start = offset_camera(scene.camera, START / 2)
    localisation = fs.localise(renderer.render(scene)["rgb"], scene, start, renderer=renderer)
    assert pose_difference(localisation.camera, scene.camera)[0] < 0.2


def test_exposure_and_white_balance_do_not_matter(renderer, room):
    scene, resident, image = room
    start = offset_camera(scene.camera, START)
    changed = image * np.float32([0.6, 0.8, 1.1]) + np.float32([0.05, -0.02, 0.01])
    actual = [
        fs.localise(one, scene, start, renderer=renderer, resident=resident) for one in (image, changed)
    ]
    assert pose_difference(actual[1].camera, actual[0].camera)[0] < 0.05
    assert pose_difference(actual[1].camera, scene.camera)[0] < 0.3


def test_an_occluder_is_an_outlier_and_a_mask_ignores_it(renderer, room):
    scene, resident, image = room
    occluded, mask = image.copy(), np.ones((48, 64), bool)
    occluded[10:38, 20:34] = (0.9, 0.1, 0.8)
    mask[10:38, 20:34] = False
    start = offset_camera(scene.camera, START / 3)
    free = fs.localise(occluded, scene, start, renderer=renderer, resident=resident)
    masked = fs.localise(occluded, scene, start, mask=mask, renderer=renderer, resident=resident)
    assert pose_difference(free.camera, scene.camera)[0] < 3
    assert pose_difference(masked.camera, scene.camera)[0] < 0.3
    assert free.inliers < 0.9 < masked.inliers


def normalised(localisation, camera):
    """Squared error of a pose, normalised by its covariance."""
    moved = camera.world_to_camera @ localisation.camera.camera_to_world
    rotation = (moved[:3, :3] - moved[:3, :3].T) / 2
    error = np.array([rotation[2, 1], rotation[0, 2], rotation[1, 0], *moved[:3, 3]])
    return error @ np.linalg.solve(localisation.covariance, error)


def test_the_covariance_has_the_scale_of_the_errors(renderer, room):
    """The squared error, normalised by the covariance, has a mean of six numbers."""
    scene, resident, image = room
    random, squares = np.random.default_rng(5), []
    for _ in range(30):
        noisy = image + random.normal(0, 0.02, image.shape)
        localisation = fs.localise(noisy, scene, scene.camera, renderer=renderer, resident=resident)
        squares.append(normalised(localisation, scene.camera))
    assert 4 < np.mean(squares) < 8.5


def test_the_covariance_includes_errors_of_the_scene(renderer, room):
    """Splats 5 mm off, by standard deviation. From the scores alone, the mean would be some hundreds."""
    scene, _, image = room
    cloud, squares = scene.clouds[0], []
    for seed in range(6):
        means = cloud.world_means() + np.random.default_rng(seed).normal(0, 0.005, (len(cloud), 3))
        off = fs.SplatCloud(means, cloud.quats, cloud.scales, cloud.opacities, colors=cloud.colors)
        other = fs.Scene([off], scene.camera, background=scene.background)
        localisation = fs.localise(image, other, scene.camera, renderer=renderer)
        squares.append(normalised(localisation, scene.camera))
    assert np.mean(squares) < 100


def test_a_large_image_is_reduced(renderer, room):
    """The result is that of the image of the mean of 2 x 2 pixels; ignored pixels have no influence."""
    scene, resident, _ = room
    camera, start = scene.camera.resampled(128, 96), offset_camera(scene.camera, START)
    image = np.array(renderer.render(resident, camera)["rgb"])
    mask = np.ones((96, 128), bool)
    mask[20:40, 60:90] = False
    arguments = {"renderer": renderer, "resident": resident}
    reduced, half = image.reshape(48, 2, 64, 2, 3).mean(axis=(1, 3)), mask[::2, ::2]
    expected = fs.localise(reduced, scene, start, mask=half, **arguments)
    localisation = fs.localise(
        np.where(mask[..., None], image, 0.5),
        scene,
        camera.with_pose(start.world_to_camera),
        mask=mask,
        max_side=64,
        **arguments,
    )
    assert (localisation.camera.width, localisation.camera.height) == (128, 96)
    assert localisation.pose == pytest.approx(expected.pose, abs=1e-6)
    deviations = np.sqrt(np.diag(expected.covariance))
    difference = (localisation.covariance - expected.covariance) / np.outer(deviations, deviations)
    assert difference == pytest.approx(0, abs=1e-3)
    with pytest.raises(fs.InputError, match="max_side must be"):
        fs.localise(image, scene, camera, max_side=8, renderer=renderer)


@pytest.mark.parametrize("wrong", ["negated", "elsewhere", "outside the basin"])
def test_a_wrong_pose_is_not_found(renderer, room, wrong):
    """Flat areas match at many poses, so residuals alone do not tell."""
    scene, resident, image = room
    start = offset_camera(scene.camera, START)
    if wrong == "elsewhere":
        image = renderer.render(scene, offset_camera(scene.camera, 20 * START))["rgb"]
    if wrong == "outside the basin":
        start = offset_camera(scene.camera, np.array([0.5, -0.3, 0.2, 0.1, 0.2, -0.1]))
    given = 1 - image if wrong == "negated" else image
    localisation = fs.localise(given, scene, start, renderer=renderer, resident=resident)
    assert not localisation.found
    assert localisation.inliers < 0.4


def test_a_tag_alone_is_aligned_or_has_a_large_covariance(renderer):
    """A rotation and a translation move a plane's image alike, so steps are long and Tukey's loss has other
    minima. 8 bits on black: most residuals are 0."""
    placed = fs.scenes.PlacedMarker(fs.marker("apriltag:36h11:5", size=0.2), rigid_matrix((0, 0, 1)))
    scene, errors, squares = fs.Scene(markers=[placed]), [], []
    resident = renderer.upload(scene)
    for seed in range(3):
        random = np.random.default_rng(seed)
        camera = fs.Camera.look_at(160, 120, 0.5, (*random.normal(0, 0.1, 2), 0), (0, 0, 1))
        noisy = renderer.render(resident, camera)["rgb"] + random.normal(0, 0.01, (120, 160, 3))
        start = offset_camera(camera, random.normal(size=6) * 0.006)
        localisation = fs.localise(np.clip(noisy, 0, 1), resident, start, renderer=renderer)
        assert localisation.found
        errors.append(pose_difference(localisation.camera, camera)[0])
        squares.append(normalised(localisation, camera))
    assert np.median(errors) < 2
    assert np.median(squares) < 40


LENSES = {
    "distorted": (fs.BrownConrady(k1=-0.1), 62.0, 66.0),
    "fisheye with a black border": (fs.Fisheye(), 15.0, 14.0),
}


@pytest.mark.parametrize("name", LENSES)
def test_a_lens_and_a_grey_image(renderer, name):
    scene, (lens, fx, fy) = scene_with(), LENSES[name]
    camera = fs.Camera.pinhole(64, 48, fx, fy, 33.0, 23.0, scene.camera.world_to_camera, lens=lens)
    image = renderer.render(scene, camera)["rgb"].mean(axis=2)
    localisation = fs.localise(image, scene, offset_camera(camera, START / 2), renderer=renderer)
    assert pose_difference(localisation.camera, camera)[0] < 0.5
    assert pose_difference(localisation.camera, camera)[0] < 4e3 * localisation.position_deviation
    assert localisation.camera.lens == camera.lens


@pytest.mark.parametrize("lens", [None, fs.BrownConrady(k1=-0.1)], ids=["pinhole", "lens"])
def test_sums_of_the_device_agree_with_numpy(renderer, room, lens):
    scene, resident, image = room
    camera = fs.Camera.pinhole(64, 48, 62.0, 66.0, 33.0, 23.0, scene.camera.world_to_camera, lens=lens)
    mask = np.ones((48, 64), bool)
    mask[10:20, 30:40] = False
    stages = [stage for stage, _ in stages_of(camera, mask)]
    stages.insert(0, stages[0]._replace(camera=camera.resampled(27, 19), ignored=None, block_size=5))
    moved = offset_camera(camera, np.array([0, 0, 0, 0, 1e-3, 0]))
    both = HostAlignment(), renderer.backend.alignment()
    noisy = image + np.random.default_rng(1).normal(0, 0.01, image.shape).astype(np.float32)
    for kernels in both:
        kernels.load(noisy, stages, 1500, None)
    host, device = [kernels.pixels for kernels in both]
    assert host == device
    assert both[1].noise == pytest.approx(both[0].noise, rel=1e-3)
    assert both[0].noise == pytest.approx(0.01, rel=0.3)
    assert min(host) > 300
    assert host[1] < 1700
    fit = AlignmentFit(np.array([0.9, 1.0, 1.2]), np.array([0.02, 0.0, -0.01]), huber=True)
    for number, fitted, change in ((1, fit, False), (0, fit, False), (4, fit._replace(huber=False), True)):
        render = partial(renderer.render, resident, outputs=("rgb", "depth"))
        frame = render(stages[number].camera)
        options = {"perturbed": PerturbedFrame(render(moved), 1e-3, 1)} if change else {"blocks": True}
        fitted = fitted._replace(noise=0.02 if change else 0.0)
        one, other = (vars(kernels.sums(number, frame, fitted, **options)) for kernels in both)
        for name, value in one.items():
            tolerance = 3e-3 if lens else 2e-5  # the device differentiates the rays by differences
            scale = np.abs(value).max(initial=1e-9)
            assert other[name] == pytest.approx(value, abs=tolerance * scale), name


@pytest.mark.parametrize(("far", "sky"), [(7, False), (1.5, True)])
def test_steps_on_the_device_agree_with_numpy(room, monkeypatch, far, sky):
    """Levenberg-Marquardt with the schedule of a GPU. From a far start a step is rejected; with a sky, kernel
    arguments depend on the pose."""
    scene, _, image = room
    renderer = fs.Renderer("opencl")
    monkeypatch.setattr(renderer.backend, "config", renderer.backend.configs("binning")["bin_first"])
    monkeypatch.setattr(renderer.backend, "_alignment", None)
    capture = scene.capture.with_(outputs=("rgb", "depth"))
    if sky:
        capture = capture.with_(background=fs.Gradient((0.2, 0.4, 0.9), (0.5, 0.4, 0.3)))
        image = renderer.render(scene, capture, outputs="rgb")["rgb"]
    source = rendered_scene(renderer, renderer.upload(scene), capture)
    image = image * np.float32([0.7, 0.9, 1.1]) + np.float32(0.03)
    start = offset_camera(scene.camera, far * START).world_to_camera
    levels = [stage for stage, _ in stages_of(scene.camera)]
    at = Estimate(start, AlignmentFit(np.ones(3), np.zeros(3), huber=True))
    numpy, kernels = HostAlignment(), kernels_for(source)
    for each in (numpy, kernels):
        each.load(image, levels, 1500, source)
    stage, found = direct_alignment._Stage(3, levels[3].camera, numpy), None
    while found is None:  # first, NumPy's frames enlarge the buffers of the lists
        host, expected = direct_alignment._minimise(at, [(stage, 6)], stage, 0.02)
        found = kernels.minimise(at, [(3, 6)], 3, 0.02)
    device, score = found
    np.testing.assert_allclose(device.pose, host.pose, atol=2e-5)
    np.testing.assert_allclose(device.fit.gain, host.fit.gain, rtol=1e-4)
    np.testing.assert_allclose(device.fit.offset, host.fit.offset, atol=1e-4)
    assert device.noise == pytest.approx(host.noise, rel=1e-3)
    assert sky == (pose_difference(scene.camera.with_pose(device.pose), scene.camera)[0] < 5)
    for axis, rhs in expected.derivatives.items():
        np.testing.assert_allclose(score.derivatives[axis], rhs, atol=0.02 * np.abs(rhs).max())
    kernels.sums(3, kernels.frame(3, start), at.fit)  # adds to the histogram of errors
    again, _ = kernels.minimise(at, [(3, 6)], None, 0.02)
    np.testing.assert_array_equal(again.pose, device.pose)
    assert again.noise == device.noise


def test_a_gpu_replays_renders_with_the_result_of_a_cpu(renderer, room, monkeypatch):
    """The first image enlarges the buffers, the third replays the command lists after another frame."""
    scene, _, _ = room
    capture = scene.capture.with_(background=fs.Gradient((0.2, 0.4, 0.9), (0.5, 0.4, 0.3)))
    scene = fs.Scene([*scene.clouds], scene.camera, background=capture.background)
    image = renderer.render(scene)["rgb"] + np.random.default_rng(0).normal(0, 0.02, (48, 64, 3))
    start = offset_camera(scene.camera, START)
    expected = fs.localise(image, scene, start, renderer=renderer)
    gpu = fs.Renderer("opencl")
    monkeypatch.setattr(gpu.backend, "config", gpu.backend.configs("binning")["bin_first"])
    monkeypatch.setattr(gpu.backend, "_alignment", None)
    resident = gpu.upload(scene)
    for _ in range(3):
        actual = fs.localise(image, scene, start, renderer=gpu, resident=resident)
        assert pose_difference(actual.camera, expected.camera)[0] < 2e-3
        np.testing.assert_allclose(actual.covariance, expected.covariance, rtol=0.02, atol=1e-9)
        gpu.render(resident, outputs=("rgb", "depth"))
    cloud = weakref.ref(resident.data)
    del resident
    gc.collect()
    assert cloud() is None


def test_a_store_is_localised_in(renderer, room, tmp_path):
    """Frames of a store are on the host, and so are the sums."""
    scene, _, _ = room
    fs.save_ply(scene.clouds[0], str(tmp_path / "room.ply"))
    store = fs.Store(fs.build_store([str(tmp_path / "room.ply")], str(tmp_path / "room.fss")))
    image = renderer.render(store, scene.camera)["rgb"]
    localisation = fs.localise(image, store, offset_camera(scene.camera, START), renderer=renderer)
    assert localisation.found
    assert pose_difference(localisation.camera, scene.camera)[0] < 0.1


def test_a_tag_gives_the_initial_pose(renderer, tmp_path, capsys):
    marker = fs.marker("apriltag:36h11:5", size=0.5)
    pose = np.eye(4)
    pose[:3, 3] = 3.0, -2.0, 5.75
    placed = fs.scenes.PlacedMarker(marker, pose)
    scene = scene_with(count=40, marker=placed)
    image = renderer.render(scene)["rgb"]
    localisation = fs.localise(image, scene, renderer=renderer)
    assert localisation.found
    assert localisation.start == marker.spec
    assert pose_difference(localisation.camera, scene.camera)[0] < 3
    scene.save(tmp_path / "scene.toml")
    write_png(tmp_path / "photo.png", image)
    write_png(tmp_path / "blank.png", 0 * image)  # without a tag: the other photograph is found all the same
    write_png(tmp_path / "turned.png", np.rot90(image))  # of another camera
    (tmp_path / "torn.png").write_bytes((tmp_path / "photo.png").read_bytes()[:500])
    words = ["localise", str(tmp_path), "--scene", str(tmp_path / "scene.toml"), "--device", "opencl"]
    assert main([*words, "-o", str(tmp_path / "poses.tum"), "--json"]) == 0
    images = json.loads(capsys.readouterr().out)["images"]
    results = {Path(each["image"]).stem: each for each in images}
    facts = results.pop("photo")
    assert facts["found"]
    for name, reason in (
        ("blank", "no marker in the image"),
        ("turned", "64 x 48 pixels, got 48 x 64"),
        ("torn", "cannot read"),
    ):
        assert (results[name]["found"], results[name]["start"]) == (False, None)
        assert reason in results[name]["reason"]
    assert main(words) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "turned.png: the image must have the camera's size" in printed
    assert main(["localise", str(tmp_path / "torn.png"), str(tmp_path / "turned.png"), *words[2:]]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert np.shape(facts["covariance"]) == (6, 6)
    assert facts["position"] == pytest.approx(scene.camera.position, abs=2e-3)
    written = fs.load_trajectory(tmp_path / "poses.tum")
    assert written.poses[0] == pytest.approx(scene.camera.camera_to_world, abs=5e-3)
    assert written.times[0] == 1  # "blank" is the first of the folder
    assert [Path(each["image"]).stem for each in images] == ["blank", "photo", "torn", "turned"]
    assert main([*words, "-o", str(tmp_path / "poses.kitti")]) == 2
    assert "whose lines have no number, got 1 of 4; write .tum" in capsys.readouterr().err
    assert not (tmp_path / "poses.kitti").exists()
    away = ["--start", "3.1,-2.05,4.7,0,1,0,0", "-o", str(tmp_path / "photo.kitti")]
    assert main(["localise", str(tmp_path / "photo.png"), *words[2:], *away]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if str(tmp_path / "photo.png") in line)
    assert row.split()[1] == "yes"
    assert row.split()[-1] == marker.spec  # the table of a pipe does not wrap


def test_an_interrupted_command_writes_its_poses(renderer, tmp_path, monkeypatch, capsys):
    pose = np.eye(4)
    pose[:3, 3] = 3.0, -2.0, 5.75
    scene = scene_with(count=40, marker=fs.scenes.PlacedMarker(fs.marker("apriltag:36h11:5", size=0.5), pose))
    scene.save(tmp_path / "scene.toml")
    image, names = renderer.render(scene)["rgb"], [str(tmp_path / f"{k}.png") for k in range(3)]
    for name in names:
        write_png(name, image)
    calls, localise = [], fs.localise

    def interrupted(*arguments, **options):
        calls.append(arguments)
        if len(calls) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return localise(*arguments, **options)

    monkeypatch.setattr(fs, "localise", interrupted)
    words = ["--scene", str(tmp_path / "scene.toml"), "--device", "opencl", "-o", str(tmp_path / "poses.tum")]
    assert main(["localise", *names, *words, "--json"]) == 130
    printed = capsys.readouterr()
    assert [each["image"] for each in json.loads(printed.out)["images"]] == names[:1]
    assert printed.err.endswith("interrupted\n")
    written = fs.load_trajectory(tmp_path / "poses.tum")
    assert written.poses[0] == pytest.approx(scene.camera.camera_to_world, abs=5e-3)
    assert len(calls) == 2


def test_the_most_similar_candidate_is_the_start(renderer, room):
    scene, resident, image = room
    others = [
        scene.camera.with_pose(position=(3.0 + math.sin(k), -2.0, 6.0 + 2 * math.cos(k)), target=(3, -2, 6))
        for k in (0.5, 1.5, 2.5, 4.0, 5.0)
    ]
    candidates = [*others[:3], offset_camera(scene.camera, START), *others[3:]]
    localisation = fs.localise(image, scene, candidates=candidates, renderer=renderer, resident=resident)
    assert localisation.start == "candidates"
    assert pose_difference(localisation.camera, scene.camera)[0] < 3


def test_an_image_without_contrast_is_not_found(renderer, room):
    """A covered lens: the smallest gain makes every render as black as the image."""
    scene, resident, image = room
    away = scene.camera.with_pose(position=(3.0, -2.0, -500.0), target=(3.0, -2.0, -600.0))
    for value, start in ((0, scene.camera), (1, scene.camera), (0, away)):
        localisation = fs.localise(0 * image + value, scene, start, renderer=renderer, resident=resident)
        assert not localisation.found
    assert localisation.position_deviation == math.inf  # no splat is visible


def test_few_pixels_do_not_determine_a_covariance(renderer, room):
    """Of 4 x 4 pixels each, the blocks within the mask are fewer than the 12 parameters."""
    scene, resident, image = room
    mask = np.zeros((48, 64), bool)
    mask[20:32, 28:40] = True
    localisation = fs.localise(image, scene, scene.camera, mask=mask, renderer=renderer, resident=resident)
    assert localisation.position_deviation == math.inf
    assert not localisation.found


def test_errors_of_localisation(renderer, room, tmp_path, capsys):
    scene, resident, image = room
    with pytest.raises(fs.InputError, match="initial pose, got no start, no marker in the image"):
        fs.localise(image, scene, renderer=renderer, resident=resident)
    with pytest.raises(fs.InputError, match="camera's size, 64 x 48 pixels, got 60 x 48; give the image"):
        fs.localise(image[:, :60], scene, scene.camera, renderer=renderer, resident=resident)
    with pytest.raises(fs.InputError, match="the image must have a camera, got none"):
        fs.localise(image, scene.clouds[0], np.eye(4), renderer=renderer)
    for value, got in ((np.nan, "nan"), (np.inf, "inf"), (1e30, "1e"), (-1e6, "[0-9]"), (200.0, "200")):
        with pytest.raises(fs.InputError, match=f"must be finite and at most 100, got {got}"):
            fs.localise(np.full((48, 64), value), scene, scene.camera, renderer=renderer)
    ignored = [[False] * 64] * 48
    with pytest.raises(fs.InputError, match="pixels away from the border and from ignored pixels, got none"):
        fs.localise(image, scene, scene.camera, mask=ignored, renderer=renderer, resident=resident)
    with pytest.raises(fs.InputError, match="resident must be a ResidentCloud"):
        fs.localise(image, scene, scene.camera, renderer=renderer, resident=scene)
    scene.save(tmp_path / "scene.toml")
    write_png(tmp_path / "photo.png", image)
    marker = fs.scenes.PlacedMarker(fs.marker("apriltag:36h11:5", size=0.5), np.eye(4))
    with pytest.raises(fs.InputError, match=r"once in the scene \(apriltag:36h11:5 more than once\)"):
        fs.localise(image, replace(scene, markers=[marker, marker]), renderer=renderer, resident=resident)
    words = ["localise", str(tmp_path / "photo.png"), "--scene", str(tmp_path / "scene.toml")]
    assert main([*words, "--start", "1,2,3"]) == 2
    assert "--start must be 7 numbers X,Y,Z,QW,QX,QY,QZ" in capsys.readouterr().err
    assert main([*words, "-o", "poses.xyz"]) == 2
    assert "suffix of a trajectory must be one of .tum and .txt" in capsys.readouterr().err
    assert main([*words[:3], str(tmp_path / "city.fss")]) == 2
    assert "must be a scene file (.toml) with the camera of the photographs" in capsys.readouterr().err
    assert main(words) == 2
    assert capsys.readouterr().err.count("\n") == 1
    file = tmp_path / "poses.tum"
    words += ["--start", "3.1,-2.05,4.7,0,1,0,0", "-o", str(file)]  # away from the scene
    assert main(words) == 2
    printed = capsys.readouterr()
    assert "photo.png: the image must determine the pose" in printed.out
    assert "a pose must be found to write" in printed.err
    file.write_text("mine")
    assert main(words) == 2
    assert "already exists" in capsys.readouterr().err
    assert file.read_text() == "mine"


@pytest.mark.parametrize(
    ("deviation", "inliers", "marker_error", "found"),
    [
        (9e-3, 0.6, None, True),
        (9e-3, 0.59, None, False),
        (9e-3, 0.59, 3e-3, False),
        (9e-3, 0.4, 1e-3, True),
        (9e-3, 0.39, 1e-3, False),
        (1e-3, 0.4, None, True),
        (1e-3, 0.39, None, False),
        (0.011, 1.0, 1e-3, False),
    ],
)
def test_matching_blocks_deviation_and_markers_decide_whether_a_pose_is_found(
    room, deviation, inliers, marker_error, found
):
    covariance = np.diag([deviation**2 / 3] * 6)
    localisation = Localisation(room[0].camera, covariance, inliers, 0.01, "start", marker_error)
    assert localisation.found == found


def test_markers_confirm_a_pose_unless_they_were_moved(renderer):
    """A third of the image shows something else."""
    tag, other = fs.marker("apriltag:36h11:5", size=0.25), np.random.default_rng(0).uniform(0, 1, (40, 20, 3))
    scene, moved = (
        replace(
            scene_with(150, fs.scenes.PlacedMarker(tag, rigid_matrix((x, -2, 5.7)))),
            camera=scene_with().camera.resampled(160, 120),
        )
        for x in (3.15, 3.25)
    )
    found = []
    for photographed in (scene, moved):
        image = np.array(renderer.render(photographed)["rgb"])
        image[:, :60] = other.repeat(3, 0).repeat(3, 1)
        found.append(fs.localise(image, scene, renderer=renderer))
    assert [each.found for each in found] == [True, False]
    assert found[0].inliers < 0.6
    assert pose_difference(found[0].camera, scene.camera)[0] < 1
    assert found[0].marker_error < 2e-3 < found[1].marker_error
    assert fs.localise(image, scene, scene.camera, renderer=renderer).marker_error is None


def test_the_example_of_gtsam(capsys):
    pytest.importorskip("gtsam", reason="pip install gtsam")
    runpy.run_path(str(Path(__file__).parents[2] / "examples" / "gtsam_localisation.py"))
    errors = [float(line.split(": ")[1].split()[0]) for line in capsys.readouterr().out.splitlines()]
    assert len(errors) == 4
    assert max(errors) < 1
