"""Mutated splat files: each load ends quickly in a cloud of valid splats or in an InputError, within
twice the memory of the file's contents (devlog/hard-cases.md, E1 and E3).
"""

import re
import signal
import time
import tracemalloc
import warnings
from collections import Counter

import numpy as np
import pytest

import fidsplat as fs

SIZES = [270] * 400 + [20000] * 8
"""splats in the files of each kind before mutation; large ones test memory"""
SECONDS = 2.0
"""time limit per file; a small one takes about a millisecond"""
CONSTANT = 300_000
"""bytes: the header's buffer (64 KiB, as bytes and as text), blocks of rows, and Python's own"""

SPECIAL = np.array([0x7FC00000, 0xFFC00000, 0x7F800000, 0xFF800000, 0, 0x80000000, 1, 0x7E967699, 0xFE967699])
"""float32 bits: NaN, -NaN, inf, -inf, 0, -0, a denormal, 1e38, -1e38"""
NUMBERS = [b"0", b"1", b"-1", b"271", b"269", b"2147483648", b"4294967296", b"9" * 18, b"1e3", b""]
TYPES = [b"char", b"uchar", b"short", b"ushort", b"int", b"uint", b"float", b"double", b"half", b"list"]
LINES = [
    b"comment x",
    b"element vertex 3",
    b"element chunk 2",
    b"element none 999999999999999999",
    b"",
    b"\xff\xfe",
]
LINES += [b"property int plane", b"property float label", b"comment fidsplat origin 1 nan 2", b"end_header"]


