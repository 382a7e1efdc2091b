"""Frames of several devices are bit-identical to those of one."""

import threading

import numpy as np
import pytest
from test_store_rendering import TURNED, build_small_store, look, splats

import fidsplat as fs
from fidsplat.store import build_plan


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build_plan, "_MIN_MEMORY", 0)
        return build_small_store(tmp_path_factory.mktemp("several"), splats(1), "disks")


@pytest.fixture(scope="module")
def two():
    return fs.SeveralDevices(["opencl", "opencl"])


def test_bands_of_several_devices_are_bit_identical(store, two):
    outputs = ("rgb", "splat_id", "depth")
    alone, cloud = fs.Renderer("opencl"), store.cloud()
    for scene in (store, cloud, fs.Scene([cloud], look())):
        given = two.upload(scene)
        for share in (0.5, 0.2, 0.97):
            two._borders = np.array([0.0, share, 1.0])
            ours = two.render(given, look(turn=TURNED), outputs)
            full_frame = alone.render(cloud, look(turn=TURNED), outputs)
            assert np.array_equal(ours.capture.camera.world_to_camera, look(turn=TURNED).world_to_camera)
            for output in outputs:
                assert np.array_equal(ours[output], full_frame[output]), (output, share)
    assert ours.stats["visible"] >= full_frame.stats["visible"]
    assert set(ours.timings) == set(full_frame.timings)


def _around():
    """A panorama camera with a panorama background."""
    image = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    return fs.Capture(fs.Camera.equirectangular(64, 32), background=fs.Panorama(image))


def _moving():
    """A moving camera and group with a rolling shutter."""
    path = fs.Trajectory([0.0, 1.0], [look().world_to_camera, look(at=(0.4, 0.1, 0.0)).world_to_camera])
    aside = np.eye(4) + np.eye(4, k=3) * 0.3
    groups = {0: fs.Trajectory([0.0, 1.0], [np.eye(4), aside])}
    shutter = fs.Shutter(time=0.5, exposure_time=0.2, sub_poses=2, readout=0.4, rows_per_band=7)
    return fs.Capture(look(), motion=fs.Motion(path, groups), shutter=shutter)


@pytest.mark.parametrize("capture", [_around(), _moving()], ids=["panorama", "shutter"])
def test_bands_of_effects_that_depend_on_the_row(two, capture):
    """Rays of a panorama and poses of a shutter are those of the complete frame."""
    cloud = splats(1).with_labels(np.arange(len(splats(1))) % 2)
    full_frame = fs.Renderer("opencl").render(cloud, capture)["rgb"]
    given = two.upload(cloud)
    for share in (0.3, 0.6):
        two._borders = np.array([0.0, share, 1.0])
        assert np.array_equal(two.render(given, capture)["rgb"], full_frame), share
    assert len(np.unique(full_frame.reshape(-1, 3), axis=0)) > 100


def test_splats_outside_a_band_are_not_big():
    # buffers of an earlier frame must not show in a big splat
    big = fs.SplatCloud([[0.0, 0.0, 2.0]], [[1.0, 0, 0, 0]], [[3.0, 3.0]], [0.1], colors=np.ones((1, 3)))
    cloud = fs.SplatCloud.concatenate([big, splats(1)])
    lower, camera = (fs.Camera.look_at(320, 240, 1.0, (0, 0, 0), (0, y, 1)) for y in (0.5, 0))
    renderer = fs.Renderer("opencl")
    renderer.render(cloud, lower).wait()
    for band in ((0, 20), (220, 240)):
        full_frame, rows = fs.Renderer("opencl").render(cloud, camera)["rgb"], slice(*band)
        assert np.array_equal(renderer.render_band(band, cloud, camera)["rgb"][rows], full_frame[rows])


def test_a_device_caches_the_visible_chunks_of_its_band(store, two):
    given = two.upload(store)
    two._borders = np.array([0.0, 0.5, 1.0])
    two.render(given, look()).wait()
    one = fs.Renderer("opencl")
    alone = one.upload(store)
    one.render(alone, look())
    each = [one.data.node_count for one in given]
    assert max(each) < alone.data.node_count <= sum(each)


