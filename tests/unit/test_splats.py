"""SplatCloud: validation, dropped splats, origins, concatenation."""

import warnings

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.splats.harmonics import C0

F32 = np.float32


def parts(n=6, seed=0, **changes):
    """Keyword arguments of a good cloud of n splats."""
    r = np.random.default_rng(seed)
    good = {
        "means": r.normal(size=(n, 3)).astype(F32),
        "quats": r.normal(size=(n, 4)).astype(F32),
        "scales": r.uniform(0.1, 1, (n, 2)).astype(F32),
        "opacities": r.random(n, dtype=F32),
        "colors": r.random((n, 3), dtype=F32),
    }
    return good | changes


def sh_parts(n=6, degree=3, seed=0, **changes):
    sh = np.random.default_rng(seed + 99).normal(size=(n, (degree + 1) ** 2, 3)).astype(F32)
    return parts(n, seed, colors=None, sh=sh, **changes)


def test_keeps_float32_bits_and_normalises_quaternions():
    arrays = parts()
    cloud = fs.SplatCloud(**arrays)
    for name in ("means", "scales", "opacities", "colors"):
        array = getattr(cloud, name)
        assert array.dtype == F32
        assert np.array_equal(array, arrays[name])
    norms = np.linalg.norm(arrays["quats"].astype(float), axis=1, keepdims=True)
    np.testing.assert_allclose(cloud.quats, arrays["quats"] / norms, atol=1e-7)
    assert (len(cloud), cloud.sh, cloud.sh_degree, cloud.dropped) == (6, None, -1, {})
    assert cloud.labels.dtype == np.int32
    assert not cloud.labels.any()
    assert cloud.origin.dtype == np.float64
    assert not cloud.origin.any()


def test_normalising_twice_is_normalising_once():
    cloud = fs.SplatCloud(**parts(500))
    again = fs.SplatCloud(cloud.means, cloud.quats, cloud.scales, cloud.opacities, colors=cloud.colors)
    assert np.array_equal(cloud.quats, again.quats)


@pytest.mark.parametrize("degree", range(4))
def test_sh_degree(degree):
    cloud = fs.SplatCloud(**sh_parts(degree=degree))
    assert (cloud.sh_degree, cloud.colors, cloud.sh.shape) == (degree, None, (6, (degree + 1) ** 2, 3))


def test_arrays_are_read_only_and_independent_of_the_input():
    arrays = parts()
    cloud = fs.SplatCloud(**arrays, labels=3)
    arrays["means"][:] = 0
    assert cloud.means.any()
    for name in ("means", "quats", "scales", "opacities", "colors", "labels", "origin"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(cloud, name)[...] = 0
    with pytest.raises(AttributeError):
        cloud.means = arrays["means"]


def test_read_only_float32_is_shared_but_a_view_of_writable_memory_is_copied():
    arrays = parts()
    view = arrays["scales"][:]
    for array in (arrays["means"], view):
        array.flags.writeable = False
    cloud = fs.SplatCloud(**{**arrays, "scales": view})
    assert np.shares_memory(cloud.means, arrays["means"])
    assert not np.shares_memory(cloud.scales, arrays["scales"])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"means": np.zeros((6, 2))}, r"means.*\(6, 2\)"),
        ({"means": 1.0}, r"means.*\(\)"),
        ({"quats": np.ones((6, 3))}, r"quats.*\(6, 4\).*\(6, 3\)"),
        ({"scales": np.ones((6, 4))}, r"scales.*\(6, 2\) or \(6, 3\).*\(6, 4\)"),
        ({"scales": np.ones((5, 2))}, r"scales.*\(5, 2\)"),
        ({"opacities": np.ones((6, 1))}, r"opacities.*\(6,\).*\(6, 1\)"),
        ({"colors": np.ones((6, 4))}, r"colors.*\(6, 4\)"),
        ({"colors": None}, "exactly one of colors"),
        ({"sh": np.ones((6, 4, 3))}, "exactly one of colors"),
        ({"colors": None, "sh": np.ones((6, 5, 3))}, r"sh.*1, 4, 9 or 16.*\(6, 5, 3\)"),
        ({"colors": None, "sh": np.ones((6, 3))}, r"sh.*\(6, 3\)"),
        ({"colors": None, "sh": np.ones((5, 4, 3))}, r"sh.*\(5, 4, 3\)"),
        ({"labels": np.zeros(5, int)}, r"labels.*\(5,\)"),
        ({"labels": np.zeros(6)}, "labels must be ints"),
        ({"labels": 2**31}, "labels must be from"),
        ({"means": [["a"] * 3] * 6}, "means must be an array of real numbers"),
        ({"means": [[1, 2, 3], [4]]}, "means must be an array"),
        ({"opacities": np.ones(6, complex)}, "opacities must be an array of real"),
        ({"origin": [0, 0]}, "origin must be three"),
        ({"origin": [0, 0, np.nan]}, "origin must be three"),
    ],
)
def test_wrong_arrays_are_named(changes, words):
    with pytest.raises(fs.InputError, match=words):
        fs.SplatCloud(**parts(**changes))


