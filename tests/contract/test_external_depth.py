"""External depth images among splats: exact per pixel, and equal to the reference renderer."""

from dataclasses import replace

import numpy as np
import pytest
from agreement import compare, random_splats

import fidsplat as fs
from fidsplat.backends.opencl.assemble import assemble
from fidsplat.backends.opencl.kernel_config import cpu_config, gpu_config
from fidsplat.backends.prepare import prepare
from fidsplat.backends.reference import ReferenceBackend
from fidsplat.capture.environment import DeviceExternalDepth
from fidsplat.effects import select
from fidsplat.splats.rotations import rigid_matrix

SIZE = WIDTH, HEIGHT = 37, 22
OUTPUTS = ("rgb", "alpha", "depth", "depth_median", "depth_first", "normal", "label", "splat_id", "blended")
CAMERA = fs.Camera.pinhole(*SIZE, 30.0, 30.0, 18.0, 11.0)


def a_surface(seed=0, label=77):
    """Random colours and depths among the splats, with holes."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.9, 3.0, (HEIGHT, WIDTH))
    depth[rng.random(depth.shape) < 0.2] = np.inf
    return fs.ExternalDepth(rng.random((HEIGHT, WIDTH, 3)), depth, label)


def a_cloud():
    return random_splats(24, 21, depth=(0.8, 4.0), scale=(0.05, 0.5), across=1.2)


CASES = {
    "centre": (a_cloud(), {}),
    "planes, fog, 2 x 2 samples": (
        a_cloud().with_coplanar_groups(np.arange(24) // 4 - 1),
        {"quality": "standard,samples=2", "fog": fs.Fog(0.2, (0.6, 0.65, 0.7))},
    ),
    "pixel": (a_cloud(), {"quality": "standard,order=pixel"}),
    "exclusive stop, gradient, fisheye": (
        a_cloud(),
        {
            "quality": "gsplat",
            "background": fs.Gradient((0.2, 0.4, 0.9), (0.4, 0.3, 0.1)),
            "camera": fs.Camera.fisheye(*SIZE, 2.0),
        },
    ),
}


def differences(pipeline, resident, cloud, capture):
    """An image of a pipeline against the reference's."""
    _, view = prepare(resident, capture)
    images = pipeline.render_view(resident, view)
    reference = ReferenceBackend()
    expected = reference.pipeline(select(cloud, capture.with_(outputs=(*capture.outputs, "alpha"))))
    actual = {name: images.read(name, 0) for name in capture.outputs}
    return compare(actual, expected.render_view(reference.upload(cloud), view).arrays_of(0), capture.outputs)


@pytest.mark.parametrize("case", CASES)
def test_every_output_is_the_references(renderer, case):
    cloud, requested = CASES[case]
    capture = fs.Capture(**{"camera": CAMERA, "outputs": OUTPUTS, "external_depth": a_surface()} | requested)
    resident = renderer.upload(cloud).data
    pipeline = renderer.backend.pipeline(prepare(resident, capture)[0])
    wrong = [one for one in differences(pipeline, resident, cloud, capture) if not one.agrees]
    away = np.eye(4)
    away[2, 3] = -100.0
    behind = cloud.transformed(away)  # only the surface is visible
    resident = renderer.upload(behind).data
    wrong += [one for one in differences(pipeline, resident, behind, capture) if not one.agrees]
    assert not wrong, wrong


def test_both_schedules_agree(renderer):
    cloud, requested = CASES["planes, fog, 2 x 2 samples"]
    capture = fs.Capture(CAMERA, OUTPUTS, external_depth=a_surface()).with_(**requested)
    resident = renderer.upload(cloud).data
    for shape in renderer.backend.configs("schedule").values():
        pipeline = renderer.backend.pipeline(prepare(resident, capture)[0], shape)
        wrong = [one for one in differences(pipeline, resident, cloud, capture) if not one.agrees]
        assert not wrong, wrong


