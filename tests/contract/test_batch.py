"""Renderer.render_batch, on every device: a view has the bits of itself alone, whatever is rendered with
it."""

import pickle

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, random_splats
from derivative_errors import stretched

import fidsplat as fs
from fidsplat.capture.views import capture_batch
from fidsplat.splats.rotations import rigid_matrix

CAMERA = fs.Camera.look_at(50, 40, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
CAMERAS = [fs.Camera.look_at(50, 40, 1.0, (x, 0.1, -0.1), (0.0, 0.0, 3.0)) for x in (-0.4, 0.0, 0.3)]
POSES = np.array([[0.1, 0, -0.2, 1, 0, 0, 0], [0, 0.1, 0, 1, 0.02, 0, 0.1], [0, 0, 0.2, 2, 0, -0.1, 0]])


@pytest.fixture(scope="module")
def cloud():
    return random_splats(300, seed=2).with_labels(np.arange(300) % 3)


def assert_same(batch, frames):
    """Each view has the bits of a frame; None: it is masked out."""
    for name in batch.outputs:
        assert len(batch[name]) == len(frames)
        for number, (images, frame) in enumerate(zip(batch[name], frames, strict=True)):
            if frame is None:
                assert (images == (-1 if name == "label" else 0)).all(), (number, name)
            else:
                assert np.array_equal(images, frame[name]), (number, name)
                assert images.dtype == frame[name].dtype


def moved(pose):
    """A motion that is constantly at a pose (7,)."""
    return lambda time: rigid_matrix(pose[:3], pose[3:])


def camera_at(pose):
    rotation = rigid_matrix((0, 0, 0), pose[3:])[:3, :3].T
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ pose[:3]
    return fs.Camera.pinhole(50, 40, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, matrix, position=pose[:3])


def test_views_are_bit_identical_to_single_frames(renderer, cloud):
    captures = [fs.Capture(camera, ALL_OUTPUTS) for camera in CAMERAS]
    batch = renderer.render_batch(cloud, captures)
    assert batch["rgb"].shape == (3, 40, 50, 3)
    assert batch["depth"].shape == (3, 40, 50)
    assert not batch["rgb"].flags.writeable
    assert_same(batch, [renderer.render(cloud, capture) for capture in captures])
    assert_same(renderer.render_batch(cloud, captures[1:2]), [renderer.render(cloud, captures[1])])
    assert batch.stats["splats"] == 300
    assert batch.stats["pairs"] == sum(renderer.render(cloud, each).stats["pairs"] for each in captures)


def test_poses_take_the_place_of_the_cameras_own(renderer, cloud):
    batch = renderer.render_batch(cloud, fs.Capture(CAMERA, ALL_OUTPUTS), poses=POSES)
    assert_same(batch, [renderer.render(cloud, camera_at(pose), ALL_OUTPUTS) for pose in POSES])


def test_groups_move_in_each_view_by_themselves(renderer, cloud):
    """About the world's origin, wherever the cloud has its own."""
    origin = np.array([0.5, -0.25, 2.0])
    own = fs.SplatCloud(
        *((cloud.means - origin).astype(np.float32), cloud.quats, cloud.scales, cloud.opacities),
        colors=cloud.colors, labels=cloud.labels, origin=origin,
    )  # fmt: skip
    groups = {1: POSES, 2: POSES[::-1]}
    motions = [fs.Motion(groups={label: moved(each[k]) for label, each in groups.items()}) for k in range(3)]
    for each in (cloud, own):
        batch = renderer.render_batch(each, fs.Capture(CAMERA, ALL_OUTPUTS), groups=groups)
        assert_same(batch, [renderer.render(each, CAMERA, ALL_OUTPUTS, motion=motion) for motion in motions])


def test_masked_views_are_not_rendered(renderer, cloud):
    captures = [fs.Capture(camera, ALL_OUTPUTS, background=(0.5, 0.5, 0.5)) for camera in CAMERAS]
    mask = np.array([False, True, False])
    batch = renderer.render_batch(cloud, captures, mask=mask)
    assert_same(batch, [None, renderer.render(cloud, captures[1]), None])
    none = renderer.render_batch(cloud, captures, mask=mask & False)
    assert_same(none, [None] * 3)
    assert none.stats == {"splats": 300, "visible": 0, "pairs": 0}


def test_a_batch_outlives_the_next(renderer, cloud):
    first = renderer.render_batch(cloud, [fs.Capture(camera, ALL_OUTPUTS) for camera in CAMERAS])
    frame = renderer.render(cloud, CAMERA, ALL_OUTPUTS)
    renderer.render_batch(cloud, [fs.Capture(camera, ALL_OUTPUTS) for camera in CAMERAS[::-1]])
    assert_same(first, [renderer.render(cloud, camera, ALL_OUTPUTS) for camera in CAMERAS])
    assert np.array_equal(frame["rgb"], renderer.render(cloud, CAMERA)["rgb"])


def test_a_batch_stays_on_its_device(renderer, cloud):
    batch = renderer.render_batch(cloud, fs.Capture(CAMERA, ALL_OUTPUTS), poses=POSES).wait()
    arrays = {name: batch.device_array(name) for name in ALL_OUTPUTS}
    for name, array in arrays.items():
        assert tuple(array.shape) == batch[name].shape
        on_host = array.numpy() if hasattr(array, "numpy") else array.get()
        assert np.array_equal(on_host, batch[name])
    assert set(batch.timings) >= {"project", "blend"}
    with pytest.raises(fs.InputError, match="got 'distance'"):
        batch.device_array("distance")


def test_a_view_as_a_frame_and_a_batch_as_arrays(renderer, cloud):
    batch = renderer.render_batch(cloud, CAMERAS)
    frame = batch.frame(2)
    assert isinstance(frame, fs.Frame)
    assert np.array_equal(frame["rgb"], batch["rgb"][2])
    copy = pickle.loads(pickle.dumps(batch))
    assert np.array_equal(copy["rgb"], batch["rgb"])
    assert copy.views == batch.views == 3
    with pytest.raises(fs.InputError, match="view must be a whole number from 0 to 2, got 3"):
        batch.frame(3)
    with pytest.raises(fs.InputError, match="must be one of rgb, got 'depth'"):
        batch["depth"]


LENSES = {
    "fisheye": fs.Camera.fisheye(50, 40, 2.5),
    "orthographic": fs.Camera.orthographic(50, 40, 3.0),
}


@pytest.mark.parametrize("lens", LENSES)
def test_effects_are_those_of_single_views(renderer, cloud, lens):
    """Rays per sample, fog, a sensor with noise by pixel, several samples; rendered one by one if a batch
    cannot hold the additional buffers."""
    capture = fs.Capture(
        LENSES[lens], ("rgb", "normal"), "standard,samples=2", (0.1, 0.2, 0.3), fog=fs.Fog(0.1),
        sensor=fs.Sensor(full_well=1000.0, vignetting=(-0.3, 0.0, 0.0)),
    )  # fmt: skip
    batch = renderer.render_batch(cloud, capture, poses=POSES, groups={1: POSES})
    for number in range(3):
        alone = capture_batch([capture], POSES[[number]], {1: POSES[[number]]}).capture(0)
        frame = renderer.render(cloud, alone)
        assert all(np.array_equal(batch[name][number], frame[name]) for name in batch), number


TURNED = 0.5 * np.array([[0, 0, 0, 2, 0, 0, 0], [0, 0, 0, 2, 0.5, -0.4, 0.2], [0.2, 0, 0, 2, 0, 1.5, 0]])
BACKGROUNDS = {
    "gradient": fs.Gradient((0.9, 0.2, 0.1), (0.1, 0.3, 0.8), up=(0.3, -1.0, 0.2)),
    "panorama": fs.Panorama(np.random.default_rng(3).uniform(0, 1, (8, 16, 3)).astype(np.float32)),
}


@pytest.mark.parametrize("name", BACKGROUNDS)
def test_each_view_sees_the_background_in_its_own_direction(renderer, cloud, name):
    """With fog and a sensor, whose noise is that of single frames too."""
    capture = fs.Capture(
        stretched(CAMERA), ("rgb",), background=BACKGROUNDS[name],
        sensor=fs.Sensor(full_well=1000.0, vignetting=(-0.3, 0.0, 0.0)),
    )  # fmt: skip
    batch = renderer.render_batch(cloud, capture, poses=TURNED)
    frames = [
        renderer.render(cloud, capture_batch([capture], TURNED[[number]], None).capture(0))
        for number in range(3)
    ]
    assert_same(batch, frames)
    corners = batch["rgb"][:, 0, 0]
    assert all(np.abs(corners[a] - corners[b]).max() > 0.02 for a, b in ((0, 1), (0, 2), (1, 2)))


def test_exposures_of_a_batch_are_those_of_single_frames(renderer, cloud):
    """Views with a pose each and a group that moves while the shutter is open."""
    going = fs.Motion(groups={1: lambda time: rigid_matrix((3 * time, 0, 0), (1, 0, 0, time))})
    shutter = fs.Shutter(exposure_time=0.1, sub_poses=2)
    captures = [
        fs.Capture(camera, ("rgb", "depth"), motion=going, shutter=shutter, background=(0.2, 0.4, 0.6))
        for camera in CAMERAS
    ]
    batch = renderer.render_batch(cloud, captures)
    assert_same(batch, [renderer.render(cloud, capture) for capture in captures])
    still = renderer.render(cloud, CAMERAS[0], background=(0.2, 0.4, 0.6))
    assert not np.array_equal(batch["rgb"][0], still["rgb"])


def test_what_moves_already_may_go_on_in_addition_to_poses(renderer, cloud):
    """A motion of the capture's own groups, a shutter that is open for a while, and masks, in one batch."""
    capture = fs.Capture(
        CAMERA, ("rgb",), motion=fs.Motion(groups={2: moved(POSES[0])}),
        shutter=fs.Shutter(exposure_time=0.1, sub_poses=2),
    )  # fmt: skip
    batch = renderer.render_batch(cloud, capture, poses=POSES, mask=np.array([True, False, True]))
    expected = [renderer.render(cloud, capture.with_(camera=camera_at(POSES[k]))) for k in (0, 2)]
    assert_same(batch, [expected[0], None, expected[1]])


def test_a_batch_of_exposures_counts_all_its_images(renderer, cloud):
    """Against the memory budget, while each is made of its sub-frames."""
    if renderer.device.name == "reference":
        pytest.skip("no memory budget")
    capture = fs.Capture(
        CAMERA, ("rgb",), motion=fs.Motion(groups={2: moved(POSES[0])}),
        shutter=fs.Shutter(exposure_time=0.1, sub_poses=2),
    )  # fmt: skip
    poses = np.repeat(POSES, 200, axis=0)
    separate_renderer = fs.Renderer(renderer.device.name, memory_budget=600 * 50 * 40 * 12 + 10_000)
    with pytest.raises(fs.DeviceError, match=r"memory_budget must exceed .*, got 13\.7 MiB; raise it"):
        separate_renderer.render_batch(cloud, capture, poses=poses)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"captures": []}, "at least one view, got an empty captures"),
        ({"captures": 5}, "captures must be a list of Capture or Camera, got 5"),
        ({"captures": [CAMERA, "front"]}, "camera must be .* got 'front'"),
        ({"captures": [CAMERA, fs.Camera.pinhole(51, 40, 9, 9, 9, 9)]}, "same size.* 51 x 40.* for view 1"),
        ({"captures": [CAMERA, fs.Capture(CAMERA, "alpha")]}, "same outputs"),
        (
            {"captures": [CAMERA, fs.Capture(CAMERA, sensor=fs.Sensor(gain=2.0))]},
            "views 0 and 1 that differ in gain",
        ),
        ({"captures": CAMERAS, "poses": POSES[:2]}, "captures has 3, poses has 2"),
        ({"poses": POSES[:, :6]}, r"poses must have the shape \(views, 7\).* \(3, 6\)"),
        ({"poses": np.zeros((0, 7))}, "at least one view, got an empty poses"),
        ({"poses": np.zeros((2, 7))}, r"poses\[0\] must be x y z, .* not all 0"),
        ({"poses": np.full((2, 7), np.nan)}, r"poses\[0\] must be x y z"),
        ({"groups": {9: POSES}}, "unknown label of splats '9'; known: 0, 1, 2"),
        ({"groups": {"1": POSES}}, "keys of groups must be integer labels, got '1'"),
        ({"groups": [POSES]}, "groups must be {label: poses"),
        ({"groups": {1: POSES}, "poses": POSES[:2]}, r"poses has 2, groups\[1\] has 3"),
        ({"poses": POSES, "mask": [True]}, "poses has 3, mask has 1"),
        ({"mask": [1, 0]}, "mask must be .* bools"),
        (
            {"captures": fs.Capture(CAMERA, motion=fs.Motion(lambda time: np.eye(4))), "poses": POSES},
            "the camera of view 0 must be moved by poses or by its motion, got both",
        ),
        (
            {"captures": fs.Capture(CAMERA, motion=fs.Motion(groups={1: np.eye})), "groups": {1: POSES}},
            "the splats of label 1 in view 0 must be moved by groups or",
        ),
        (
            {"captures": fs.Capture(CAMERA, motion=fs.Motion(groups={1: lambda time: 2 * np.eye(4)}))},
            "last row",
        ),
    ],
)
def test_errors_name_what_is_not_a_batch(renderer, cloud, arguments, words):
    with pytest.raises(fs.InputError, match=words):
        renderer.render_batch(cloud, **{"captures": CAMERA, **arguments})