DEFECTS = [
    ("means", 1, np.nan, "means not finite"),
    ("means", 0, np.inf, "means not finite"),
    ("quats", 2, -np.inf, "quats not finite"),
    ("quats", slice(None), 0.0, "zero quaternion"),
    ("quats", slice(None), 4e-16, "zero quaternion"),
    ("scales", 0, np.nan, "scales not finite"),
    ("scales", 1, np.inf, "scales not finite"),
    ("scales", 1, 0.0, "scale not above 0"),
    ("scales", 0, -1.0, "scale not above 0"),
    ("opacities", (), np.nan, "opacities not finite"),
    ("opacities", (), -1e-6, "opacity outside [0, 1]"),
    ("opacities", (), 1.0001, "opacity outside [0, 1]"),
    ("colors", 2, np.nan, "colors not finite"),
]


@pytest.mark.parametrize(("name", "column", "value", "reason"), DEFECTS)
def test_a_bad_splat_is_left_out_counted_and_reported(name, column, value, reason):
    arrays = parts(labels=np.arange(6, dtype=np.int32))
    arrays[name][(2, *column) if isinstance(column, tuple) else (2, column)] = value
    with pytest.warns(UserWarning, match="1 of 6 splats left out") as caught:
        cloud = fs.SplatCloud(**arrays)
    assert reason in str(caught[0].message)
    assert cloud.dropped == {reason: 1}
    assert cloud.labels.tolist() == [0, 1, 3, 4, 5]
    assert np.array_equal(cloud.means, arrays["means"][[0, 1, 3, 4, 5]])


@pytest.mark.parametrize(
    ("name", "value", "hint"),
    [
        ("scales", -3.0, "scales are standard deviations in metres: take exp() of logarithms"),
        ("opacities", 2.0, "opacities are from 0 to 1: take the sigmoid of logits"),
    ],
)
def test_what_files_hold_instead_is_hinted_at(name, value, hint):
    arrays = parts()
    arrays[name][:2] = value
    with pytest.warns(UserWarning, match="2 of 6 splats left out") as caught:
        fs.SplatCloud(**arrays)
    assert str(caught[0].message).endswith(f"; {hint}")
    arrays[name][0] = arrays[name][2]  # one of six is a stray
    with pytest.warns(UserWarning, match=r"1 of 6 splats left out \([^()]*: 1\)$"):
        fs.SplatCloud(**arrays)


def test_bytes_are_no_colours():
    arrays = parts()
    arrays["colors"] = np.full((6, 3), 255, np.uint8)
    with pytest.raises(fs.InputError, match=r"got bytes up to 255; pass colors / 255"):
        fs.SplatCloud(**arrays)
    arrays["colors"] = np.ones((6, 3), np.uint8)
    assert fs.SplatCloud(**arrays).colors.max() == 1


def test_float64_that_float32_cannot_hold_is_left_out():
    arrays = parts()
    arrays["scales"] = arrays["scales"].astype(float)
    arrays["scales"][0, 0], arrays["scales"][1, 0] = 1e300, 1e-300
    with pytest.warns(UserWarning, match="2 of 6"):
        assert fs.SplatCloud(**arrays).dropped == {"scales not finite": 1, "scale not above 0": 1}


