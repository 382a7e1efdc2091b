"""Rotations, rigid transforms of clouds, bounds, and spherical harmonics."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fidsplat as fs
from fidsplat.splats.cloud import sh_basis
from fidsplat.splats.harmonics import rotation_of_coefficients
from fidsplat.splats.rotations import (
    matrices_to_quaternions,
    matrix_to_quaternion,
    quaternion_multiply,
    quaternion_to_matrix,
    rigid_matrix,
)

F32 = np.float32
component = st.floats(-1, 1, allow_subnormal=False)
quaternion = st.tuples(component, component, component, component).filter(lambda q: np.linalg.norm(q) > 0.01)
vector = st.tuples(*[st.floats(-5, 5, allow_subnormal=False)] * 3)


def cloud_of(n=20, degree=3, seed=0):
    r = np.random.default_rng(seed)
    return fs.SplatCloud(
        r.normal(size=(n, 3)).astype(F32),
        r.normal(size=(n, 4)).astype(F32),
        r.uniform(0.1, 1, (n, 2)).astype(F32),
        r.random(n, dtype=F32),
        sh=r.normal(size=(n, (degree + 1) ** 2, 3)).astype(F32),
    )


def covariances(cloud):
    axes = quaternion_to_matrix(cloud.quats)[:, :, :2] * cloud.scales[:, None, :].astype(float)
    return axes @ axes.transpose(0, 2, 1)


def colors_from(cloud, eye):
    toward = cloud.world_means() - eye
    basis = sh_basis(cloud.sh_degree, toward / np.linalg.norm(toward, axis=1, keepdims=True))
    return 0.5 + np.einsum("nk,nkc->nc", basis, cloud.sh)


@given(quaternion, quaternion)
def test_quaternions_and_matrices_agree(a, b):
    turn_a, turn_b = quaternion_to_matrix(np.array([a, b]))
    np.testing.assert_allclose(turn_a @ turn_a.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn_a) == pytest.approx(1)
    product = quaternion_to_matrix(quaternion_multiply(np.array(a), np.array(b)))
    np.testing.assert_allclose(product, turn_a @ turn_b, atol=1e-12)
    back = matrix_to_quaternion(turn_a)
    assert back[0] >= 0
    np.testing.assert_allclose(quaternion_to_matrix(back), turn_a, atol=1e-12)


@pytest.mark.parametrize("axis", np.eye(3))
def test_rotations_by_180_degrees_have_quaternions(axis):
    rotation = 2 * np.outer(axis, axis) - np.eye(3)
    np.testing.assert_allclose(quaternion_to_matrix(matrix_to_quaternion(rotation)), rotation, atol=1e-15)


def test_an_origin_is_scaled_rotated_and_moved():
    local = cloud_of()
    cloud = fs.SplatCloud(
        local.means, local.quats, local.scales, local.opacities, sh=local.sh, origin=[9, 0, -4]
    )
    matrix = rigid_matrix((1.0, 2.0, 3.0), (1.0, 0.5, 0.0, 0.2), 3.0)
    after = cloud.transformed(matrix)
    np.testing.assert_allclose(after.origin, matrix[:3, :3] @ [9, 0, -4] + [1, 2, 3], atol=1e-12)
    expected = cloud.world_means() @ matrix[:3, :3].T + [1, 2, 3]
    np.testing.assert_allclose(after.world_means(), expected, atol=1e-5)


@given(quaternion, vector, st.floats(0.01, 100))
@settings(max_examples=40)
def test_transform_moves_centres_and_covariances(turn, move, scale):
    matrix = rigid_matrix(move, turn, scale)
    before = cloud_of()
    after = before.transformed(matrix)
    linear = matrix[:3, :3]
    reach = scale * 5 + np.abs(move).max()
    np.testing.assert_allclose(
        after.world_means(), before.world_means() @ linear.T + move, rtol=0, atol=1e-6 * reach
    )
    expected = linear @ covariances(before) @ linear.T
    np.testing.assert_allclose(covariances(after), expected, rtol=0, atol=2e-6 * scale**2)
    np.testing.assert_allclose(np.linalg.norm(after.quats.astype(float), axis=1), 1, atol=3e-7)


@given(quaternion, vector, st.floats(0.1, 10), vector, st.integers(0, 3))
@settings(max_examples=60)
def test_transform_rotates_the_colours_with_the_splats(turn, move, scale, eye, degree):
    matrix = rigid_matrix(move, turn, scale)
    before = cloud_of(degree=degree)
    moved_eye = matrix[:3, :3] @ np.array(eye) + move
    difference = colors_from(before.transformed(matrix), moved_eye) - colors_from(before, np.array(eye))
    # a splat next to the eye is visible from a direction that float32 centres do not fix
    distance = np.linalg.norm(before.world_means() - eye, axis=1)
    assert np.abs(difference[distance > 0.1]).max(initial=0) < 1e-4


def test_transform_and_back():
    matrix = rigid_matrix([1, -2, 3], [0.3, 0.4, -0.2, 0.8], 2.5)
    before = cloud_of()
    after = before.transformed(matrix).transformed(np.linalg.inv(matrix))
    for name in ("means", "scales", "sh", "opacities"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=3e-6)
    np.testing.assert_allclose(covariances(after), covariances(before), atol=1e-6)


def test_identity_keeps_the_bits():
    before = cloud_of()
    after = before.transformed(np.eye(4))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert np.array_equal(getattr(after, name), getattr(before, name))


def test_the_origin_moves_and_the_means_stay_small():
    base = cloud_of()
    far = fs.SplatCloud(
        base.means, base.quats, base.scales, base.opacities, sh=base.sh, origin=[5e5, 4.5e6, 300]
    )
    moved = far.transformed(rigid_matrix([10, 20, 30]))
    assert np.array_equal(moved.means, base.means)
    assert np.array_equal(moved.origin, [500010, 4500020, 330])


def test_a_cloud_moved_far_away_gets_an_origin():
    base = cloud_of()
    far = base.transformed(rigid_matrix([5e5, 4.5e6, 300]))
    assert far.origin.any()
    np.testing.assert_allclose(far.world_means() - [5e5, 4.5e6, 300], base.means, atol=1e-6)


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.diag([1.0, 1, -1, 1]), "reflection"),
        (np.diag([-1.0, -1, -1, 1]), "reflection"),
        (np.diag([1.0, 1, 2, 1]), "uniform scale"),
        (np.diag([0.0, 0, 0, 1]), "positive scale"),
        (np.eye(3), r"4x4 matrix.*\(3, 3\)"),
        (np.full((4, 4), np.nan), "must be finite"),
        (np.eye(4) + np.eye(4, k=-3), "last row"),
        (np.eye(4) + 0.01 * np.eye(4, k=1), "uniform scale"),
        ("x", "4x4 matrix of numbers"),
    ],
)
def test_other_matrices_are_refused(matrix, words):
    with pytest.raises(fs.InputError, match=words):
        cloud_of().transformed(matrix)


def test_a_scale_that_splats_cannot_have_is_refused():
    for scale in (1e-46, 1e20):
        with pytest.raises(fs.InputError, match="transformed means and scales must be at most"):
            cloud_of().transformed(np.diag([scale, scale, scale, 1]))


@pytest.mark.parametrize(
    ("position", "turn", "scale", "words"),
    [
        ([0, 0], [1, 0, 0, 0], 1, "position"),
        ([0, 0, np.inf], [1, 0, 0, 0], 1, "position"),
        ([0, 0, 0], [0, 0, 0, 0], 1, "quaternion"),
        ([0, 0, 0], [1, 0, 0], 1, "quaternion"),
        ([0, 0, 0], [1, 0, 0, 0], 0, "scale"),
    ],
)
def test_poses_that_are_none(position, turn, scale, words):
    with pytest.raises(fs.InputError, match=words):
        rigid_matrix(position, turn, scale)


def test_bounds_hold_every_3_sigma_ellipse_tightly():
    cloud = cloud_of()
    low, high = cloud.bounds()
    axes = quaternion_to_matrix(cloud.quats)[:, :, :2] * 3 * cloud.scales[:, None, :]
    angle = np.linspace(0, 2 * np.pi, 2001)
    points = cloud.means + np.einsum("nij,jt->tni", axes, np.stack([np.cos(angle), np.sin(angle)]))
    assert (points >= low - 1e-9).all()
    assert (points <= high + 1e-9).all()
    np.testing.assert_allclose(points.min(axis=(0, 1)), low, atol=1e-4)
    np.testing.assert_allclose(points.max(axis=(0, 1)), high, atol=1e-4)


def test_bounds_of_boxes_are_those_of_their_corners():
    """Next to Gaussians too, and of a marker that is made of them: its sheet, quiet zone included."""
    mixed = np.arange(len(cloud_of())) % 2 == 0
    cloud = cloud_of().with_boxes(mixed)
    axes = quaternion_to_matrix(cloud.quats)[:, :, :2] * cloud.scales[:, None, :]
    corners = np.einsum("nij,jt->nti", axes, [[-1, 1, 1, -1], [-1, -1, 1, 1]]) + cloud.means[:, None]
    apart = fs.SplatCloud.concatenate([cloud]).half_extents(3.0)
    np.testing.assert_allclose((corners.max(1) - cloud.means)[mixed], apart[mixed], atol=1e-6)
    np.testing.assert_array_equal(apart[~mixed], cloud_of().half_extents(3.0)[~mixed])
    marker = fs.marker("qr:hello", size=0.21, mixture="exact")
    pose = rigid_matrix((1, 2, 3), (1, 0.3, -0.5, 0.2))
    rows, columns = marker.grid.shape
    half = np.array([columns, rows]) * marker.module / 2
    sheet = np.array([[x, y, 0.0] for x in (-half[0], half[0]) for y in (-half[1], half[1])])
    sheet = sheet @ pose[:3, :3].T + pose[:3, 3]
    low, high = marker.cloud.transformed(pose).bounds()
    np.testing.assert_allclose([low, high], [sheet.min(0), sheet.max(0)], atol=1e-6)


def test_bounds_are_in_the_world():
    one = fs.SplatCloud([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 2]], [1], colors=[[1, 1, 1]], origin=[1e6, 0, 5])
    low, high = one.bounds()
    np.testing.assert_allclose(low, [1e6 - 3, -6, 5])
    np.testing.assert_allclose(high, [1e6 + 3, 6, 5])


def real_harmonic(band, order, dirs):
    """Y_lm from its definition: associated Legendre functions and the phase (-1)^m, no shared constants."""
    m = abs(order)
    x, y, z = dirs.T
    legendre = np.polynomial.Legendre.basis(band).deriv(m)(z) if m else np.polynomial.Legendre.basis(band)(z)
    size = math.sqrt((2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m))
    around = (
        x + 1j * y
    ) ** m  # r^m exp(i m phi), r^m being the sine power of the associated Legendre function
    if m:
        size *= math.sqrt(2) * (-1) ** m
    return size * legendre * (around.imag if order < 0 else around.real)


def test_basis_is_the_real_spherical_harmonics_with_condon_shortley_phase():
    dirs = np.random.default_rng(0).normal(size=(50, 3))
    dirs /= np.linalg.norm(dirs, axis=1, keepdims=True)
    expected = [real_harmonic(band, order, dirs) for band in range(4) for order in range(-band, band + 1)]
    basis = sh_basis(3, dirs)
    assert (basis.shape, basis.dtype) == ((50, 16), np.float64)
    np.testing.assert_allclose(basis, np.stack(expected, axis=1), atol=1e-12)
    for degree in range(3):
        assert np.array_equal(sh_basis(degree, dirs), basis[:, : (degree + 1) ** 2])


def test_first_band_has_the_signs_of_the_splat_files():
    c1 = 0.4886025119029199
    np.testing.assert_allclose(
        sh_basis(1, np.eye(3))[:, 1:], c1 * -np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0]])
    )


def test_unknown_degree():
    with pytest.raises(fs.InputError, match="0 to 3"):
        sh_basis(4, np.eye(3))


@given(quaternion)
@settings(max_examples=30)
def test_rotating_coefficients_keeps_bands_apart_and_lengths(turn):
    rotation = quaternion_to_matrix(np.array(turn))
    matrix = rotation_of_coefficients(3, rotation)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(16), atol=1e-10)
    assert not matrix[1:4, 4:].any()
    dirs = np.random.default_rng(0).normal(size=(20, 3))
    dirs /= np.linalg.norm(dirs, axis=1, keepdims=True)
    np.testing.assert_allclose(sh_basis(3, dirs @ rotation.T) @ matrix, sh_basis(3, dirs), atol=1e-10)


def test_quaternions_of_many_rotations_are_those_of_each():
    quats = np.random.default_rng(0).normal(size=(4, 50, 4))
    rotations = quaternion_to_matrix(quats)
    quaternions = matrices_to_quaternions(rotations)
    np.testing.assert_allclose(quaternion_to_matrix(quaternions), rotations, atol=1e-14)
    for one, rotation in zip(quaternions.reshape(-1, 4), rotations.reshape(-1, 3, 3), strict=True):
        assert np.array_equal(matrices_to_quaternions(rotation), one)
        assert np.abs(np.abs(one @ matrix_to_quaternion(rotation)) - 1) < 1e-14
