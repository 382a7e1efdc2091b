"""Small files that declare or expand to huge contents are refused unread, by one limit that can be raised."""

import gzip
import json
import os
import struct
import sys
import tracemalloc
import zipfile
import zlib
from subprocess import run

import cv2
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.formats import load_splats, save_splats, usd
from fidsplat.images.files import decode_rgb, read_bits, read_image
from fidsplat.sim import read_description
from fidsplat.util.limits import FLOOR, RATIO, VARIABLE, input_limit

ONE = fs.SplatCloud([[0, 0, 1.0]], [[1.0, 0, 0, 0]], [[0.1, 0.1]], [0.5], colors=[[1.0, 0, 0]])


def png_header(width, height):
    """A PNG that ends after its header, which declares its size."""
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))


def sog(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("meta.json", json.dumps({"version": 2, "count": 10**8}))
    return path


def changed_gltf(path, change):
    save_splats(fs.SplatCloud.concatenate([ONE] * 1000), path)
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    return path


def of_many_attributes(document):
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    attributes |= {f"_A{k}": attributes["POSITION"] for k in range(20_000)}


def of_many_nodes(document):
    document["nodes"] = [{"mesh": 0} for _ in range(4000)]
    document["scenes"] = [{"nodes": list(range(4000))}]


def sparse_splat(path):
    with path.open("wb") as stream:
        stream.truncate(5 * 2**30)
    return path


def crate(path):
    """A USD file one of whose sections declares 2^40 entries."""
    pytest.importorskip("pxr.UsdVol", reason="pip install 'fidsplat[usd]'")
    save_splats(ONE, path)
    data = bytearray(path.read_bytes())
    table = int.from_bytes(data[16:24], "little")
    fields = data.index(b"FIELDS\0", table)
    start = int.from_bytes(data[fields + 16 : fields + 24], "little")
    data[start : start + 8] = (2**40).to_bytes(8, "little")
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("make", "name", "what"),
    [
        (sog, "a.sog", "100,000,000 splats"),
        (lambda path: changed_gltf(path, of_many_attributes), "a.gltf", "its nodes"),
        (lambda path: changed_gltf(path, of_many_nodes), "a.gltf", "its nodes"),
        (sparse_splat, "a.splat", "167,772,160 splats"),
    ],
)
def test_splats_that_small_files_declare(tmp_path, make, name, what):
    path = make(tmp_path / name)
    tracemalloc.start()
    try:
        with pytest.raises(fs.InputError, match=rf"must expand to at most .*{what}.*set {VARIABLE}="):
            load_splats(path)
        assert tracemalloc.get_traced_memory()[1] < FLOOR
    finally:
        tracemalloc.stop()