def test_views_are_distributed_and_returned_in_order(store, two):
    cameras = [look(at=(x, 0, 0)) for x in (0.0, 0.3, 0.6, 0.9, 1.2, 1.5, 1.8)]
    alone = fs.Renderer("opencl")
    frames = two.render_views(two.upload(store), iter(cameras))
    for camera, frame in zip(cameras, frames, strict=True):
        assert np.array_equal(frame["rgb"], alone.render(store.cloud(), camera)["rgb"])
    # one output can be given by name
    assert two.render(store, cameras[0], "rgb").outputs == ("rgb",)
    assert [frame.outputs for frame in two.render_views(store, cameras[:1], "rgb")] == [("rgb",)]


def test_bands_adapt_to_the_speed_of_devices(two):
    two._borders = np.array([0.0, 0.5, 1.0])
    two._balance([50, 50], [3.0, 1.0])
    assert two._borders == pytest.approx([0, 1 / 3, 1])
    two._balance([33, 67], [1.0, 1.05])
    assert two._borders == pytest.approx([0, 1 / 3, 1])
    assert two._bands(3) == [(0, 1), (1, 3)]
    two._borders = np.array([0.0, 0.001, 1.0])
    assert two._bands(4) == [(0, 1), (1, 4)]
    two._borders = np.array([0.0, 0.999, 1.0])
    assert two._bands(4) == [(0, 3), (3, 4)]
    assert two._bands(1) == [(0, 1)]


def test_unsupported_requests_are_refused(store, two):
    with pytest.raises(fs.InputError, match="devices must name at least one device"):
        fs.SeveralDevices([])
    with pytest.raises(fs.InputError, match="devices must be of one model"):
        fs.SeveralDevices(["opencl", "reference"])
    with pytest.raises(fs.InputError, match="camera must be given, got none"):
        two.render(store)
    with pytest.raises(fs.InputError, match="scene must be uploaded to all 2 devices, got 1"):
        two.render(two.upload(store)[:1], look())
    with pytest.raises(fs.InputError, match="scene must be uploaded to all 2 devices, got 1"):
        list(two.render_views(two.upload(store)[:1], [look(), look()]))
    renderer = two.renderers[0]
    for band in ((-1, 3), (3, 3), (0, 31)):
        with pytest.raises(fs.InputError, match="of a band"):
            renderer.render_band(band, store, look())
    with pytest.raises(fs.InputError, match=r"band must be two rows .*got 5"):
        renderer.render_band(5, store, look())  # type: ignore[arg-type]


def test_frames_precede_a_failure_of_the_captures(store, two):
    def failing(count):
        for x in range(count):
            yield look(at=(0.1 * x, 0, 0))
        raise OSError("the list of cameras ends here")

    alone = fs.Renderer("opencl")
    for count in (0, 1, 3, 12):
        frames, results = two.render_views(two.upload(store), failing(count)), []
        with pytest.raises(OSError, match="ends here"):
            results.extend(frames)  # keeps those that came
        assert len(results) == count
        for x, frame in enumerate(results):
            expected = alone.render(store.cloud(), look(at=(0.1 * x, 0, 0)))["rgb"]
            assert np.array_equal(frame["rgb"], expected)
    frames, results = two.render_views(store, [look(), look(), fs.Capture(), look()]), []
    with pytest.raises(fs.InputError, match="camera must be given, got none"):
        results.extend(frames)
    assert len(results) == 2
    with pytest.raises(fs.InputError, match="must be a list of Capture or Camera"):
        list(two.render_views(store, 3))
    frames = two.render_views(store, [look(), None, look()])  # type: ignore[list-item]
    assert next(frames).outputs
    with pytest.raises(fs.InputError, match="camera must be given, got none"):
        next(frames)


def test_iteration_can_stop_early(store, two):
    before = threading.active_count()
    frames = two.render_views(two.upload(store), (look() for _ in range(1000)))
    next(frames)
    frames.close()
    assert threading.active_count() <= before


@pytest.mark.parametrize("count", [1, 2])
def test_a_scene_is_rendered_by_its_own_camera(count):
    """Also by a single device."""
    tag = fs.scenes.PlacedMarker(fs.marker("aruco:4x4_50:7", size=0.4))
    scene = fs.Scene([], fs.Camera.look_at(24, 16, 1.0, (0.1, 0, -1), (0, 0, 0)), [tag])
    several = fs.SeveralDevices(["reference"] * count)
    expected = fs.Renderer("reference").render(scene)["rgb"]
    np.testing.assert_array_equal(several.render(scene, outputs=("rgb",))["rgb"], expected)