def test_a_plane_that_crosses_the_surface_is_occluded_where_it_is_behind(renderer):
    """Not by its centre: pixel by pixel, by its own depth there."""
    plane = fs.SplatCloud([[0, 0, 0]], [[1, 0, 0, 0]], [[3.0, 3.0]], [0.9], colors=[[1, 0, 0]]).with_boxes()
    plane = plane.transformed(rigid_matrix((0, 0, 2), (1, 0, 0.3, 0))).with_labels(5)
    surface = fs.ExternalDepth(
        np.full((HEIGHT, WIDTH, 3), (0, 0, 255), np.uint8), np.full((HEIGHT, WIDTH), 2.0), 9
    )
    alone = renderer.render(plane, fs.Capture(CAMERA, OUTPUTS))
    both = renderer.render(plane, fs.Capture(CAMERA, OUTPUTS, external_depth=surface))
    front = (alone["depth"] > 0) & (alone["depth"] < 2.0)
    assert 0.3 < front.mean() < 0.7
    np.testing.assert_array_equal(both["label"], np.where(front, 5, 9))
    np.testing.assert_allclose(both["rgb"][~front], [[0, 0, 1]] * (~front).sum())
    np.testing.assert_allclose(both["rgb"][front], [[0.9, 0, 0.1]] * front.sum(), atol=1e-6)
    mixed = 0.9 * alone["depth"] + 0.1 * 2.0
    np.testing.assert_allclose(both["depth"], np.where(front, mixed, 2.0), rtol=1e-6)


def test_only_a_surface_in_front_of_all_splats_is_visible(renderer):
    surface = a_surface()
    near = fs.ExternalDepth(surface.rgb, np.full((HEIGHT, WIDTH), 0.5), surface.label)
    frame = renderer.render(a_cloud(), fs.Capture(CAMERA, OUTPUTS, external_depth=near))
    np.testing.assert_array_equal(frame["rgb"], surface.rgb)
    np.testing.assert_array_equal(frame["depth"], near.depth)
    assert (frame["label"] == 77).all()
    assert (frame["alpha"] == 1).all()


def test_views_of_a_batch_have_images_of_their_own(renderer):
    """As alone, bit for bit: of all views, with a masked view, and one image for all views."""
    surfaces = [a_surface(seed, label) for seed, label in ((0, 77), (1, 78), (2, 79))]
    arrays = (np.stack([getattr(one, name) for one in surfaces]) for name in ("rgb", "depth", "label"))
    poses = np.tile([0, 0, 0, 1.0, 0, 0, 0], (3, 1))
    poses[:, 0] = 0.0, 0.1, 0.2
    capture, cloud = fs.Capture(CAMERA, OUTPUTS, external_depth=fs.ExternalDepth(*arrays)), a_cloud()
    batch = renderer.render_batch(cloud, capture, poses=poses, mask=np.array([True, False, True]))
    shared = renderer.render_batch(cloud, capture.with_(external_depth=surfaces[0]), poses=poses)
    for images, number, surface in ((batch, 0, 0), (batch, 2, 2), (shared, 1, 0)):
        camera = CAMERA.with_pose(position=poses[number, :3])
        own = capture.with_(camera=camera, external_depth=surfaces[surface])
        alone = renderer.render(cloud, own)
        for name in OUTPUTS:
            np.testing.assert_array_equal(images[name][number], alone[name], err_msg=name)
    assert (batch["label"][1] == -1).all()
    np.testing.assert_array_equal(batch.frame(2).capture.external_depth.depth, surfaces[2].depth)
    if renderer.device.name.startswith("warp"):  # arrays of the device
        import warp as wp

        types = {"rgb": wp.vec3, "depth": wp.float32, "label": wp.int32}
        host, device = capture.external_depth, renderer.backend.device
        own = [wp.array(getattr(host, name), dtype=kind, device=device) for name, kind in types.items()]
        same = renderer.render_batch(
            cloud, capture.with_(external_depth=DeviceExternalDepth(*own)), poses=poses
        )
        for name in OUTPUTS:
            np.testing.assert_array_equal(same[name][::2], batch[name][::2], err_msg=name)
    with pytest.raises(fs.InputError, match="external_depth has 3, mask has 2"):
        renderer.render_batch(cloud, capture, mask=np.array([True, True]))
    with pytest.raises(fs.InputError, match="captures has 2, external_depth has 3"):
        renderer.render_batch(cloud, [capture, capture])


def test_an_empty_surface_changes_no_bit(renderer):
    nothing = fs.ExternalDepth(np.ones((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH)))
    alone = renderer.render(a_cloud(), fs.Capture(CAMERA, OUTPUTS))
    beside = renderer.render(a_cloud(), fs.Capture(CAMERA, OUTPUTS, external_depth=nothing))
    for name in OUTPUTS:
        assert alone[name].tobytes() == beside[name].tobytes(), name


