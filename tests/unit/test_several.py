"""Pictures by several devices: the bits of one, whichever rows each draws."""

import threading

import numpy as np
import pytest
from test_store_drawing import TURNED, look, made_store, splats

import fidsplat as fs
from fidsplat.store import build_plan


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build_plan, "_MIN_MEMORY", 0)
        return made_store(tmp_path_factory.mktemp("several"), splats(1), "disks")


@pytest.fixture(scope="module")
def two():
    return fs.SeveralDevices(["opencl", "opencl"])


def test_bands_of_devices_have_the_bits_of_one(store, two):
    outputs = ("rgb", "splat_id", "depth")
    alone, cloud = fs.Renderer("opencl"), store.cloud()
    for scene in (store, cloud, fs.Scene([cloud], look())):
        given = two.upload(scene)
        for share in (0.5, 0.2, 0.97):
            two._shares = np.array([0.0, share, 1.0])
            ours = two.render(given, look(turn=TURNED), outputs)
            whole = alone.render(cloud, look(turn=TURNED), outputs)
            assert np.array_equal(ours.capture.camera.world_to_camera, look(turn=TURNED).world_to_camera)
            for output in outputs:
                assert np.array_equal(ours[output], whole[output]), (output, share)
    assert ours.stats["visible"] >= whole.stats["visible"]
    assert set(ours.timings) == set(whole.timings)


def _around():
    """A panorama before a panorama."""
    image = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    return fs.Capture(fs.Camera.equirectangular(64, 32), background=fs.Panorama(image))


def _moving():
    """A camera and a group that move while rows are read out one after another."""
    path = fs.Trajectory([0.0, 1.0], [look().world_to_camera, look(at=(0.4, 0.1, 0.0)).world_to_camera])
    aside = np.eye(4) + np.eye(4, k=3) * 0.3
    groups = {0: fs.Trajectory([0.0, 1.0], [np.eye(4), aside])}
    shutter = fs.Shutter(time=0.5, exposure_time=0.2, sub_poses=2, readout=0.4, rows_per_band=7)
    return fs.Capture(look(), motion=fs.Motion(path, groups), shutter=shutter)


@pytest.mark.parametrize("capture", [_around(), _moving()], ids=["panorama", "shutter"])
def test_bands_of_what_has_rows_of_its_own(two, capture):
    """Rays by the row of a panorama, and poses by the row of a shutter, are those of the whole picture."""
    cloud = splats(1).with_labels(np.arange(len(splats(1))) % 2)
    whole = fs.Renderer("opencl").render(cloud, capture)["rgb"]
    given = two.upload(cloud)
    for share in (0.3, 0.6):
        two._shares = np.array([0.0, share, 1.0])
        assert np.array_equal(two.render(given, capture)["rgb"], whole), share
    assert len(np.unique(whole.reshape(-1, 3), axis=0)) > 100


def test_splats_beside_a_band_are_not_taken_for_big_ones():
    # what another picture has left on the device must not show where a big splat stands
    big = fs.SplatCloud([[0.0, 0.0, 2.0]], [[1.0, 0, 0, 0]], [[3.0, 3.0]], [0.1], colors=np.ones((1, 3)))
    cloud = fs.SplatCloud.concatenate([big, splats(1)])
    lower, camera = (fs.Camera.look_at(320, 240, 1.0, (0, 0, 0), (0, y, 1)) for y in (0.5, 0))
    renderer = fs.Renderer("opencl")
    renderer.render(cloud, lower).wait()
    for band in ((0, 20), (220, 240)):
        whole, rows = fs.Renderer("opencl").render(cloud, camera)["rgb"], slice(*band)
        assert np.array_equal(renderer.render_band(band, cloud, camera)["rgb"][rows], whole[rows])


def test_a_device_holds_the_chunks_that_its_band_sees(store, two):
    given = two.upload(store)
    two._shares = np.array([0.0, 0.5, 1.0])
    two.render(given, look()).wait()
    one = fs.Renderer("opencl")
    alone = one.upload(store)
    one.render(alone, look())
    each = [one.data.nodes for one in given]
    assert max(each) < alone.data.nodes <= sum(each)


