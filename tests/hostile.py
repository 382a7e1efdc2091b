"""Hypothesis strategies for hostile input, and the limits that every input is held to.

`damaged(path)` fits the strategy to the kind of file: bytes of any file are cut, exchanged and repeated; numbers
and words of text are exchanged for extreme ones, lines repeated and nested; values of JSON, arrays of NPY and NPZ
files, members of ZIP files and the content of gzip files are changed inside valid containers.
"""

from __future__ import annotations

import copy
import gzip
import io
import json
import re
import resource
import signal
import struct
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

import fidsplat as fs
from fidsplat.util import zstd
from fidsplat.util.errors import LONGEST

SECONDS = 10
"""of processor time for an input"""
GIB = 1.5
"""of memory that an input may take at its peak"""
MOST_WORDS = LONGEST + len(" ... ")
"""characters of an error"""
LONG = "x" * 50_000
NUMBERS = [
    "0", "-1", "1", "0.5", "1e308", "-1e308", "1e400", "nan", "inf", "-inf", "0x10", "-0.0", "1_0", "true", "[]", "{}",
    "[[1]]", "1979-05-27", "9" * 20, "9" * 400, "9" * 5000, '""', '"a"', "[1, 2]", "1e-320", "2147483648", "-2147483649",
]  # fmt: skip
"""what a number may be exchanged for"""
TEXTS = [
    "", " ", "\0", "\n", "\ud800", "\x1b[31m", "qr:", "image:", "image:.", "svg:.", "aruco::", "a,b,=", LONG, "a." * 9,
    "%s%n", "..", "/", "/dev/null", "/dev/zero", "-", "--", "'", '"', "{}", "rgb", "nan", "-1", "0", "1e999", "𝕏é", "=,=",
    "<script>", "$x^{$", "../../etc/passwd", "file:///etc/passwd",
]  # fmt: skip
"""texts that nobody expects"""
JUNK: list[Any] = [
    None, True, False, 0, -1, 1, 5, 2**31, 2**70, -(2**70), 10**400, 0.5, -0.0, 1e-320, 1e308, float("nan"),
    float("inf"), -float("inf"), "", "a", "rgb", "nan", "../..", "\0", "\ud800", "\n", "𝕏", LONG, b"", b"\xff", 1j,
    [], [1], [1, 2, 3], [[1], [2, 3]], ["a", "b", "c"], [None], [float("nan")] * 3, [1e300] * 3, (), (0, 0, 0), {},
    {1: 2}, {"rgb": 1}, {1, 2, 3}, object(), lambda *_: None, iter(()), range(3), ..., Decimal("1e999"),
    Fraction(1, 3), Path("nowhere"), slice(None), np.float32("nan"), np.int64(-5), np.bool_(True), np.array(3.0),
    np.array("text"), np.array([None]), np.zeros((0, 3)), np.zeros((3, 3, 3)), np.zeros((4, 4)), -np.eye(4), np.eye(3),
    np.full((4, 4), np.nan), np.eye(4) * 1e300, np.eye(4, dtype=complex), np.zeros((2, 2), "O"),
    np.array(["2020-01-01"], "datetime64[D]"), np.ma.masked_array([1.0], [True]),
]  # fmt: skip
"""values that nobody expects"""
_JSON: list[Any] = [
    None, True, 0, -1, 1, 2**31, 2**53, 2**64, 10**400, 0.5, 1e308, -1e308, float("nan"), float("inf"), "", "a", "\0", LONG,
    [], [1, 2, 3], [[1]], {}, {"a": 1}, [0] * 5000, "../a", "data:,", "http://a/b",
]  # fmt: skip
_WORDS = [
    struct.pack(form, value)
    for form in ("<i", "<I", "<q", "<f", "<d", ">I", "<H")
    for value in (0, 1, 2**15, 2**31 - 1, 2**32 - 1, 2**62, float("nan"), float("inf"), 1e30)
    if (form[1] in "fd") == isinstance(value, float) and (form[1] in "fd" or value < 2 ** {"i": 31, "I": 32, "q": 63, "H": 16}[form[1]])
]  # fmt: skip
"""binary numbers on the edge of what a field holds"""
TEXTUAL = {
    ".toml",
    ".svg",
    ".sdf",
    ".urdf",
    ".yaml",
    ".txt",
    ".tum",
    ".kitti",
    ".csv",
    ".usda",
    ".jsonl",
    ".html",
}


@st.composite
def corrupted(draw: st.DrawFn, data: bytes) -> bytes:
    """Bytes cut, exchanged, repeated or left out, at one to four places."""
    for _ in range(draw(st.integers(1, 4))):
        at, length = draw(st.integers(0, len(data))), draw(st.sampled_from([1, 2, 4, 8, 30, 1000]))
        match draw(st.integers(0, 6)):
            case 0:
                data = data[:at]
            case 1:
                word = draw(st.sampled_from(_WORDS))
                data = data[:at] + word + data[at + len(word) :]
            case 2:
                data = data[:at] + draw(st.binary(min_size=1, max_size=16)) + data[at + length :]
            case 3:
                data = data[:at] + draw(st.sampled_from([b"\0", b"\xff"])) * length + data[at + length :]
            case 4:
                data = (
                    data[:at] + data[at : at + length] * draw(st.sampled_from([2, 9])) + data[at + length :]
                )
            case 5:
                data = data[:at] + data[at + length :]
            case _ if at < len(data):
                data = data[:at] + bytes([data[at] ^ (1 << draw(st.integers(0, 7)))]) + data[at + 1 :]
    return data