def test_a_splat_with_two_defects_counts_once():
    arrays = parts()
    arrays["means"][0] = np.nan
    arrays["opacities"][0] = 7
    arrays["opacities"][1] = 7
    with pytest.warns(UserWarning, match="2 of 6"):
        assert fs.SplatCloud(**arrays).dropped == {"means not finite": 1, "opacity outside [0, 1]": 1}


@pytest.mark.parametrize("value", [1.1e15, -1e38])
@pytest.mark.parametrize("name", ["means", "colors"])
def test_values_that_would_overflow_on_devices_are_left_out(name, value):
    arrays = parts()
    arrays[name][2, 1] = value
    with pytest.warns(UserWarning, match="1 of 6"):
        assert fs.SplatCloud(**arrays).dropped == {f"{name} beyond 1e+15": 1}


def test_large_values_are_not_defects():
    arrays = parts(means=np.full((6, 3), 1e15, F32), quats=np.full((6, 4), 3e38, F32))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(fs.SplatCloud(**arrays)) == 6


def test_extreme_opacities_and_tiny_quaternions_stay():
    arrays = parts(opacities=[0, 1, 0, 1, 0, 1], quats=np.full((6, 4), 1e-14))
    cloud = fs.SplatCloud(**arrays)
    assert cloud.opacities.tolist() == [0, 1, 0, 1, 0, 1]
    np.testing.assert_allclose(cloud.quats, 0.5)


def test_far_float64_means_keep_their_detail():
    local = np.random.default_rng(1).normal(size=(6, 3))
    shift = np.array([5e5, 4.5e6, 300.0])
    cloud = fs.SplatCloud(**parts(means=local + shift))
    assert np.abs(cloud.means).max() < 10
    np.testing.assert_allclose(cloud.world_means(), local + shift, rtol=0, atol=1e-6)
    assert np.array_equal(cloud.origin, fs.SplatCloud(**parts(means=local + shift)).origin)


def test_near_or_float32_means_have_no_origin():
    local = np.random.default_rng(1).normal(size=(6, 3)) + 5
    assert not fs.SplatCloud(**parts(means=local)).origin.any()
    far = (local + 1e6).astype(F32)
    cloud = fs.SplatCloud(**parts(means=far))
    assert not cloud.origin.any()
    assert np.array_equal(cloud.means, far)
    assert not fs.SplatCloud(**parts(means=far.astype(float))).origin.any()


def test_a_splat_that_is_left_out_has_no_say_in_the_origin():
    means = np.random.default_rng(1).normal(size=(6, 3)) + 1e6
    arrays = parts(means=means)
    origin = fs.SplatCloud(**parts(5, means=means[:5])).origin
    arrays["means"][5] = 0
    arrays["opacities"][5] = 2
    with pytest.warns(UserWarning, match="1 of 6"):
        assert np.allclose(fs.SplatCloud(**arrays).origin, origin, atol=10)


def test_given_origin_is_used_and_means_are_relative_to_it():
    arrays = parts()
    cloud = fs.SplatCloud(**arrays, origin=[5e5, 4.5e6, 300])
    assert np.array_equal(cloud.means, arrays["means"])
    assert np.array_equal(cloud.origin, [5e5, 4.5e6, 300])
    assert np.array_equal(cloud.world_means(), arrays["means"] + np.array([5e5, 4.5e6, 300]))


def test_empty():
    for cloud in (fs.SplatCloud.empty(), fs.SplatCloud(**parts(0)), fs.SplatCloud(**sh_parts(0))):
        assert len(cloud) == 0
        assert len(cloud.transformed(np.eye(4))) == 0
        with pytest.raises(fs.InputError, match="at least one splat"):
            cloud.bounds()


def test_labels():
    cloud = fs.SplatCloud(**parts())
    assert cloud.with_labels(7).labels.tolist() == [7] * 6
    assert cloud.with_labels(range(6)).labels.tolist() == list(range(6))
    assert not cloud.labels.any()
    with pytest.raises(fs.InputError, match=r"labels.*\(2,\)"):
        cloud.with_labels([1, 2])