PEAK_OF_CHILDREN = """
import resource, sys
import fidsplat as fs
from fidsplat.formats import load_splats
try:
    load_splats(sys.argv[1])
except fs.InputError:
    print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""


def test_a_usd_file_is_read_by_a_process_with_limits(tmp_path, monkeypatch):
    pytest.importorskip("resource")
    path = crate(tmp_path / "a.usdc")
    with pytest.raises(fs.InputError, match=r"a\.usdc"):
        load_splats(path)
    # in a process of its own, since the largest child counts; KiB: a child that takes 2^40 entries, or memory
    # without limit, has more
    measured = run([sys.executable, "-c", PEAK_OF_CHILDREN, path], capture_output=True, text=True, check=True)
    assert 0 < int(measured.stdout) < 2**21
    save_splats(ONE, path)
    monkeypatch.setattr(usd, "_CHILD", "import os; os.abort()")
    with pytest.raises(fs.InputError, match=r"exit status -6 of its process; .* set FIDSPLAT_INPUT_LIMIT="):
        load_splats(path)


def test_a_usd_file_that_refers_to_a_pipe(tmp_path):
    pytest.importorskip("pxr.UsdVol", reason="pip install 'fidsplat[usd]'")
    os.mkfifo(tmp_path / "pipe.usda")
    path = tmp_path / "a.usda"
    path.write_text("#usda 1.0\n(\n subLayers = [@./pipe.usda@]\n)\n")
    with pytest.raises(fs.InputError, match=r"a\.usda: "):
        load_splats(path)


def images():
    """Beginnings of images of 16384 x 16384 pixels, and small complete ones whose declared size is
    changed."""
    small = {
        kind: cv2.imencode(f".{kind}", np.zeros((5, 7, 3), np.uint8))[1].tobytes()
        for kind in ("jpg", "bmp", "tiff")
    }
    side = 16384
    frame = small["jpg"].index(b"\xff\xc0") + 5
    yield "png", png_header(side, side)
    yield (
        "webp",
        b"RIFF\0\0\0\0WEBPVP8L\0\0\0\0/" + (side - 1 | side - 1 << 14).to_bytes(4, "little") + bytes(8),
    )
    yield "jpg", small["jpg"][:frame] + struct.pack(">HH", side, side) + small["jpg"][frame + 4 :]
    yield "bmp", small["bmp"][:18] + struct.pack("<ii", side, side) + small["bmp"][26:]
    tiff = bytearray(small["tiff"])
    at = int.from_bytes(tiff[4:8], "little") + 2
    for k in range(at, at + 12 * int.from_bytes(tiff[at - 2 : at], "little"), 12):
        if int.from_bytes(tiff[k : k + 2], "little") in (256, 257):
            tiff[k + 8 : k + 12] = side.to_bytes(4, "little")
    yield "tiff", bytes(tiff)


@pytest.mark.parametrize(("kind", "data"), list(images()), ids=lambda x: x if isinstance(x, str) else "")
def test_images_that_small_files_declare(tmp_path, kind, data):
    path = tmp_path / f"a.{kind}"
    path.write_bytes(data)
    for read in (lambda: read_image(path), lambda: read_bits(path), lambda: decode_rgb(data)):
        with pytest.raises(fs.InputError, match="268,435,456 pixels"):
            read()


@pytest.mark.parametrize("kind", [b"\x42\xff\xff\xff", b"IDAT", b"tEXt", b"iCCP"])
def test_a_png_chunk_that_is_longer_than_its_file(tmp_path, kind):
    """libpng allocates the memory of a chunk before it reads it."""
    contents = cv2.imencode(".png", np.zeros((8, 12, 3), np.uint8))[1].tobytes()
    path = tmp_path / "a.png"
    for length in (0x7FFFFFFF, 0xFFFFFF7F, len(contents) + 100):
        data = contents[:33] + struct.pack(">I", length) + kind + contents[41:]
        path.write_bytes(data)
        for read in (lambda: read_image(path), lambda: read_bits(path), lambda data=data: decode_rgb(data)):
            with pytest.raises(fs.InputError, match=rf"chunks within its \d+ bytes, got one of {length:,}"):
                read()


@pytest.mark.parametrize("indexed", [True, False])
@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_chunks_of_logs(tmp_path, monkeypatch, indexed, compression):
    writer = pytest.importorskip("mcap.writer", reason="pip install 'fidsplat[logs]'")
    from fidsplat.logs import log_images

    kind = writer.CompressionType[compression.upper()]
    path, zeros = tmp_path / "a.mcap", bytes(2**20)
    with path.open("wb") as stream:
        bag = writer.Writer(
            stream, chunk_size=2**24, compression=kind, use_chunking=True, use_summary_offsets=indexed
        )
        if not indexed:
            bag = writer.Writer(stream, chunk_size=2**24, compression=kind, index_types=writer.IndexType.NONE)
        bag.start()
        schema = bag.register_schema("sensor_msgs/msg/Image", "ros2msg", b"")
        channel = bag.register_channel("/a", "cdr", schema)
        for time in range(20):
            bag.add_message(channel, time, zeros, time)
        bag.finish()
    monkeypatch.setattr("fidsplat.util.limits.FLOOR", 2**22)
    monkeypatch.setattr("fidsplat.util.limits.RATIO", 1)
    with pytest.raises(fs.InputError, match=r"a\.mcap must expand to at most 4.*chunk"):
        list(log_images(path))


def test_the_limit_follows_the_size_of_a_file_and_is_raised_by_the_environment(tmp_path, monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    assert input_limit(10) == FLOOR
    assert input_limit(2 * FLOOR // RATIO) == 2 * FLOOR
    path = tmp_path / "a.png"
    path.write_bytes(png_header(16384, 16384))
    monkeypatch.setenv(VARIABLE, str(2**40))
    with pytest.raises(fs.InputError, match="as an image; it is truncated or damaged"):  # it was tried
        read_image(path)
    monkeypatch.setenv(VARIABLE, "lots")
    with pytest.raises(fs.InputError, match=f"{VARIABLE} must be a number of bytes above 0, got 'lots'"):
        read_image(path)


@pytest.mark.parametrize("degree", [0, 3])
def test_splats_that_a_small_spz_file_declares(tmp_path, monkeypatch, degree):
    """At most one in each byte of a file, as before, which still is 300 bytes of memory for each."""
    count, rest = 3 * 2**20, {0: 0, 3: 45}[degree]
    head = struct.pack("<IIIBBBB", 0x5053474E, 3, count, degree, 12, 0, 0)
    body = np.random.default_rng(0).integers(0, 256, count, np.uint8).tobytes()  # does not compress
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(head + body + bytes(count * (19 + rest)), 1))
    monkeypatch.setattr("fidsplat.util.limits.FLOOR", 2**20)
    monkeypatch.setattr("fidsplat.util.limits.RATIO", 8)
    with pytest.raises(fs.InputError, match=rf"must expand to at most .* got 3,145,728 splats .*{VARIABLE}="):
        load_splats(path)


def test_includes_that_double_and_models_that_nest(tmp_path):
    for k in range(26):
        twice = f"<include><uri>m{k + 1}.sdf</uri><name>a</name></include>" * 2
        inner = twice.replace("<name>a", "<name>b", 1) if k < 25 else '<link name="l"/>'
        (tmp_path / f"m{k}.sdf").write_text(f'<sdf version="1.9"><model name="m">{inner}</model></sdf>')
    with pytest.raises(fs.InputError, match=r"at most 10,000 models .* max_models=N"):
        read_description(tmp_path / "m0.sdf")
    assert len(read_description(tmp_path / "m18.sdf").bodies) == 2**7
    with pytest.raises(fs.InputError, match="at most 50 models"):
        read_description(tmp_path / "m18.sdf", max_models=50)
    deep = '<model name="m">' * 20_000 + "</model>" * 20_000
    (tmp_path / "deep.sdf").write_text(f'<sdf version="1.9">{deep}</sdf>')
    with pytest.raises(fs.InputError, match="nested at most 32 deep"):
        read_description(tmp_path / "deep.sdf")