@st.composite
def corrupted_text(draw: st.DrawFn, text: str) -> bytes:
    """Numbers and words exchanged, lines repeated, left out and nested."""
    for _ in range(draw(st.integers(1, 3))):
        lines = text.split("\n")
        at = draw(st.integers(0, len(lines) - 1))
        match draw(st.integers(0, 7)):
            case 0 | 1 | 2:
                number = draw(st.booleans())
                spots = [*re.finditer(r"-?\d[-+.\deE]*" if number else r"[\w.#%/-]+", text)]
                if spots:
                    spot = draw(st.sampled_from(spots))
                    new = draw(st.sampled_from(NUMBERS if number else NUMBERS + TEXTS))
                    text = text[: spot.start()] + new + text[spot.end() :]
                continue
            case 3:
                lines[at] = "\n".join([lines[at]] * draw(st.sampled_from([2, 1000])))
            case 4:
                lines[at] = draw(st.sampled_from(["", *TEXTS, *NUMBERS]))
            case 5:
                lines.insert(at, draw(st.sampled_from(lines)))
            case 6:
                deep = draw(st.sampled_from([2, 99, 20_000]))
                around = draw(
                    st.sampled_from(["[]", "{}", "()", "<g></g>", '<model name="a"></model>', '"""'])
                )
                half = len(around) // 2 + (around.startswith("<g"))
                opening = around[: around.index("</")] if "</" in around else around[: half or 1]
                lines[at] = opening * deep + lines[at] + around[len(opening) :] * deep
            case _:
                lines[at] = lines[at][: draw(st.integers(0, len(lines[at])))]
        text = "\n".join(lines)
    data = text.encode("utf-8", "surrogatepass")
    return draw(corrupted(data)) if draw(st.integers(0, 4)) == 0 else data


@st.composite
def corrupted_json(draw: st.DrawFn, text: str) -> bytes:
    """Values exchanged, left out or repeated, in JSON that stays valid; or its text damaged."""
    if draw(st.integers(0, 3)) == 0:
        return draw(corrupted_text(text))
    root = [json.loads(text)]
    for _ in range(draw(st.integers(1, 3))):
        places = list(_places(root))
        holder, key = draw(st.sampled_from(places))
        match draw(st.integers(0, 4)):
            case 0 if holder is not root:
                del holder[key]
            case 1 if isinstance(holder, list):
                holder[key:key] = [holder[key]] * draw(st.sampled_from([1, 3000]))
            case 2 if isinstance(holder[key], (int, float)):
                holder[key] = draw(
                    st.sampled_from([-1, 0, 1, 2**31, 2**53, 1e300, -holder[key], holder[key] + 1, 0.5])
                )
            case _:
                holder[key] = copy.deepcopy(draw(st.sampled_from(_JSON)))
    return json.dumps(root[0]).encode()


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    keys = range(len(value)) if isinstance(value, list) else list(value) if isinstance(value, dict) else ()
    for key in keys:
        yield value, key
        yield from _places(value[key])


@st.composite
def corrupted_array(draw: st.DrawFn, array: np.ndarray) -> np.ndarray:
    """An array with other values, another shape or another type."""
    match draw(st.integers(0, 6)):
        case 0:
            return array[: draw(st.integers(0, len(array)))] if array.ndim else array[None]
        case 1:
            return np.concatenate([array, array]) if array.ndim else np.stack([array, array])
        case 2:
            return array.reshape(-1) if draw(st.booleans()) else array[..., None]
        case 3 if array.dtype.names is None:
            with np.errstate(all="ignore"):
                return array.astype(draw(st.sampled_from(["f8", "f2", "i4", "u1", ">f4", "c8", "S3", "U3"])))
        case 4:
            return np.zeros(draw(st.sampled_from([(0,), (1, 1), (3, 0), ()])), array.dtype)
        case _:
            array = array.copy()
            target = array[draw(st.sampled_from(array.dtype.names))] if array.dtype.names else array
            if target.size and target.dtype.kind in "fiu":
                values = (
                    [np.nan, np.inf, -1.0, 0.0, 1e30] if target.dtype.kind == "f" else [0, 1, -1, 2**31 - 1]
                )
                where = draw(st.integers(0, target.size - 1))
                with np.errstate(all="ignore"):
                    target.reshape(-1)[where : where + 1] = np.array(draw(st.sampled_from(values))).astype(
                        target.dtype
                    )
            return array