def test_concatenate_colours_keeps_bits_and_order():
    a, b = fs.SplatCloud(**parts(3, 1), labels=1), fs.SplatCloud(**parts(4, 2), labels=2)
    both = fs.SplatCloud.concatenate([a, fs.SplatCloud.empty(), b])
    for name in ("means", "quats", "scales", "opacities", "colors", "labels"):
        assert np.array_equal(getattr(both, name), np.concatenate([getattr(a, name), getattr(b, name)]))
        assert not getattr(both, name).flags.writeable


def test_concatenate_mixed_colours_becomes_sh_of_the_highest_degree():
    plain = fs.SplatCloud(**parts(3, 1))
    low, high = fs.SplatCloud(**sh_parts(2, 1)), fs.SplatCloud(**sh_parts(2, 2))
    joined = fs.SplatCloud.concatenate([plain, low, high])
    assert (joined.colors, joined.sh_degree) == (None, 2)
    np.testing.assert_allclose(0.5 + C0 * joined.sh[:3, 0], plain.colors, atol=1e-7)
    assert not joined.sh[:3, 1:].any()
    assert np.array_equal(joined.sh[3:5, :4], low.sh)
    assert not joined.sh[3:5, 4:].any()
    assert np.array_equal(joined.sh[5:], high.sh)


def test_an_empty_cloud_does_not_change_the_kind_of_colour():
    plain = fs.SplatCloud(**parts(3))
    empty_sh = fs.SplatCloud(**sh_parts(0))
    assert fs.SplatCloud.concatenate([empty_sh, plain]).colors is not None
    assert len(fs.SplatCloud.concatenate([])) == 0
    assert len(fs.SplatCloud.concatenate([empty_sh, empty_sh])) == 0


def test_concatenate_different_origins():
    local = np.random.default_rng(1).normal(size=(6, 3))
    far = fs.SplatCloud(**parts(means=local + 1e6))
    given = fs.SplatCloud(**parts(), origin=[1e6, 1e6, 1e6 + 3])
    joined = fs.SplatCloud.concatenate([far, given])
    assert joined.origin.any()
    world = np.concatenate([far.world_means(), given.world_means()])
    np.testing.assert_allclose(joined.world_means(), world, rtol=0, atol=1e-6)
    same = fs.SplatCloud.concatenate([given, given])
    assert np.array_equal(same.means[6:], given.means)
    assert np.array_equal(same.origin, given.origin)


def test_planes_of_different_clouds_stay_different():
    one = fs.SplatCloud(**parts())
    printed = one.with_coplanar_groups([0, 0, 2, 2, -1, -1])
    joined = fs.SplatCloud.concatenate([printed, one, printed])
    assert joined.coplanar_groups.tolist() == [0, 0, 2, 2, -1, -1, *[-1] * 6, 3, 3, 5, 5, -1, -1]


@pytest.mark.parametrize(("away", "own"), [(50.0, False), (100.0, True)])
def test_a_cloud_far_from_0_for_its_size_has_an_origin(away, own):
    """From 64 times its reach on; only then float32 would lose bits that count."""
    means = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, 1 / 3]]) + away
    scales = np.full((6, 2), 1e-3)
    assert fs.SplatCloud(**parts(means=means, scales=scales)).origin.any() == own


def test_concatenate_near_clouds_keeps_their_bits():
    near = fs.SplatCloud(**parts())
    aside = fs.SplatCloud(**parts(), origin=[3.0, 0, 0])
    joined = fs.SplatCloud.concatenate([near, aside])
    assert not joined.origin.any()
    assert np.array_equal(joined.means[:6], near.means)


def test_dropped_adds_up_and_survives():
    arrays = parts()
    arrays["opacities"][0] = 2
    with pytest.warns(UserWarning, match="1 of 6"):
        cloud = fs.SplatCloud(**arrays)
    assert cloud.with_labels(1).transformed(np.eye(4)).dropped == {"opacity outside [0, 1]": 1}
    assert fs.SplatCloud.concatenate([cloud, cloud]).dropped == {"opacity outside [0, 1]": 2}


def test_repr():
    assert repr(fs.SplatCloud(**sh_parts())) == "SplatCloud(6 splats, SH degree 3, origin (0.0, 0.0, 0.0))"
