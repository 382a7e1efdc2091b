"""SuperSplat's compressed PLY, packed here as PlayCanvas' writers pack it."""

import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import fidsplat as fs
from fidsplat.splats.harmonics import C0
from fidsplat.splats.rotations import quaternion_to_matrix

LIMITS = [f"{end}_{part}{axis}" for part in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
COLOR_LIMITS = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"]


def unorm(value, bits):
    top = (1 << bits) - 1
    return np.clip(np.floor(value * top + 0.5), 0, top).astype(np.uint32)


def pack_ranges(values, start):
    """Words, min and max of a chunk (n, 3): bits 11, 10, 11, or 8, 8, 8 and 8 left for opacity."""
    low, high = values.min(axis=0), values.max(axis=0)
    t = np.where(high - low < 1e-5, 0, (values - low) / np.where(high > low, high - low, 1))
    widths = (11, 10, 11) if start == 0 else (8, 8, 8)
    words = np.zeros(len(values), np.uint32)
    for i, width in enumerate(widths):
        words = words << width | unorm(t[:, i], width)
    return words << start, low, high


def pack_rotation(quats):
    words = []
    for q in quats:
        largest = int(np.argmax(np.abs(q)))
        q = q * np.sign(q[largest])
        word = largest
        for i in range(4):
            if i != largest:
                word = word << 10 | int(unorm(q[i] * np.sqrt(0.5) + 0.5, 10))
        words.append(word)
    return np.array(words, np.uint32)


def pack(
    path,
    means,
    quats,
    scales,
    colors,
    opacities,
    rest=None,
    color_limits=True,
    order=("chunk", "vertex", "sh"),
):
    """means, unit quats, scales (n, 3), colors and opacities as in a cloud; rest (n, 9 | 24 | 45)."""
    n = len(means)
    chunks, vertices = [], []
    for at in range(0, n, 256):
        part = slice(at, at + 256)
        position, low, high = pack_ranges(means[part], 0)
        scale, low_s, high_s = pack_ranges(np.log(scales[part]), 0)
        if color_limits:
            color, low_c, high_c = pack_ranges(colors[part], 8)
        else:
            fixed = np.vstack([colors[part], [[0, 0, 0], [1, 1, 1]]])
            color, low_c, high_c = pack_ranges(fixed, 8)
            color = color[:-2]
        vertices.append(
            np.stack([position, pack_rotation(quats[part]), scale, color | unorm(opacities[part], 8)], 1)
        )
        chunks.append(np.concatenate([low, high, low_s, high_s, *([low_c, high_c] if color_limits else [])]))
    names = LIMITS + (COLOR_LIMITS if color_limits else [])
    packed = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]
    heads = {
        "chunk": [f"element chunk {len(chunks)}", *(f"property float {name}" for name in names)],
        "vertex": [f"element vertex {n}", *(f"property uint {name}" for name in packed)],
    }
    data = {
        "chunk": np.array(chunks, "<f4").tobytes(),
        "vertex": np.concatenate(vertices).astype("<u4").tobytes() if n else b"",
    }
    if rest is not None:
        heads["sh"] = [f"element sh {n}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
        data["sh"] = np.clip(np.trunc((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8).tobytes()
    used = [name for name in order if name in heads]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment test",
        *(line for e in used for line in heads[e]),
    ]
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + b"".join(data[e] for e in used))
    return path


def splats(n, seed=0, thin=1e-5):
    r = np.random.default_rng(seed)
    quats = r.normal(size=(n, 4))
    scales = np.exp(r.uniform(-4, 0, (n, 3)))
    scales[:, 2] = thin
    return {
        "means": r.normal(size=(n, 3)) * 3,
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": scales,
        "colors": r.uniform(-0.2, 1.3, (n, 3)),
        "opacities": r.random(n),
    }


@given(
    seed=st.integers(0, 2**32 - 1), n=st.sampled_from([1, 2, 255, 256, 257, 600]), degree=st.integers(0, 3)
)
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_round_trip_within_the_packing_steps(tmp_path, seed, n, degree):
    true = splats(n, seed)
    rest = np.random.default_rng(seed).uniform(-4, 4, (n, 3 * ((degree + 1) ** 2 - 1))) if degree else None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read = fs.load_ply(pack(tmp_path / "a.ply", **true, rest=rest))
    assert (len(read), read.sh_degree) == (n, degree)
    extent = np.ptp(true["means"], axis=0)
    assert (np.abs(read.means - true["means"]) <= extent / 1023 / 2 + 1e-5).all()
    np.testing.assert_allclose(np.log(read.scales), np.log(true["scales"][:, :2]), atol=4 / 1023 / 2 + 1e-5)
    np.testing.assert_allclose(read.opacities, true["opacities"], atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(0.5 + C0 * read.sh[:, 0], true["colors"], atol=1.5 / 255 / 2 + 1e-5)
    old, new = quaternion_to_matrix(true["quats"]), quaternion_to_matrix(read.quats)
    np.testing.assert_allclose(new, old, atol=0.008)
    if rest is not None:
        by_channel = rest.reshape(n, 3, -1).transpose(0, 2, 1)
        np.testing.assert_allclose(read.sh[:, 1:], by_channel, atol=8 / 256)


@pytest.mark.parametrize("largest", range(4))
@pytest.mark.parametrize("sign", [1, -1])
def test_each_largest_component(tmp_path, largest, sign):
    true = splats(1)
    true["quats"] = np.array([[0.1, -0.2, 0.3, 0.4]])
    true["quats"][0, largest] = sign * np.sqrt(1 - np.sum(np.delete(true["quats"][0], largest) ** 2))
    read = fs.load_ply(pack(tmp_path / "a.ply", **true))
    np.testing.assert_allclose(read.quats * sign, true["quats"], atol=0.002)


def test_ends_of_the_ranges_are_exact(tmp_path):
    true = splats(2)
    true["opacities"] = np.array([0.0, 1.0])
    rest = np.array([[-4.0] * 9, [4.0] * 9])
    read = fs.load_ply(pack(tmp_path / "a.ply", **true, rest=rest))
    assert read.opacities.tolist() == [0, 1]
    np.testing.assert_allclose(read.means, true["means"], rtol=1e-6)
    assert read.sh[:, 1:].min() == -4
    assert read.sh[:, 1:].max() == 4


def test_older_files_have_no_colour_limits(tmp_path):
    true = splats(300)
    true["colors"] = np.clip(true["colors"], 0, 1)
    read = fs.load_ply(pack(tmp_path / "a.ply", **true, color_limits=False))
    np.testing.assert_allclose(0.5 + C0 * read.sh[:, 0], true["colors"], atol=0.5 / 255 + 1e-6)


def test_elements_are_found_by_name(tmp_path):
    true = splats(300)
    rest = np.zeros((300, 9))
    a = fs.load_ply(pack(tmp_path / "a.ply", **true, rest=rest))
    b = fs.load_ply(pack(tmp_path / "b.ply", **true, rest=rest, order=("sh", "vertex", "chunk")))
    assert np.array_equal(a.means, b.means)
    assert np.array_equal(a.sh, b.sh)


def test_a_3d_capture_keeps_its_three_scales(tmp_path):
    true = splats(300, thin=0.2)
    read = fs.load_ply(pack(tmp_path / "a.ply", **true))
    scales = np.column_stack([read.scales, read.thickness])
    np.testing.assert_allclose(scales, true["scales"], rtol=0.01)


def test_no_splats(tmp_path):
    assert len(fs.load_ply(pack(tmp_path / "a.ply", **splats(0)))) == 0


def test_a_damaged_chunk_costs_only_its_splats(tmp_path):
    path = pack(tmp_path / "a.ply", **splats(300))
    content = bytearray(path.read_bytes())
    start = content.index(b"end_header\n") + 11
    content[start : start + 12] = np.full(3, np.nan, "<f4").tobytes()
    path.write_bytes(content)
    with pytest.warns(UserWarning, match="256 of 300 splats left out"):
        assert len(fs.load_ply(path)) == 44


DAMAGES = {
    "truncated": (lambda c: c[:-1], "truncated"),
    "no chunks": (lambda c: c.replace(b"element chunk", b"element bunch"), "must have the element chunk"),
    "too few chunks": (lambda c: c.replace(b"chunk 2\n", b"chunk 1\n"), "must have 2 rows of chunk, got 1"),
    "missing packed property": (
        lambda c: c.replace(b"packed_scale", b"packed_snail"),
        "the element vertex of a compressed PLY must have packed_scale",
    ),
    "missing limit": (
        lambda c: c.replace(b"max_scale_y", b"max_snail_y"),
        "the element chunk of a compressed PLY must have max_scale_y",
    ),
    "missing colour limit": (
        lambda c: c.replace(b"max_g", b"max_q"),
        "the element chunk of a compressed PLY must have max_g",
    ),
    "wrong type": (
        lambda c: c.replace(b"uint packed_color", b"float packed_color"),
        "packed_color of the element vertex must have the type",
    ),
    "wrong type of limit": (
        lambda c: c.replace(b"float min_x", b"int min_x"),
        "min_x of the element chunk must have the type",
    ),
    "too little SH": (
        lambda c: c.replace(b"element sh 300", b"element sh 299"),
        "must have 300 rows of sh, got 299",
    ),
    "SH of no degree": (
        lambda c: c.replace(b"property uchar f_rest_8\n", b""),
        "the element sh must have 9, 24 or 45 properties, got 8",
    ),
    "SH of another type": (
        lambda c: c.replace(b"uchar f_rest_3", b"char f_rest_3"),
        "f_rest_3 of the element sh must have the type",
    ),
    "10^12 splats": (lambda c: c.replace(b"vertex 300", b"vertex 1000000000000"), "truncated"),
}


@pytest.mark.filterwarnings("ignore:.*bytes after the PLY data")
@pytest.mark.parametrize("kind", DAMAGES)
def test_damaged_file(tmp_path, kind):
    damage, words = DAMAGES[kind]
    path = pack(tmp_path / "a.ply", **splats(300), rest=np.zeros((300, 9)))
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(fs.InputError, match=rf"a\.ply.*{words}"):
        fs.load_ply(path)
