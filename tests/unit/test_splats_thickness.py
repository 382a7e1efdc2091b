"""SplatCloud: 3D Gaussians, which have a thickness, together with disks and boxes."""

import pickle

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.splats.rotations import quaternion_to_matrix, rigid_matrix

F32 = np.float32


def cloud_of(n=6, seed=0, thickness=None, **more):
    r = np.random.default_rng(seed)
    scales = r.uniform(0.1, 1, (n, 3))
    if thickness is not None:
        scales[:, 2] = thickness
    arrays = (r.normal(size=(n, 3)), r.normal(size=(n, 4)), scales, r.random(n))
    return fs.SplatCloud(*arrays, colors=r.random((n, 3)), **more)


def covariances(cloud):
    """(n, 3, 3) of the world."""
    thickness = np.zeros(len(cloud)) if cloud.thickness is None else cloud.thickness
    axes = quaternion_to_matrix(cloud.quats) * np.column_stack([cloud.scales, thickness])[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def test_a_third_scale_is_the_thickness():
    cloud = cloud_of(thickness=[0, 1, 2, 0, 3, 4])
    assert cloud.ellipsoids == "some"
    assert cloud_of().ellipsoids == "all"
    assert (cloud.scales.shape, cloud.thickness.dtype) == ((6, 2), F32)
    assert cloud.thickness.tolist() == [0, 1, 2, 0, 3, 4]
    assert not cloud.thickness.flags.writeable


def test_a_third_scale_of_0_throughout_is_none():
    assert cloud_of(thickness=0).thickness is None
    assert cloud_of(thickness=0).ellipsoids == "none"


def test_a_thickness_below_0_or_not_finite_is_not_a_splat():
    with pytest.warns(UserWarning, match="3 of 6 splats left out"):
        cloud = cloud_of(thickness=[0, -1, 2, np.nan, 3, np.inf])
    assert cloud.thickness.tolist() == [0, 2, 3]
    assert cloud.dropped == {"scales not finite": 2, "scale not above 0": 1}


def test_joined_clouds_keep_their_thickness():
    disks, thick = cloud_of(2, thickness=0), cloud_of(3, 1)
    joined = fs.SplatCloud.concatenate([disks, thick, disks.with_boxes()])
    assert joined.thickness.tolist() == [0, 0, *thick.thickness.tolist(), 0, 0]
    assert joined.boxes.tolist() == [False] * 5 + [True] * 2
    assert fs.SplatCloud.concatenate([disks, disks]).thickness is None


def test_a_moved_and_scaled_cloud_has_moved_and_scaled_ellipsoids():
    cloud = cloud_of()
    matrix = rigid_matrix((1, 2, 3), (1, 2, 3, 4), 2.5)
    moved = cloud.transformed(matrix)
    expected = matrix[:3, :3] @ covariances(cloud) @ matrix[:3, :3].T
    np.testing.assert_allclose(covariances(moved), expected, rtol=1e-5, atol=1e-6)


def test_bounds_hold_the_thickness():
    cloud = cloud_of(1)
    low, high = cloud.bounds()
    reach = 3 * np.sqrt(np.diagonal(covariances(cloud)[0]))
    np.testing.assert_allclose(high, cloud.means[0] + reach, rtol=1e-6)
    np.testing.assert_allclose(low, cloud.means[0] - reach, rtol=1e-6)


@pytest.mark.parametrize("thin", range(3))
def test_flattened_splats_lose_their_thinnest_axis_in_a_right_handed_frame(thin):
    scales = np.random.default_rng(thin).uniform(0.5, 1, (40, 3))
    scales[:, thin] = 0.1
    quats = np.random.default_rng(9).normal(size=(40, 4))
    thick = fs.SplatCloud(np.zeros((40, 3)), quats, scales, np.ones(40), colors=np.ones((40, 3)))
    flat = thick.flattened()
    assert flat.thickness is None
    old, new = quaternion_to_matrix(thick.quats), quaternion_to_matrix(flat.quats)
    np.testing.assert_allclose(np.linalg.det(new), 1, atol=1e-6)
    np.testing.assert_allclose(new[:, :, 2], old[:, :, thin], atol=1e-6)
    lost = old[:, :, thin] * 0.1
    np.testing.assert_allclose(
        covariances(flat), covariances(thick) - lost[:, :, None] * lost[:, None, :], atol=1e-6
    )


def test_of_equal_axes_the_third_is_lost_and_disks_stay_as_they_are():
    cloud = fs.SplatCloud(
        *(np.zeros((2, 3)), [[1, 0, 0, 0]] * 2, [[1, 1, 1], [1, 0.5, 0]], [1, 1]), colors=np.ones((2, 3))
    )
    flat = cloud.flattened()
    assert flat.quats.tolist() == [[1, 0, 0, 0]] * 2
    assert flat.scales.tolist() == [[1, 1], [1, 0.5]]
    assert flat.flattened() is flat


def test_an_ellipsoid_is_not_a_box_and_has_no_coplanar_group():
    cloud = cloud_of(thickness=[0, 1, 1, 1, 1, 1])
    first = np.arange(6) == 0
    assert cloud.with_boxes(first).boxes.tolist() == first.tolist()
    assert cloud.with_coplanar_groups(np.where(first, 0, -1)).has_coplanar_groups
    with pytest.raises(fs.InputError, match="boxes must have a thickness of 0"):
        cloud.with_boxes()
    with pytest.raises(fs.InputError, match="must have a thickness of 0"):
        cloud.with_coplanar_groups(0)


def test_pickling_keeps_it():
    again = pickle.loads(pickle.dumps(cloud_of()))
    assert np.array_equal(again.thickness, cloud_of().thickness)
    assert not again.thickness.flags.writeable