@st.composite
def corrupted_npz(draw: st.DrawFn, data: bytes) -> bytes:
    with np.load(io.BytesIO(data)) as file:
        arrays = dict(file)
    for _ in range(draw(st.integers(1, 2))):
        name = draw(st.sampled_from(sorted(arrays)))
        if arrays[name].dtype.kind == "U" and arrays[name].ndim == 0:
            text = draw(corrupted_json(str(arrays[name]))).decode("utf-8", "replace")
            arrays[name] = np.array(text)
        elif draw(st.integers(0, 5)) == 0:
            del arrays[name]
            if not arrays:
                break
        else:
            arrays[name] = draw(corrupted_array(arrays[name]))
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


@st.composite
def corrupted_npy(draw: st.DrawFn, data: bytes) -> bytes:
    stream = io.BytesIO()
    np.save(stream, draw(corrupted_array(np.load(io.BytesIO(data)))))
    return stream.getvalue()


@st.composite
def corrupted_zip(draw: st.DrawFn, data: bytes) -> bytes:
    """A ZIP file with a damaged member."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    name = draw(st.sampled_from(sorted(members)))
    members[name] = draw(damaged(Path(name), members[name]))
    if draw(st.integers(0, 5)) == 0:
        members[draw(st.sampled_from([*sorted(members), "../a", "a" * 70_000, "/etc/a"])).strip()] = (
            members.pop(name)
        )
    stream = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(stream, "w") as archive:
        warnings.simplefilter("ignore")
        for member, content in members.items():
            archive.writestr(member[:60_000], content)
    return stream.getvalue()


@st.composite
def corrupted_frames(draw: st.DrawFn, data: bytes) -> bytes:
    """An SPZ file of version 4 with a damaged array in a valid frame, or changed sizes in its table."""
    streams, table = data[15], int.from_bytes(data[16:20], "little")
    sizes = [struct.unpack_from("<QQ", data, table + 16 * k) for k in range(streams)]
    place, frames = table + 16 * streams, []
    for packed, size in sizes:
        frames.append((zstd.decompress(data[place : place + packed], size), size))
        place += packed
    number = draw(st.integers(0, streams - 1))
    content, size = frames[number]
    content = draw(st.one_of(corrupted(content), st.just(bytes(draw(st.sampled_from([0, 2**24]))))))
    frames[number] = (content, draw(st.sampled_from([size, len(content), 2**40, 2**64 - 1])))
    packed = [zstd.compress(content) for content, _ in frames]
    rows = [struct.pack("<QQ", len(frame), size) for frame, (_, size) in zip(packed, frames, strict=True)]
    return b"".join([data[:table], *rows, *packed])


def damaged(path: Path, data: bytes | None = None) -> st.SearchStrategy[bytes]:
    """Contents of a damaged file, by the ending of its name. data: its contents; default those of the file."""
    data = path.read_bytes() if data is None else data
    inside: st.SearchStrategy[bytes] | None = None
    if path.suffix in TEXTUAL:
        inside = corrupted_text(data.decode())
    elif path.suffix in (".json", ".gltf"):
        inside = corrupted_json(data.decode())
    elif path.suffix == ".npz":
        inside = corrupted_npz(data)
    elif path.suffix == ".npy":
        inside = corrupted_npy(data)
    elif path.suffix in (".sog", ".usdz"):
        inside = corrupted_zip(data)
    elif path.suffix == ".spz" and data[:2] == b"\x1f\x8b":
        inside = corrupted(gzip.decompress(data)).map(gzip.compress)
    elif path.suffix == ".spz":
        inside = corrupted_frames(data)
    elif path.suffix == ".ply":
        head, end, body = data.partition(b"end_header\n")
        inside = corrupted_text(head.decode()).map(lambda text: text + end + body)
    elif path.suffix == ".glb":
        size = int.from_bytes(data[12:16], "little")
        inside = corrupted_json(data[20 : 20 + size].decode()).map(lambda text: _glb(text, data[20 + size :]))
    if inside is None:
        return corrupted(data)
    return st.one_of(inside, inside, corrupted(data))


def _glb(text: bytes, rest: bytes) -> bytes:
    text += b" " * (-len(text) % 4)
    size = 20 + len(text) + len(rest)
    return struct.pack("<4sIIII", b"glTF", 2, size, len(text), 0x4E4F534A) + text + rest


class HangError(BaseException):
    """Raised by the alarm; not an Exception, so that no handler converts it to an input error."""


def _hang(*_: Any) -> None:
    raise HangError(f"an input must take at most {SECONDS} s of processor time")


@contextmanager
def limits() -> Iterator[None]:
    """Hold one input to the limits: used without a warning of NumPy, or refused by one line, in time and
    memory."""
    before = signal.signal(signal.SIGPROF, _hang)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    core = resource.getrlimit(resource.RLIMIT_CORE)
    resource.setrlimit(resource.RLIMIT_CORE, (0, core[1]))
    Path("/proc/self/clear_refs").write_text("5")  # sets the peak back
    begun, words = _peak(), ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", UserWarning)
            yield
    except fs.FidsplatError as error:
        words = str(error)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
    assert "\n" not in words, words[:500]
    assert len(words) <= MOST_WORDS, words[:500]
    assert _peak() - begun < GIB * 2**30, f"{(_peak() - begun) / 2**30:.2f} GiB"


def _peak() -> int:
    """Bytes."""
    return 1024 * int(re.findall(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[0])
