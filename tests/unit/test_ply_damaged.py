"""Every way in which a PLY file can be damaged is an InputError that names the file, found without a large
allocation."""

import os
import tracemalloc

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.formats import collect

N = 300


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    r = np.random.default_rng(0)
    f = np.float32
    cloud = fs.SplatCloud(
        r.normal(size=(N, 3)).astype(f),
        r.normal(size=(N, 4)).astype(f),
        r.uniform(0.1, 1, (N, 2)).astype(f),
        r.random(N, dtype=f),
        sh=r.normal(size=(N, 4, 3)).astype(f),
    )
    path = tmp_path_factory.mktemp("ply") / "good.ply"
    fs.save_ply(cloud, path)
    return path.read_bytes()


def refused(path, words):
    tracemalloc.start()
    try:
        with pytest.raises(fs.InputError, match=words) as caught:
            fs.load_ply(path)
        assert tracemalloc.get_traced_memory()[1] < 4e6
    finally:
        tracemalloc.stop()
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def swap(old, new):
    def damage(content):
        assert content.count(old) == 1
        return content.replace(old, new)

    return damage


HEAD = b"ply\nformat binary_little_endian 1.0\n"
DAMAGES = {
    "cut in the data": (lambda c: c[:-1], r"truncated: its header declares \d+ bytes, but the file has \d+"),
    "cut after the header": (lambda c: c[: c.index(b"end_header\n") + 11], "truncated"),
    "cut in the header": (lambda c: c[:200], "must have end_header within"),
    "empty": (lambda c: b"", "is empty"),
    "not a PLY": (lambda c: b"\x89PNG\r\n\x1a\n" + c, "as PLY: its first line"),
    "text": (lambda c: b"hello\n", "as PLY: its first line must be"),
    "zeros": (lambda c: bytes(5000), "as PLY: its first line must be"),
    "begins like one": (lambda c: b"plywood\n" + c, "as PLY: its first line must be"),
    "ascii": (
        swap(b"binary_little_endian", b"ascii"),
        "format must be binary_little_endian 1.0, got ascii 1.0; convert it by plyfile",
    ),
    "big-endian": (
        swap(b"binary_little_endian", b"binary_big_endian"),
        "the PLY format must be binary_little_endian 1.0, got binary_big_endian 1.0;",
    ),
    "version 2": (swap(b"endian 1.0", b"endian 2.0"), "got binary_little_endian 2.0; convert it by plyfile"),
    "no format": (
        swap(b"format binary_little_endian 1.0\n", b""),
        "the PLY format must be binary_little_endian 1.0, got None; convert it",
    ),
    "no end_header": (swap(b"end_header\n", b""), "must have end_header within"),
    "endless header": (lambda c: HEAD + b"comment x\n" * 10**6, "must have end_header within 65536 bytes"),
    "endless line": (lambda c: HEAD + b"x" * 10**6, "must have end_header within 65536 bytes"),
    "10^12 vertices": (
        swap(b"vertex 300", b"vertex 1000000000000"),
        r"truncated: its header declares \d{15} bytes",
    ),
    "10^17 vertices": (swap(b"vertex 300", b"vertex 100000000000000000"), "truncated"),
    "10^30 vertices": (swap(b"vertex 300", b"vertex 1" + b"0" * 30), "must be a whole number >= 0"),
    "negative count": (swap(b"vertex 300", b"vertex -300"), "must be a whole number >= 0"),
    "count that is no number": (swap(b"vertex 300", b"vertex many"), "must be a whole number >= 0"),
    "count with a point": (swap(b"vertex 300", b"vertex 3e2"), "must be a whole number >= 0"),
    "no count": (swap(b"vertex 300", b"vertex"), "must name a new element"),
    "no vertices": (swap(b"element vertex", b"element face"), "must have the element vertex, got none"),
    "two vertex elements": (
        swap(b"element vertex 300\n", b"element vertex 0\n" * 2),
        "must name a new element",
    ),
    "property before the element": (
        swap(b"element vertex 300\n", b""),
        "must name an element before the property x",
    ),
    "list property": (
        swap(b"end_header", b"element face 1\nproperty list uchar int vertex_indices\nend_header"),
        "must be scalars, got the list 'property list uchar int vertex_indices'",
    ),
    "unknown type": (swap(b"property float x\n", b"property half x\n"), "known type"),
    "short property line": (swap(b"property float x\n", b"property float\n"), "known type"),
    "integer position": (
        swap(b"property float x\n", b"property int x\n"),
        "must be float or double, got x of int32",
    ),
    "integer SH": (
        swap(b"float f_rest_4\n", b"int f_rest_4\n"),
        "must be float or double, got f_rest_4 of int32",
    ),
    "integer third scale": (
        swap(b"float scale_2\n", b"int scale_2\n"),
        "must be float or double, got scale_2 of int32",
    ),
    "repeated property": (swap(b"property float y\n", b"property float x\n"), "must differ, got two x"),
    "missing properties": (
        lambda c: c.replace(b"rot_2", b"rat_2").replace(b"opacity", b"density"),
        "the element vertex of a PLY file of splats must have opacity, rot_2",
    ),
    "a point cloud": (
        lambda c: HEAD + b"element vertex 1\nproperty float x\nend_header\n1234",
        "must have y, z, f_dc_0",
    ),
    "SH of no degree": (swap(b"f_rest_8\n", b"g_rest_8\n"), "properties f_rest_.*, got 8"),
    "SH numbered wrongly": (swap(b"f_rest_8\n", b"f_rest_9\n"), "numbered from 0"),
    "unknown keyword": (
        swap(b"end_header", b"elephant 3\nend_header"),
        "must be a known keyword, got 'elephant 3'",
    ),
    "bytes that are no text": (
        swap(b"element vertex", b"comment \xff\xfe\nelement vertex"),
        "the PLY header must be text, got other bytes",
    ),
    "damaged origin": (
        swap(b"element vertex", b"comment fidsplat origin 1 2\nelement vertex"),
        "three finite numbers",
    ),
    "origin that is nan": (
        swap(b"element vertex", b"comment fidsplat origin 1 2 nan\nelement vertex"),
        "three finite",
    ),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_damaged_file(tmp_path, content, kind):
    damage, words = DAMAGES[kind]
    path = tmp_path / "bad.ply"
    path.write_bytes(damage(content))
    refused(path, words)


def test_missing_file(tmp_path):
    refused(tmp_path / "none.ply", "cannot read .*none.ply: No such file")


def test_folder(tmp_path):
    refused(tmp_path, "must be a regular file, got a folder")


def test_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.ply")
    refused(tmp_path / "pipe.ply", "must be a regular file, got a pipe")


def test_name_that_cannot_be_one():
    with pytest.raises(fs.InputError, match="must be text without NUL"):
        fs.load_ply("a\0b.ply")


def test_unreadable_file(tmp_path, content, monkeypatch):
    path = tmp_path / "secret.ply"
    path.write_bytes(content)

    def deny(*_):  # the tests may run as root, who may read everything
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", deny)
    refused(path, "cannot read .*Permission denied")


def test_every_cut_of_the_header_is_an_error(tmp_path, content):
    path = tmp_path / "bad.ply"
    for length in range(0, content.index(b"end_header\n") + 11, 7):
        path.write_bytes(content[:length])
        with pytest.raises(fs.InputError):
            fs.load_ply(path)


def test_bytes_after_the_data_are_reported(tmp_path, content):
    path = tmp_path / "long.ply"
    path.write_bytes(content + b"12345")
    with pytest.warns(UserWarning, match="5 bytes after the PLY data"):
        assert len(fs.load_ply(path)) == N


def test_random_data_is_left_out_or_drawn_but_never_a_crash(tmp_path, content):
    start = content.index(b"end_header\n") + 11
    noise = np.random.default_rng(0).bytes(len(content) - start)
    path = tmp_path / "noise.ply"
    path.write_bytes(content[:start] + noise)
    with pytest.warns(UserWarning, match=r"noise\.ply: \d+ of 300 splats left out"):
        cloud = fs.load_ply(path)
    assert len(cloud) + sum(cloud.dropped.values()) == N


ROWS = 400_000


def sparse(path, content, rows=ROWS, good=0):
    """A file that declares a number of splats: valid ones of `content` at its end, and zeros that are
    holes of a sparse file."""
    head, _, data = content.partition(b"end_header\n")
    head = head.replace(b"vertex 300", b"vertex %d" % rows) + b"end_header\n"
    with path.open("wb") as stream:
        stream.write(head)
        stream.truncate(len(head) + rows * len(data) // N)
        if good:
            stream.seek(-good * len(data) // N, os.SEEK_END)
            stream.write(data[: good * len(data) // N])
    return path


@pytest.mark.parametrize("good", [0, 100])
def test_memory_grows_with_valid_splats(tmp_path, content, good, monkeypatch):
    """Of rows that are no splats, however many, only a window is in memory at a time."""
    monkeypatch.setattr(collect, "_INITIAL_CAPACITY", 1000)
    monkeypatch.setattr(collect, "WINDOW", 20_000)
    path = sparse(tmp_path / "zeros.ply", content, good=good)
    tracemalloc.start()
    try:
        with pytest.warns(UserWarning, match=f"{ROWS - good} of {ROWS} splats left out .zero quaternion"):
            cloud = fs.load_ply(path)
        now, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(cloud) == good
    assert now < 1e5
    assert peak < path.stat().st_size / 8


def test_arrays_that_grow_while_a_file_is_read(tmp_path, content, monkeypatch):
    path = tmp_path / "good.ply"
    path.write_bytes(content)
    splats = fs.load_ply(path)
    for room in (16, 64, 299):
        monkeypatch.setattr(collect, "_INITIAL_CAPACITY", room)
        monkeypatch.setattr(collect, "WINDOW", 16)
        read = fs.load_ply(path)
        for name in ("means", "quats", "scales", "opacities", "sh"):
            assert np.array_equal(getattr(read, name), getattr(splats, name)), name


def test_progress_is_reported(tmp_path, content, monkeypatch):
    monkeypatch.setattr(collect, "WINDOW", 128)
    path, messages = tmp_path / "good.ply", []
    path.write_bytes(content)
    fs.load_ply(path, progress=lambda *done: messages.append(done))
    assert messages == [("reading good.ply", share) for share in (128 / N, 256 / N, 1.0)]
