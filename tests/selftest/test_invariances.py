"""Images that stay bit-identical when something irrelevant changes."""

from dataclasses import replace

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.selftest.agreement import (
    ALL_OUTPUTS,
    CULLED,
    FrameSpec,
    differing,
    render,
    render_intermediates,
)
from fidsplat.selftest.clouds import camera, rotation, splats, subset_of
from fidsplat.selftest.order import tag

CLOUDS = {
    "around the camera": random_splats(150, seed=31),
    "larger than the image": random_splats(60, seed=32, scale=(0.1, 30.0)),
    "smaller than a pixel": random_splats(300, seed=33, depth=(1, 6), scale=(1e-6, 1e-2)),
    "on planes": fs.SplatCloud.concatenate(
        [
            tag().transformed(np.array([[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 1.5], [0, 0, 0, 1.0]])),
            random_splats(60, seed=34, depth=(0.5, 3)),
        ]
    ),
}


@pytest.fixture(params=CLOUDS)
def spec(request):
    return FrameSpec(CLOUDS[request.param], camera(93, 77, 70.0), outputs=ALL_OUTPUTS)


def test_run_to_run(renderer, spec):
    first = render(renderer, spec)
    assert all(differing(first, render(renderer, spec), ALL_OUTPUTS) == 0 for _ in range(4))


def test_tile_sizes(renderer, spec):
    if not renderer.backend.has("probe"):
        pytest.skip("renders without tiles")
    own = render(renderer, spec)
    for shape in renderer.backend.configs("tiles").values():
        assert differing(own, render_intermediates(renderer, spec, shape), ALL_OUTPUTS) == 0, shape


def test_one_tile_for_the_complete_image(renderer):
    """Cases A4 and A5: an image of one tile has every fragment that a tile could lack."""
    if not renderer.backend.has("probe"):
        pytest.skip("renders without tiles")
    own = renderer.backend.config
    width, height = (own.lanes, 32) if own.schedule == "lanes" else (32, 32)
    whole = replace(own, tile_width=width, tile_height=height)
    for cloud in CLOUDS.values():
        spec = FrameSpec(cloud, camera(width, height, 20.0), outputs=ALL_OUTPUTS)
        buffers = render_intermediates(renderer, spec, whole)
        assert len(buffers["starts"]) == 2
        for shape in renderer.backend.configs("tiles").values():
            assert differing(buffers, render_intermediates(renderer, spec, shape), ALL_OUTPUTS) == 0, shape


def test_a_batch_equals_its_single_frames(renderer):
    cloud = CLOUDS["around the camera"]
    cameras = [
        fs.Camera.look_at(93, 77, 1.0, position, (0, 0, 3))
        for position in ((0, 0, -0.1), (1, 0.2, 0), (-1, 0, 6))
    ]
    batch = renderer.render_batch(cloud, [fs.Capture(view, outputs=ALL_OUTPUTS) for view in cameras])
    for number, view in enumerate(cameras):
        alone = fs.Renderer(renderer.device.name).render(cloud, view, ALL_OUTPUTS)
        assert differing(batch.frame(number), alone, ALL_OUTPUTS) == 0


def test_frames_of_one_upload_equal_those_of_a_new_renderer(renderer):
    """Several cameras with one renderer and upload, against a new renderer for each."""
    cloud = CLOUDS["around the camera"]
    cameras = [
        fs.Camera.look_at(*size, 1.0, position, (0, 0, 3))
        for size, position in (((93, 77), (0, 0, -0.1)), ((40, 30), (1, 0.2, 0)), ((120, 9), (-1, 0, 6)))
    ]
    resident = renderer.upload(cloud)
    batch = [renderer.render(resident, view, ALL_OUTPUTS) for view in cameras]
    for view, frame in zip(cameras, batch, strict=True):
        alone = fs.Renderer(renderer.device.name).render(cloud, view, ALL_OUTPUTS)
        assert differing(frame, alone, ALL_OUTPUTS) == 0


def test_removing_culled_splats_changes_nothing(renderer, spec):
    keys = render_intermediates(renderer, spec)["keys"]
    visible = np.flatnonzero(keys != CULLED)
    fewer = replace(spec, cloud=subset_of(spec.cloud, visible))
    assert differing(render(renderer, spec), render(renderer, fewer), ALL_OUTPUTS) == 0


