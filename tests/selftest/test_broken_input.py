"""Broken values: splats are dropped and counted when a cloud is made, and culled if they reach a kernel."""

import warnings

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.selftest.agreement import ALL_OUTPUTS, CATALOGUED
from fidsplat.selftest.clouds import subset_of
from fidsplat.selftest.inputs import BROKEN, CORRUPTED, VIEW, broken_fields, corrupted, crowd

NAN, INF = float("nan"), float("inf")
ALL_ZERO_ROWS = 889_536
"""of a real file: playcanvas/splat-transform issue 288"""


def same_bits(first, second):
    return all(np.array_equal(first[name], second[name]) for name in ALL_OUTPUTS)


def without_corrupted(cloud):
    return subset_of(cloud, np.delete(np.arange(len(cloud)), CORRUPTED))


def expected_reason(name, value):
    if name == "quats" and value == 0:
        return "zero quaternion"
    if not np.isfinite(np.float32(value)):
        return f"{name} not finite"
    if abs(value) > 1e15:
        return f"{name} beyond 1e+15"
    return {"scales": "scale not above 0", "opacities": "opacity outside [0, 1]"}[name]


@pytest.mark.parametrize("name", BROKEN)
def test_each_broken_value_is_counted_under_its_reason(name):
    cloud = crowd()
    for value in BROKEN[name]:
        field = np.array(getattr(cloud, name)[CORRUPTED])
        field[0 if field.ndim else ()] = value
        assert corrupted(cloud, {name: field}).dropped == {expected_reason(name, value): 1}, value


def test_all_broken_values_at_once(renderer):
    """A cloud with all broken values has the image of its valid splats."""
    cloud = crowd()
    bad = [arrays for _, arrays in broken_fields(cloud)]
    arrays = {name: getattr(cloud, name) for name in BROKEN}
    rows = {
        name: np.repeat(array[CORRUPTED : CORRUPTED + 1], len(bad), axis=0) for name, array in arrays.items()
    }
    for row, changes in enumerate(bad):
        for name, value in changes.items():
            rows[name][row] = value
    order = np.random.default_rng(0).permutation(len(cloud) + len(bad))
    mixed = {name: np.concatenate([arrays[name], rows[name]])[order] for name in arrays}
    with pytest.warns(UserWarning, match=f"{len(bad)} of {len(order)} splats left out"):
        left = fs.SplatCloud(**mixed)
    good = subset_of(cloud, order[order < len(cloud)])
    assert sum(left.dropped.values()) == len(bad)
    frames = [renderer.render(c.with_labels(0), VIEW, ALL_OUTPUTS) for c in (left, good)]
    assert same_bits(*frames)
    assert frames[0].stats == frames[1].stats


@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("value", [NAN, INF, -INF, 1e38])
def test_broken_spherical_harmonics(renderer, degree, value):
    cloud = crowd()
    generator = np.random.default_rng(1)
    sh = generator.normal(0, 0.3, (len(cloud), (degree + 1) ** 2, 3)).astype(np.float32)
    fields = (cloud.means, cloud.quats, cloud.scales, cloud.opacities)
    good = without_corrupted(fs.SplatCloud(*fields, sh=sh))
    sh[CORRUPTED, -1, 2] = value
    with pytest.warns(UserWarning, match="1 of 41"):
        bad = fs.SplatCloud(*fields, sh=sh)
    frames = [renderer.render(c, VIEW) for c in (bad, good)]
    assert np.array_equal(frames[0]["rgb"], frames[1]["rgb"])


UNCHECKED = {
    "means": (NAN, INF, -INF),
    "quats": (NAN, INF, -INF),
    "scales": (NAN, INF, -INF, -1.0),
    "opacities": (NAN, -INF, -1.0, -0.0),
}


@pytest.mark.parametrize("name", UNCHECKED)
def test_kernels_cull_invalid_splats(renderer, name):
    """Case E1: NaN fails every comparison of the kernels; the checks of the cloud are bypassed."""
    cloud = crowd()
    expected = renderer.render(without_corrupted(cloud), VIEW, ALL_OUTPUTS)
    for value in UNCHECKED[name]:
        for k in range(max(getattr(cloud, name)[CORRUPTED].size, 1)):
            array = getattr(cloud, name).copy()
            array[(CORRUPTED, k) if array.ndim > 1 else CORRUPTED] = value
            frame = renderer.render(cloud._replaced(**{name: array}), VIEW, ALL_OUTPUTS)
            assert same_bits(frame, expected), f"{name}[{k}] = {value}"
            assert frame.stats["visible"] == expected.stats["visible"]


def test_kernels_cull_a_zero_quaternion(renderer):
    cloud = crowd()
    quats = cloud.quats.copy()
    quats[CORRUPTED] = 0
    frame = renderer.render(cloud._replaced(quats=quats), VIEW, ALL_OUTPUTS)
    assert same_bits(frame, renderer.render(without_corrupted(cloud), VIEW, ALL_OUTPUTS))


def test_minus_zero_is_zero(renderer):
    cloud = crowd()
    frames = []
    for zero in (0.0, -0.0):
        changes = {"means": (zero, zero, 1.2), "quats": (1.0, zero, zero, zero), "colors": (zero, zero, zero)}
        frames.append(renderer.render(corrupted(cloud, changes), VIEW, ALL_OUTPUTS))
    assert same_bits(*frames)


def test_invisible_splats_change_nothing(renderer):
    """Opacity 0, -0, denormal, and below the cut-off: valid invisible splats."""
    cloud = crowd()
    expected = renderer.render(without_corrupted(cloud), VIEW, ALL_OUTPUTS, CATALOGUED)
    for opacity in (0.0, -0.0, 1e-45, 1e-30, 0.0039):
        visible = corrupted(cloud, {"opacities": opacity})
        frame = renderer.render(visible, VIEW, ALL_OUTPUTS, CATALOGUED)
        assert len(visible) == len(cloud)
        assert same_bits(frame, expected)
        assert frame.stats["visible"] == expected.stats["visible"]


def write_rows(path, rows):
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    head += [f"property float {name}" for name in names.split()]
    path.write_bytes("\n".join([*head, "end_header", ""]).encode() + rows.astype("<f4").tobytes())
    return path


def test_all_zero_rows_of_a_file_are_dropped_and_counted(tmp_path, renderer):
    """A row of zeros has a scale of e^0 = 1 m and opacity 1/2, and would fill the image."""
    cloud = crowd()
    fs.save_ply(cloud, tmp_path / "good.ply")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        good = fs.load_ply(tmp_path / "good.ply")
    content = (tmp_path / "good.ply").read_bytes()
    data = np.frombuffer(content.split(b"end_header\n", 1)[1], "<i4").reshape(len(cloud), -1)
    rows = np.zeros((ALL_ZERO_ROWS + len(cloud), 17), "<f4")
    places = np.sort(np.random.default_rng(2).choice(len(rows), len(cloud), replace=False))
    rows[places] = data[:, :17].view("<f4")
    path = write_rows(tmp_path / "zeros.ply", rows)
    with pytest.warns(UserWarning, match=rf"{ALL_ZERO_ROWS} of {len(rows)} splats left out \(zero quat"):
        read = fs.load_ply(path)
    assert read.dropped == {"zero quaternion": ALL_ZERO_ROWS}
    frames = [renderer.render(c.with_labels(0), VIEW, ALL_OUTPUTS) for c in (read, good)]
    assert same_bits(*frames)
    assert frames[0].stats == frames[1].stats