def test_our_depth_is_an_external_depth_image(renderer):
    """A scene rendered in two parts, each occluded by the depth of the other: opaque splats have the same
    image."""
    boxes = fs.SplatCloud(
        [[-0.2, 0, 1.5], [0.2, 0, 2.0], [0, 0.1, 1.8]],
        np.tile([1, 0, 0, 0], (3, 1)),
        np.full((3, 2), 0.4),
        np.ones(3),
        colors=np.eye(3),
        labels=[1, 2, 3],
    ).with_boxes()
    first, rest = (fs.SplatCloud(
        boxes.means[rows], boxes.quats[rows], boxes.scales[rows], boxes.opacities[rows],
        colors=boxes.colors[rows], labels=boxes.labels[rows],
    ).with_boxes() for rows in ([1], [0, 2]))  # fmt: skip
    quality = "standard,opacity_ceiling=1"
    rendered = renderer.render(first, fs.Capture(CAMERA, OUTPUTS, quality))
    surface = fs.ExternalDepth(rendered["rgb"], rendered["depth"], np.maximum(rendered["label"], 0))
    both = renderer.render(rest, fs.Capture(CAMERA, OUTPUTS, quality, external_depth=surface))
    full_frame = renderer.render(boxes, fs.Capture(CAMERA, OUTPUTS, quality))
    inside = (
        np.abs(full_frame["rgb"] - np.rint(full_frame["rgb"])).max(-1) < 1e-6
    )  # edges cover parts of pixels
    assert inside.mean() > 0.8
    np.testing.assert_allclose(both["rgb"][inside], full_frame["rgb"][inside], atol=1e-6)
    np.testing.assert_array_equal(both["label"][inside], full_frame["label"][inside])


def test_views_of_a_batch_have_their_own_surfaces(renderer):
    first, second = a_surface(1), a_surface(2)
    for surfaces in ((first, second), (first, first)):
        captures = [fs.Capture(CAMERA, OUTPUTS, external_depth=surface) for surface in surfaces]
        batch = renderer.render_batch(a_cloud(), captures)
        for i, capture in enumerate(captures):
            alone = renderer.render(a_cloud(), capture)
            for name in ("rgb", "label"):
                assert batch[name][i].tobytes() == alone[name].tobytes()


@pytest.mark.parametrize("shape", [cpu_config(), gpu_config()], ids=["lanes", "group"])
def test_a_scene_without_a_surface_has_none_of_its_kernel_text(shape):
    plain = fs.Capture(CAMERA, OUTPUTS)
    text = assemble(select(a_cloud(), plain), shape).text
    assert "opaque" not in text
    assert "opaque" in assemble(select(a_cloud(), replace(plain, external_depth=a_surface())), shape).text


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: fs.ExternalDepth(np.zeros((4, 5)), np.zeros((4, 5))), r"got \(4, 5\) and \(4, 5\)"),
        (
            lambda: fs.ExternalDepth(np.zeros((4, 5, 3)), np.full((4, 5), -1.0)),
            "depths of at least 0, got -1",
        ),
        (lambda: fs.ExternalDepth(np.full((4, 5, 3), np.nan), np.ones((4, 5))), "must have finite colours"),
        (lambda: fs.ExternalDepth(np.zeros((4, 5, 3)), np.ones((4, 5)), 0.5), "must be integers"),
        (lambda: fs.ExternalDepth(np.zeros((4, 5, 3)), np.ones((4, 5)), [1, 2]), "must be integers"),
        (lambda: fs.ExternalDepth("red", np.ones((4, 5))), "rgb of external_depth must be an array"),
        (lambda: fs.Capture(CAMERA, external_depth=3), "external_depth must be a ExternalDepth"),
    ],
)
def test_unusable_external_depth_images(make, words):
    with pytest.raises(fs.InputError, match=words):
        make()


def test_a_surface_of_another_size_and_one_of_a_long_exposure(reference):
    small = fs.ExternalDepth(np.zeros((4, 5, 3)), np.ones((4, 5)))
    with pytest.raises(fs.InputError, match="must have the camera's 37 x 22 pixels, got 5 x 4"):
        reference.render(a_cloud(), fs.Capture(CAMERA, external_depth=small))
    blurred = fs.Capture(
        CAMERA,
        external_depth=a_surface(),
        motion=fs.Motion(lambda t: np.eye(4)),
        shutter=fs.Shutter(exposure_time=0.1),
    )
    with pytest.raises(fs.InputError, match="must have a shutter with exposure_time=0"):
        reference.render(a_cloud(), blurred)
