"""Coplanar groups in splat files other than PLY."""

import math
from pathlib import Path

import numpy as np
import pytest
from test_formats import USD, assert_same_bits, need, some

import fidsplat as fs
from fidsplat.formats import losses
from fidsplat.formats.plain import cloud_of


@pytest.mark.parametrize("suffix", [".glb", ".gltf", *USD])
def test_splats_of_planes_come_back_on_them(tmp_path, suffix):
    """Those that cannot be rendered are left out, and the others keep their planes."""
    need(suffix)
    planes = np.arange(40) % 4 - 1
    cloud = some(thick=False).with_coplanar_groups(planes)
    fs.save_splats(cloud, tmp_path / f"a{suffix}")
    assert_same_bits(fs.load_splats(tmp_path / f"a{suffix}"), cloud)
    assert losses(cloud, f"a{suffix}") == []
    spoilt = some(thick=False)
    spoilt.opacities.flags.writeable = True
    spoilt.opacities[[3, 17]] = 2.0
    fs.save_splats(spoilt.with_coplanar_groups(planes), tmp_path / f"b{suffix}")
    with pytest.warns(UserWarning, match="left out"):
        read = fs.load_splats(tmp_path / f"b{suffix}")
    np.testing.assert_array_equal(read.coplanar_groups, np.delete(planes, [3, 17]))


@pytest.mark.parametrize(
    ("thick", "plane", "words"),
    [
        (False, 0.5, r"_PLANE must have whole numbers below 2\^24, got 0.5"),
        (False, math.nan, r"_PLANE must have whole numbers below 2\^24, got nan"),
        (False, -2.0, "coplanar groups must be ids of at least 0"),
        (True, 1.0, "must have a thickness of 0"),
    ],
)
def test_planes_that_cannot_be(tmp_path, thick, plane, words):
    labelled = some(9, thick=thick, labels=7)  # an attribute like it, to be renamed
    fs.save_splats(labelled, tmp_path / "a.glb")
    data = (tmp_path / "a.glb").read_bytes().replace(b"_LABEL", b"_PLANE")
    seven, other = (np.full(9, value, "<f4").tobytes() for value in (7.0, plane))
    (tmp_path / "a.glb").write_bytes(data.replace(seven, other))
    with pytest.raises(fs.InputError, match=rf"a\.glb: .*{words}"):
        fs.load_splats(tmp_path / "a.glb")


@pytest.mark.filterwarnings("ignore:.*left out")
@pytest.mark.parametrize("opacity", [0.5, math.nan])
@pytest.mark.parametrize("shape", [(3,), (5, 2), ()])
def test_planes_of_other_splats_than_the_files(shape, opacity):
    """As a USD file may have them, whether all splats can be rendered or not."""
    cloud, opacities = some(5, thick=False), np.full(5, 0.5, np.float32)
    opacities[0] = opacity
    arrays = cloud.means, cloud.quats, np.pad(cloud.scales, [(0, 0), (0, 1)]), opacities, cloud.sh
    with pytest.raises(fs.InputError, match=r"a.usda: coplanar groups must have the shape"):
        cloud_of(Path("a.usda"), *arrays, coplanar_groups=np.zeros(shape, np.int32))
