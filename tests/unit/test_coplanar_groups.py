"""Sort keys of planes."""

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.coplanar_groups import PlaneTable
from fidsplat.backends.prepare import view_of as moved_view_of
from fidsplat.backends.view import View
from fidsplat.capture.views import views_of
from fidsplat.selftest.clouds import rotation, splats, subset_of
from fidsplat.splats.rotations import quaternion_to_matrix

CAMERA = fs.Camera.look_at(64, 48, 1.0, (0.4, -0.2, -2.0), (0, 0, 0))


def view_of(cloud, camera=CAMERA, quality=None):
    return View.of(fs.Capture(camera, quality=quality or fs.Quality()), cloud.origin)


def some_planes(seed=0, ids=(7, 3, 2_000_000_000)):
    """Three tilted planes of 20 splats and 10 splats of none, shuffled."""
    generator = np.random.default_rng(seed)
    parts = []
    for _ in ids:
        turn = rotation(generator.normal(size=3), generator.uniform(0, 70))
        axes = quaternion_to_matrix(turn)
        means = generator.uniform(-0.5, 0.5, (20, 2)) @ axes[:, :2].T + generator.uniform(-0.5, 0.5, 3)
        parts.append(splats(means.astype(np.float32), turn, generator.uniform(0.01, 0.2, (20, 2))))
    parts.append(splats(generator.uniform(-1, 1, (10, 3)), (1, 0, 0, 0), 0.1))
    cloud = fs.SplatCloud.concatenate(parts).with_coplanar_groups(np.repeat([*ids, -1], [20, 20, 20, 10]))
    return subset_of(cloud, generator.permutation(len(cloud)))


@pytest.mark.parametrize("away", [(0, 0, 0), (3, -5, 8)])
@pytest.mark.parametrize("cutoff", [1 / 255, 1e-6])
def test_a_key_is_a_diameter_before_every_point_of_the_splats(cutoff, away):
    quality, pose = fs.Quality(alpha_cutoff=cutoff), np.eye(4)
    pose[:3, 3] = away
    cloud = some_planes().transformed(pose)
    view = view_of(cloud, quality=quality)
    keys = PlaneTable(cloud).keys(view)
    radius = np.sqrt(2 * np.log(1 / cutoff))
    angle = np.linspace(0, 2 * np.pi, 60)
    for number, plane in enumerate((3, 7, 2_000_000_000)):
        own = cloud.coplanar_groups == plane
        axes = quaternion_to_matrix(cloud.quats[own])[:, :, :2] * cloud.scales[own][:, None, :]
        rim = cloud.means[own][:, None] + radius * np.einsum(
            "nij,jk->nki", axes, np.stack([np.cos(angle), np.sin(angle)])
        )
        points = rim.reshape(-1, 3)
        depth = points @ view.rotation[2] + view.translation[2]
        diameter = np.linalg.norm(points[:, None] - points[None], axis=2).max()
        assert keys[number] <= depth.min() - diameter
        # and not much more than that: a box has corners
        assert keys[number] >= depth.min() - 3 * diameter


def test_the_key_of_boxes_is_before_their_corners():
    """Whatever the cut-off, at which a Gaussian would end within."""
    turn = rotation((0, 1, 0), 60)
    cloud = splats([(0, 0, 3)], turn, [(0.5, 0.2)]).with_boxes().with_coplanar_groups(0)
    view = view_of(cloud, quality=fs.Quality(alpha_cutoff=0.9))
    axes = quaternion_to_matrix(cloud.quats)[0, :, :2] * cloud.scales[0]
    corners = cloud.means + np.array([(u, v) for u in (-1, 1) for v in (-1, 1)]) @ axes.T
    depth = corners @ view.rotation[2] + view.translation[2]
    diagonal = 2 * np.hypot(0.5, 0.2)
    assert PlaneTable(cloud).keys(view)[0] <= depth.min() - diagonal


def test_index_is_dense_whatever_the_ids():
    cloud = some_planes()
    index = PlaneTable(cloud).index
    assert index.dtype == np.int32
    assert np.array_equal(index < 0, cloud.coplanar_groups < 0)
    for number, plane in enumerate((3, 7, 2_000_000_000)):
        assert np.array_equal(index == number, cloud.coplanar_groups == plane)


def test_keys_do_not_depend_on_the_order_of_splats():
    cloud = some_planes()
    shuffled = subset_of(cloud, np.random.default_rng(5).permutation(len(cloud)))
    assert np.array_equal(PlaneTable(cloud).keys(view_of(cloud)), PlaneTable(shuffled).keys(view_of(cloud)))


def test_planes_at_one_place_have_different_keys():
    one = splats([(0, 0, 1), (0.1, 0, 1)], (1, 0, 0, 0), 0.1)
    cloud = fs.SplatCloud.concatenate([one, one, one]).with_coplanar_groups([0, 0, 1, 1, 2, 2])
    keys = PlaneTable(cloud).keys(view_of(cloud))
    assert keys.dtype == np.float32
    assert len(np.unique(keys)) == 3
    assert np.ptp(keys) < 1e-5


def test_a_cloud_without_planes_has_none():
    cloud = splats([(0, 0, 1)], (1, 0, 0, 0), 0.1)
    table = PlaneTable(cloud)
    assert table.index.tolist() == [-1]
    assert table.keys(view_of(cloud)).shape == (0,)


@pytest.mark.parametrize("camera", [CAMERA, fs.Camera.fisheye(64, 48, 2.5)], ids=["pinhole", "fisheye"])
def test_keys_of_many_views_are_those_of_each(camera):
    """Bit for bit, also of planes that move by themselves."""
    cloud = some_planes()
    cloud = cloud.with_labels(np.where(cloud.coplanar_groups == 3, 1, 0))
    poses = np.random.default_rng(1).normal(0, 0.3, (20, 7)) + np.eye(7)[3]
    views = views_of([fs.Capture(camera)], poses, {1: poses[::-1].copy()})
    each = [moved_view_of(views.capture(k), cloud.origin) for k in range(20)]
    stack = ViewBatch.of_poses(each[0], cloud.origin, views.poses, views.groups, np.arange(20), 20)
    table = PlaneTable(cloud)
    assert np.array_equal(table.keys_of(stack), [table.keys(view) for view in each])
