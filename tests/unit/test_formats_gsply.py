"""SPZ and SOG as another's reader and writer have them: gsply, MIT. It brings numba, 180 MB, so that it is no
part of the extra `test`: pip install 'gsply[spz,sogs]'."""

import numpy as np
import pytest
from test_formats import some
from test_formats_sog import sog

import fidsplat as fs

gsply = pytest.importorskip("gsply", reason="pip install 'gsply[spz,sogs]'")
TURN = np.diag([1.0, -1.0, -1.0, 1.0])
"""from SPZ's axes, y up, to ours"""


def assert_same(theirs, ours):
    """theirs: their container, with scales as logarithms and opacities as logits."""
    thickness = np.zeros(len(ours)) if ours.thickness is None else ours.thickness
    scales = np.column_stack([ours.scales, thickness])
    np.testing.assert_allclose(theirs.means, ours.world_means(), rtol=1e-6, atol=1e-6)
    # the smallest scale of SPZ, a disk's third one
    np.testing.assert_allclose(np.exp(theirs.scales), scales, rtol=1e-5, atol=4.6e-5)
    opacities = 1 / (1 + np.exp(-theirs.opacities.ravel().astype(float)))
    np.testing.assert_allclose(opacities, ours.opacities, atol=2e-6)
    np.testing.assert_allclose(np.abs((theirs.quats * ours.quats).sum(1)), 1, atol=1e-5)
    np.testing.assert_allclose(theirs.sh0, ours.sh[:, 0], atol=1e-6)
    if ours.sh_degree:
        bands = ours.sh.shape[1] - 1
        np.testing.assert_allclose(theirs.shN[:, :bands], ours.sh[:, 1:], atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_an_spz_file_of_ours_by_another_reader(tmp_path, degree):
    fs.save_splats(some(degree=degree), tmp_path / "a.spz")
    ours = fs.load_splats(tmp_path / "a.spz")
    assert_same(gsply.read_spz(tmp_path / "a.spz"), ours.transformed(TURN))


@pytest.mark.parametrize("degree", [0, 3])
def test_an_spz_file_of_another_writer(tmp_path, degree):
    fs.save_splats(some(degree=degree), tmp_path / "a.spz")
    gsply.write_spz(tmp_path / "b.spz", gsply.read_spz(tmp_path / "a.spz"), version=3)
    theirs = gsply.read_spz(tmp_path / "b.spz")
    assert_same(theirs, fs.load_splats(tmp_path / "b.spz").transformed(TURN))


def test_a_sog_file_by_another_reader(tmp_path):
    pytest.importorskip("imagecodecs", reason="pip install 'gsply[sogs]'")
    from gsply.sog_reader import sogread

    sog(tmp_path / "a.sog")
    assert_same(sogread(tmp_path / "a.sog"), fs.load_splats(tmp_path / "a.sog"))