def test_splats_behind_the_camera_are_culled(renderer):
    behind = random_splats(100, seed=35, depth=(-6.0, -3.0), scale=(0.01, 0.5))
    assert render(renderer, FrameSpec(behind, camera())).stats["visible"] == 0


@pytest.mark.parametrize(("right", "down"), [(16, 0), (7, 5), (-3, 11)])
def test_a_principal_point_shift_by_pixels_shifts_the_image(renderer, right, down):
    """All centres stay inside of the image, so that anchors do not change."""
    cloud = random_splats(120, seed=36, depth=(2.0, 5.0), scale=(1e-3, 0.5), across=0.5)
    still = camera(120, 100, 90.0)
    moved = camera(120, 100, 90.0, cx=60.0 + right, cy=50.0 + down)
    frames = [render(renderer, FrameSpec(cloud, view, outputs=ALL_OUTPUTS)) for view in (still, moved)]
    rows, columns = max(down, 0), max(right, 0)
    after = np.s_[rows : 100 + min(down, 0), columns : 120 + min(right, 0)]
    before = np.s_[rows - down : 100 + min(down, 0) - down, columns - right : 120 + min(right, 0) - right]
    first = {name: frames[0][name][before] for name in ALL_OUTPUTS}
    second = {name: frames[1][name][after] for name in ALL_OUTPUTS}
    assert first["alpha"].max() > 0.5
    assert differing(first, second, ALL_OUTPUTS) == 0


def mirrored(cloud: fs.SplatCloud) -> fs.SplatCloud:
    """The cloud mirrored at x = 0; the normals flip."""
    w, x, y, z = cloud.quats.T
    return fs.SplatCloud(
        cloud.means * np.float32([-1, 1, 1]),
        np.stack([y, z, w, x], axis=1),
        cloud.scales,
        cloud.opacities,
        colors=cloud.colors,
        labels=cloud.labels,
    )


@pytest.mark.parametrize("width", [92, 93])
def test_a_mirrored_scene_has_a_mirrored_image(renderer, width):
    cloud = random_splats(150, seed=37, depth=(-1.0, 6.0))
    names = [name for name in ALL_OUTPUTS if name != "normal"]
    view = camera(width, 77, 70.0)
    image = render(renderer, FrameSpec(cloud, view, outputs=ALL_OUTPUTS))
    mirror = render(renderer, FrameSpec(mirrored(cloud), view, outputs=ALL_OUTPUTS))
    assert differing(image, {name: mirror[name][:, ::-1] for name in names}, names) == 0


@pytest.mark.parametrize(("width", "height"), [(1, 1), (3, 5), (33, 1), (101, 79)])
def test_a_centred_splat_in_an_odd_image_is_symmetric(renderer, width, height):
    for quat in ((1, 0, 0, 0), rotation((1, 0, 0), 70), rotation((0, 1, 0), 89.9)):
        spec = FrameSpec(splats([[0, 0, 2]], quat, (0.3, 0.2), 0.9), camera(width, height, 30.0))
        alpha = np.asarray(render(renderer, spec)["alpha"])
        if quat[1] == 0:  # not tilted about x
            assert np.array_equal(alpha, alpha[::-1])
        if quat[2] == 0:
            assert np.array_equal(alpha, alpha[:, ::-1])


def test_a_translated_world_is_bit_identical(renderer):
    """Case B5 for a cloud and a camera that are translated together."""
    cloud = random_splats(100, seed=38, depth=(1.0, 6.0), scale=(1e-2, 0.5))
    cloud = fs.SplatCloud(
        cloud.means, cloud.quats, cloud.scales, cloud.opacities, colors=cloud.colors, origin=(1.0, 2.0, -3.0)
    )
    frames = []
    for shift in ((0.0, 0.0, 0.0), (5e5, 4.5e6, 300.0), (-1e7, 0.5, 1e8)):
        pose = np.eye(4)
        pose[:3, 3] = shift
        position, target = np.add(shift, (1.5, 2.0, -3.25)), np.add(shift, (1.0, 2.25, 1.0))
        view = fs.Camera.look_at(93, 77, 1.0, position, target)
        frames.append(render(renderer, FrameSpec(cloud.transformed(pose), view, outputs=ALL_OUTPUTS)))
    assert all(differing(frames[0], other, ALL_OUTPUTS) == 0 for other in frames[1:])