def test_views_are_shared_out_and_come_in_their_order(store, two):
    cameras = [look(at=(x, 0, 0)) for x in (0.0, 0.3, 0.6, 0.9, 1.2, 1.5, 1.8)]
    alone = fs.Renderer("opencl")
    frames = two.render_views(two.upload(store), iter(cameras))
    for camera, frame in zip(cameras, frames, strict=True):
        assert np.array_equal(frame["rgb"], alone.render(store.cloud(), camera)["rgb"])
    # one output may be given by its name, as to a renderer
    assert two.render(store, cameras[0], "rgb").outputs == ("rgb",)
    assert [frame.outputs for frame in two.render_views(store, cameras[:1], "rgb")] == [("rgb",)]


def test_bands_are_cut_where_devices_take_as_long(two):
    two._shares = np.array([0.0, 0.5, 1.0])
    two._cut_anew([50, 50], [3.0, 1.0])
    assert two._shares == pytest.approx([0, 1 / 3, 1])
    two._cut_anew([33, 67], [1.0, 1.05])
    assert two._shares == pytest.approx([0, 1 / 3, 1])
    assert two._bands(3) == [(0, 1), (1, 3)]
    two._shares = np.array([0.0, 0.001, 1.0])
    assert two._bands(4) == [(0, 1), (1, 4)]
    two._shares = np.array([0.0, 0.999, 1.0])
    assert two._bands(4) == [(0, 3), (3, 4)]
    assert two._bands(1) == [(0, 1)]


def test_what_several_devices_cannot_draw_is_said(store, two):
    with pytest.raises(fs.InputError, match="devices is empty"):
        fs.SeveralDevices([])
    with pytest.raises(fs.InputError, match="of different kinds"):
        fs.SeveralDevices(["opencl", "reference"])
    with pytest.raises(fs.InputError, match="no camera"):
        two.render(store)
    with pytest.raises(fs.InputError, match="a scene on 1 devices was given to 2"):
        two.render(two.upload(store)[:1], look())
    with pytest.raises(fs.InputError, match="a scene on 1 devices was given to 2"):
        list(two.render_views(two.upload(store)[:1], [look(), look()]))
    renderer = two.renderers[0]
    for band in ((-1, 3), (3, 3), (0, 31)):
        with pytest.raises(fs.InputError, match="of a band"):
            renderer.render_band(band, store, look())
    with pytest.raises(fs.InputError, match="band is 5; it must be two rows"):
        renderer.render_band(5, store, look())  # type: ignore[arg-type]


def test_pictures_come_before_the_failure_of_what_asks_for_them(store, two):
    def failing(count):
        for x in range(count):
            yield look(at=(0.1 * x, 0, 0))
        raise OSError("the list of cameras ends here")

    alone = fs.Renderer("opencl")
    for count in (0, 1, 3, 12):
        frames, made = two.render_views(two.upload(store), failing(count)), []
        with pytest.raises(OSError, match="ends here"):
            made.extend(frames)  # keeps those that came
        assert len(made) == count
        for x, frame in enumerate(made):
            wanted = alone.render(store.cloud(), look(at=(0.1 * x, 0, 0)))["rgb"]
            assert np.array_equal(frame["rgb"], wanted)
    frames, made = two.render_views(store, [look(), look(), fs.Capture(), look()]), []
    with pytest.raises(fs.InputError, match="no camera"):
        made.extend(frames)
    assert len(made) == 2
    with pytest.raises(fs.InputError, match="must be a list of Capture or Camera"):
        list(two.render_views(store, 3))
    frames = two.render_views(store, [look(), None, look()])  # type: ignore[list-item]
    assert next(frames).outputs
    with pytest.raises(fs.InputError, match="no camera"):
        next(frames)


def test_views_may_be_left_before_their_end(store, two):
    before = threading.active_count()
    frames = two.render_views(two.upload(store), (look() for _ in range(1000)))
    next(frames)
    frames.close()
    assert threading.active_count() <= before
