"""Dense indices of coplanar groups."""

import numpy as np

from fidsplat.backends.cloud_arrays import group_index
from fidsplat.selftest.clouds import splats


def test_indices_are_dense_whatever_the_ids():
    ids = np.array([7, 3, -1, 2_000_000_000, 3, 7])
    cloud = splats(np.ones((6, 3)), (1, 0, 0, 0), 0.1).with_coplanar_groups(ids)
    index = group_index(cloud)
    assert index.dtype == np.int32
    assert index.tolist() == [1, 0, -1, 2, 0, 1]


def test_a_cloud_without_groups_has_no_indices():
    assert group_index(splats([(0, 0, 1)], (1, 0, 0, 0), 0.1)).tolist() == [-1]