def compressed(n, generator, rest=0):
    """A compressed file of random words: every bit pattern is a valid splat."""
    limits = [f"{end}_{part}{axis}" for part in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    limits += [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
    chunks = -(-n // 256)
    packed = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in limits] + [f"element vertex {n}"]
    lines += [f"property uint {name}" for name in packed]
    data = np.sort(generator.normal(size=(chunks, 18)).astype("<f4")).tobytes() + generator.bytes(16 * n)
    if rest:
        lines += [f"element sh {n}", *(f"property uchar f_rest_{i}" for i in range(rest))]
        data += generator.bytes(rest * n)
    return "\n".join([*lines, "end_header", ""]).encode() + data


def plain(n, generator, folder, degree, native, marked=False):
    cloud = fs.SplatCloud(
        generator.normal(size=(n, 3)),
        generator.normal(size=(n, 4)),
        generator.uniform(0.1, 1, (n, 2)),
        generator.random(n),
        sh=generator.normal(size=(n, (degree + 1) ** 2, 3)),
        labels=generator.integers(-9, 9, n) if marked else None,
        origin=(4.5e6, 0.0, 300.0) if marked else None,
    )
    if marked:
        cloud = cloud.with_coplanar_groups(generator.integers(-1, 3, n))
    fs.save_ply(cloud, folder / "good.ply", native_2dgs=native)
    return (folder / "good.ply").read_bytes()


def thick(n, generator, folder):
    """A 3DGS file as from training: three different scales, unnormalised quaternions."""
    head, data = plain(n, generator, folder, 0, native=False).split(b"end_header\n", 1)
    rows = np.frombuffer(data, "<f4").reshape(n, -1).copy()
    rows[:, -7:] = generator.normal(size=(n, 7))
    return head + b"end_header\n" + rows.tobytes()


KINDS = {
    "2DGS": lambda n, g, folder: plain(n, g, folder, 1, native=True),
    "2DGS without SH, for 3DGS tools": lambda n, g, folder: plain(n, g, folder, 0, native=False),
    "2DGS with labels, planes and an origin": lambda n, g, folder: plain(n, g, folder, 0, True, marked=True),
    "3DGS of SH degree 3": lambda n, g, folder: plain(n, g, folder, 3, native=False),
    "3DGS, thick": thick,
    "compressed": lambda n, g, folder: compressed(n, g),
    "compressed with SH": lambda n, g, folder: compressed(n, g, rest=24),
}
UNPACKED = 4
"""a compressed file's splats take at most this many times its size (16 bytes become 56, 40 become 152)"""


def data_start(content):
    found = content.find(b"end_header\n")
    return len(content) // 2 if found < 0 else found + 11


def flip_bytes(content, generator):
    changed = bytearray(content)
    low, high = (0, data_start(content)) if generator.random() < 0.5 else (data_start(content), len(content))
    for place in generator.integers(low, max(high, low + 1), generator.integers(1, 9)):
        if place < len(changed):
            changed[place] ^= int(generator.integers(1, 256))
    return bytes(changed)


def cut(content, generator):
    return content[: generator.integers(0, len(content))]


def extend(content, generator):
    place = int(generator.choice([0, data_start(content), len(content)]))
    return content[:place] + generator.bytes(int(generator.integers(1, 5000))) + content[place:]


def splice(content, generator):
    """Remove or duplicate a piece of the file."""
    a, b = np.sort(generator.integers(0, len(content), 2))
    return content[:a] + content[b:] if generator.random() < 0.5 else content[:b] + content[a:]


def special_values(content, generator):
    """Replace words of the data, or stretches of them, by NaN, infinities, zeros, denormals, huge numbers."""
    start = data_start(content)
    words = np.frombuffer(content[start : start + (len(content) - start) // 4 * 4], "<u4").copy()
    if not len(words):
        return content
    if generator.random() < 0.3:
        first = generator.integers(0, len(words))
        words[first : first + generator.integers(1, len(words) + 1)] = generator.choice(SPECIAL)
    else:
        places = generator.integers(0, len(words), generator.integers(1, 2 + len(words) // 10))
        words[places] = generator.choice(SPECIAL, len(places))
    return content[:start] + words.tobytes() + content[start + 4 * len(words) :]


def edit_header(content, generator):
    """Delete, duplicate, swap and insert lines; replace numbers, types and names."""
    start = data_start(content)
    lines = content[:start].split(b"\n")
    for _ in range(generator.integers(1, 4)):
        at, other = generator.integers(0, len(lines), 2)
        match generator.integers(0, 7):
            case 0:
                del lines[at]
            case 1:
                lines.insert(at, lines[other])
            case 2:
                lines[at], lines[other] = lines[other], lines[at]
            case 3:
                lines.insert(at, LINES[generator.integers(len(LINES))])
            case 4:
                lines[at] = re.sub(rb"\d+$", NUMBERS[generator.integers(len(NUMBERS))], lines[at])
            case 5:
                lines[at] = re.sub(rb"(float|uint|uchar)", TYPES[generator.integers(len(TYPES))], lines[at])
            case _:
                lines[at] = lines[at].replace(b"_", b"-").replace(b"x", b"y")
        lines = lines or [b""]
    return b"\n".join(lines) + content[start:]


def swap_counts(content, generator):
    """Exchange or replace the counts of elements."""
    start = data_start(content)
    counts = re.findall(rb"element \w+ (\d+)", content[:start])
    shuffled = iter(generator.permutation(np.array([*counts, b"0", b"2"])))
    head = re.sub(rb"(?<=element )(\w+) \d+", lambda match: match[1] + b" " + next(shuffled), content[:start])
    return head + content[start:]


MUTATIONS = [flip_bytes, cut, extend, splice, special_values, edit_header, edit_header, swap_counts]


class TooSlowError(Exception):
    """A file exceeded its time limit."""


@pytest.fixture
def alarm():
    """Raise TooSlowError after some seconds; 0 cancels."""

    def ring(*_):
        raise TooSlowError

    previous = signal.signal(signal.SIGALRM, ring)
    yield lambda seconds: signal.setitimer(signal.ITIMER_REAL, seconds)
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, previous)


def load(path, alarm):
    """The cloud or the error, and the peak memory in bytes."""
    before = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    alarm(SECONDS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # NumPy's own are not for users
        warnings.simplefilter("ignore", UserWarning)
        try:
            outcome = fs.load_ply(path)
        except fs.InputError as error:
            outcome = error
    alarm(0)
    return outcome, tracemalloc.get_traced_memory()[1] - before


def assert_good(cloud):
    """Check that every loaded splat is valid."""
    for name in ("means", "quats", "scales", "opacities", "sh"):
        array = getattr(cloud, name)
        assert len(array) == len(cloud) == len(cloud.labels)
        assert np.isfinite(array).all(), name
    assert (cloud.scales > 0).all()
    assert ((cloud.opacities >= 0) & (cloud.opacities <= 1)).all()
    assert np.allclose((cloud.quats.astype(float) ** 2).sum(1), 1, atol=1e-6)
    assert cloud.coplanar_groups is None or (
        len(cloud.coplanar_groups) == len(cloud) and (cloud.coplanar_groups >= -1).all()
    )
    assert np.isfinite(cloud.origin).all()


@pytest.mark.parametrize("kind", KINDS)
def test_mutated_files_are_a_cloud_or_an_input_error(tmp_path, alarm, kind):
    generator = np.random.default_rng(list(kind.encode()))
    path = tmp_path / "mutated.ply"
    good = {n: KINDS[kind](n, generator, tmp_path) for n in sorted(set(SIZES))}
    np.median([0.0])  # imports a megabyte of NumPy on first use, which is not the file's
    outcomes: Counter[str] = Counter()
    slowest = most = 0.0
    tracemalloc.start()
    try:
        for number, splats in enumerate(SIZES):
            content = good[splats]
            for _ in range(generator.integers(1, 3)):
                content = MUTATIONS[generator.integers(len(MUTATIONS))](content, generator) or b"p"
            path.write_bytes(content)
            begin = time.perf_counter()
            outcome, used = load(path, alarm)
            slowest = max(slowest, time.perf_counter() - begin)
            holds = len(content) * (UNPACKED if kind.startswith("compressed") else 1)
            if len(content) > 300_000:
                most = max(most, used / holds)
            assert used <= 2 * holds + CONSTANT, f"file {number}: {used} bytes of memory for {len(content)}"
            if isinstance(outcome, fs.InputError):
                assert str(path) in str(outcome), f"file {number}: the error does not name it"
                outcomes["InputError"] += 1
            else:
                assert_good(outcome)
                outcomes["splats left out" if outcome.dropped else "whole"] += 1
            del outcome
    finally:
        tracemalloc.stop()
    print(
        f"{kind}: {dict(outcomes)}; slowest {slowest * 1e3:.0f} ms; memory at most {most:.2f} x what it holds"
    )
    assert set(outcomes) == {"whole", "splats left out", "InputError"}, "the mutations miss an outcome"
