"""Merging splats for levels of detail, and Morton codes."""

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.splats.harmonics import C0
from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.store.merge import MAX_OPACITY, merged
from fidsplat.store.morton import Grid, grid_around


def test_merging_preserves_opacity_times_area_and_position():
    generator = np.random.default_rng(3)
    means = generator.normal(0, 0.2, (400, 3)).astype(np.float32) * [1, 1, 0]
    turns = np.tile(np.float32([1, 0, 0, 0]), (400, 1))
    scales = np.full((400, 2), 0.01, np.float32)
    splats = {"means": means.astype(np.float32), "quats": turns, "scales": scales}
    splats |= {"opacities": np.full(400, 0.1, np.float32)}
    splats["colors"] = 0.5 + 0.1 * generator.random((400, 3), np.float32)
    merged_splats, size = merged(splats, Grid((-4.0, -4.0, -4.0), 8.0))
    assert 1 < len(merged_splats["means"]) <= 100
    assert size > 0
    light = (merged_splats["opacities"] * merged_splats["scales"].prod(axis=1)).astype(np.float64)
    assert light.sum() == pytest.approx(400 * 0.1 * 1e-4, rel=1e-5)
    assert np.average(merged_splats["means"], axis=0, weights=light) == pytest.approx(
        means.mean(axis=0), abs=1e-6
    )
    assert np.average(merged_splats["colors"], axis=0, weights=light) == pytest.approx(
        splats["colors"].mean(axis=0)
    )
    # as flat and as wide: equal mean square distance from the centre
    square = (merged_splats["scales"] ** 2).sum(axis=1) + (merged_splats["means"][:, :2] ** 2).sum(axis=1)
    given = 2 * 0.01**2 + (means[:, :2] ** 2).sum(axis=1)
    assert np.average(square, weights=light) == pytest.approx(given.mean(), rel=1e-5)
    spread = merged_splats["scales"].max(axis=1) ** 2
    assert (np.abs(fs.SplatCloud(**merged_splats).half_extents(1.0)[:, 2]) < 1e-6).all()
    assert spread.max() < size**2


@pytest.mark.parametrize("thick", [False, True], ids=["disks", "ellipsoids"])
def test_merging_preserves_moments(thick):
    """Opacity times area, mean and second moments, for disks without the thinnest axis."""
    generator = np.random.default_rng(8)
    count, turns = 300, generator.normal(size=(300, 4))
    splats = {"means": generator.uniform((2, -1, 5), (2.3, -0.8, 5.6), (count, 3))}
    splats["quats"] = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    splats |= {"scales": generator.uniform(0.01, 0.06, (count, 2)), "colors": generator.random((count, 3))}
    splats["opacities"] = generator.uniform(0.01, 0.05, count)
    if thick:  # often the longest axis
        splats["thickness"] = generator.uniform(0.01, 0.12, count)
    splats = {name: array.astype(np.float32) for name, array in splats.items()}

    def moments(given):
        frames = quaternion_to_matrix(given["quats"])
        third = given["thickness"] if thick else np.zeros(len(frames))
        axes = np.column_stack([given["scales"], third]).astype(np.float64)
        weights = given["opacities"] * axes[:, :2].max(1) * np.maximum(axes[:, :2].min(1), axes[:, 2])
        means = given["means"].astype(np.float64)
        second = np.einsum("nij,nj,nkj->nik", frames, axes**2, frames) + means[:, :, None] * means[:, None]
        return weights.sum(), *(np.tensordot(weights, each, 1) / weights.sum() for each in (means, second))

    merged_splats, _ = merged(splats, Grid((0.0, -4.0, 0.0), 8.0))
    assert 1 < len(merged_splats["means"]) <= count / 4
    (mass, mean, second), (mass_made, mean_made, second_made) = moments(splats), moments(merged_splats)
    assert mass_made == pytest.approx(mass, rel=1e-5)
    assert mean_made == pytest.approx(mean, abs=1e-5)
    lost = np.linalg.eigvalsh(second - second_made)
    if thick:
        assert np.abs(lost).max() < 1e-5
    else:  # nothing is added, and less is lost than what stays
        assert lost.min() > -1e-5
        assert lost.max() < 0.5 * np.linalg.eigvalsh(second - np.outer(mean, mean)).max()


def test_overlapping_splats_are_merged_into_copies():
    count = 64
    generator = np.random.default_rng(4)
    means = np.column_stack([generator.uniform(0, 0.01, (count, 2)), np.zeros(count)]).astype(np.float32)
    splats = {"means": means, "quats": np.tile(np.float32([1, 0, 0, 0]), (count, 1))}
    splats |= {"scales": np.full((count, 2), 0.02, np.float32), "opacities": np.full(count, 0.9, np.float32)}
    splats["colors"] = np.ones((count, 3), np.float32)
    merged_splats, _ = merged(splats, Grid((-1.0, -1.0, -1.0), 2.0))
    light = merged_splats["opacities"] * merged_splats["scales"].prod(axis=1)
    assert light.sum() == pytest.approx(count * 0.9 * 4e-4, rel=1e-5)
    assert 0.9 * count / MAX_OPACITY - 1 < len(light) < 0.9 * count
    assert 1 < merged_splats["opacities"].max() <= MAX_OPACITY
    assert merged_splats["scales"].max() < 0.02 * 1.4


def test_bright_and_dark_splats_are_merged_separately():
    means = np.zeros((40, 3), np.float32)
    means[:, 0] = np.linspace(0.01, 0.02, 40)
    splats = {"means": means, "quats": np.tile(np.float32([1, 0, 0, 0]), (40, 1))}
    splats |= {"scales": np.full((40, 2), 1e-3, np.float32), "opacities": np.full(40, 0.1, np.float32)}
    light = np.where(means[:, :1] < 0.014, np.float32(0.2), np.float32(0.7))
    plain, _ = merged(splats | {"colors": np.full((40, 3), 0.2, np.float32)}, Grid((-1.0, -1.0, -1.0), 2.0))
    harmonics = ((light - np.float32(0.5)) / np.float32(C0))[:, None] * np.ones((1, 1, 3), np.float32)
    for colors in ({"colors": light * np.ones((1, 3), np.float32)}, {"sh": harmonics}):
        merged_splats, _ = merged(splats | colors, Grid((-1.0, -1.0, -1.0), 2.0))
        assert len(merged_splats["means"]) > len(plain["means"])
        name, values = next(iter(colors.items()))
        known = {float(value) for value in values.ravel()}
        assert {min(known, key=lambda k, v=v: abs(k - v)) for v in merged_splats[name].ravel()} == known
        assert np.abs(merged_splats[name].ravel()[:, None] - sorted(known)).min(axis=1).max() < 1e-6


def test_codes_follow_the_bits_of_the_cells():
    grid = Grid((0.0, 0.0, 0.0), 1.0)
    cells = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0], [1 << 20, 1 << 20, 1 << 20]])
    codes = grid.codes((cells + 0.5) / (1 << 21))
    assert codes.tolist() == [1, 2, 4, 8, 7 << 60]
    assert (
        grid.codes(np.array([[-5.0, 2.0, np.nextafter(1, 0)]])).tolist()
        == grid.codes(np.array([[0.0, 0.9999999, 0.9999999]])).tolist()
    )
    assert grid_around(np.zeros((0, 3), np.float32)).side > 0
