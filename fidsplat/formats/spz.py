"""Reading of SPZ, Niantic's compressed splats, in versions 2 to 4, and writing of 3 and 4. Format: README of
nianticlabs/spz.

The file has one array per attribute: positions (3 x 24 bits, fixed point), opacities, colours and scales (a
byte each), rotations (version 2: x, y, z in 3 bytes; later: the three smallest of x, y, z, w and the index of
the largest in 4 bytes), SH above degree 0 (a byte each). Axes: y up, z backward. Versions 2 and 3 are a gzip
stream of a header of 16 bytes and the arrays. Version 4 has a header of 32 bytes, extensions (type, length,
content), a table of sizes, and a Zstandard frame per array.
"""

from __future__ import annotations

import gzip
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np

from fidsplat.formats.plain import HALF_TURN, cloud_of, coefficients, content, refuse_boxes, three_scales
from fidsplat.formats.plain import world_means as means_of
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util import zstd
from fidsplat.util.errors import InputError
from fidsplat.util.files import write_file
from fidsplat.util.limits import check_expansion

_HEAD = struct.Struct("<4sIIBBBB")
_HEAD_4 = struct.Struct("<4sIIBBBBI12x")
_SIZES, _RECORD = struct.Struct("<QQ"), struct.Struct("<II")
_HAS_EXTENSIONS = 2
"""flag of version 4: the file has extensions"""
_AXES = 0xADBE0003
"""type of Adobe's extension with the coordinate system"""
_TO_RDF = {0: (1, -1, -1), 1: (-1, 1, -1), 4: (1, -1, -1), 6: (1, 1, 1), 7: (-1, -1, 1)}
"""signs of the axes, by coordinate system that is a rotation of ours: unspecified, LDB, RUB, RDF, LUF"""
_LABELS, _GROUPS = 0xF1D50001, 0xF1D50002
"""types of fidsplat's extensions: int32 per splat in a Zstandard frame"""
_MAGIC = b"NGSP"
_COLOR = 0.15
_MIN_SCALE = float(np.exp(-10.0))
"""smallest scale [m] of the format; a third scale of this size marks a disk"""
_REST = {0: 0, 1: 3, 2: 8, 3: 15, 4: 24}
_FINEST, _BITS = 20, 23
"""maximum number of fractional bits; bits per coordinate without the sign"""
_MAX_UNCHECKED = 2**20
"""number of splats above which the file must have at least one byte per splat"""


def load_spz(path: Path) -> SplatCloud:
    """Read an SPZ file. Raises InputError for a damaged file or another version."""
    data = content(path, (b"\x1f\x8b", b"NGSP"))
    read = _frames if data[:4] == _MAGIC else _gzip
    version, n, degree, point, parts, extensions = read(path, data)
    means = _fixed(parts["means"]) / 2.0**point
    quats = _first_three(parts["quats"]) if version == 2 else _smallest_three(parts["quats"])
    scales = np.exp(parts["scales"] / 16.0 - 10.0)
    dc = ((parts["colors"] / 255.0 - 0.5) / _COLOR).astype(np.float32)
    rest = (parts["rest"].reshape(n, _REST[degree], 3)[:, : _REST[3]].astype(np.float32) - 128) / 128
    if degree > 3:
        warnings.warn(f"{path}: SH above degree 3 are ignored, got degree {degree}", stacklevel=3)
    sh = np.concatenate([dc[:, None], rest], axis=1)
    opacities = (parts["opacities"][:, 0] / 255.0).astype(np.float32)
    axes, labels, groups = _known(path, extensions, n)
    cloud = cloud_of(path, means, quats, scales, opacities, sh, _MIN_SCALE, labels, groups)
    return cloud.transformed(np.diag([*axes, 1.0]))


def _widths(version: int, degree: int) -> dict[str, int]:
    """Bytes per splat of each array, in the order of the file."""
    widths = {"means": 9, "opacities": 1, "colors": 3, "scales": 3, "quats": 3 if version == 2 else 4}
    return widths | {"rest": 3 * _REST[degree]}


def _check_start(path: Path, data: bytes, size: int) -> None:
    """Refuse an unknown version, also of a file that is truncated after it; then a truncated header."""
    version = int.from_bytes(data[4:8], "little")
    if len(data) >= 8 and version not in (2, 3, 4):
        raise InputError(
            f"{path}: the version of SPZ must be 2, 3 or 4, got {version}; convert it by spz_to_ply of "
            "nianticlabs/spz"
        )
    if len(data) < size:
        raise InputError(f"{path}: truncated: the header must have {size} bytes, got {len(data)}")


def _check_head(path: Path, degree: int, point: int) -> None:
    if degree not in _REST or point > _BITS:
        raise InputError(
            f"{path}: SPZ must have SH degree 0 to 4 and at most {_BITS} fractional bits, "
            f"got degree {degree} and {point} bits"
        )


def _gzip(path: Path, data: bytes) -> tuple[int, int, int, int, dict[str, np.ndarray], bytes]:
    """Read versions 2 and 3: version, number of splats, SH degree, fractional bits, arrays (n, bytes)."""
    try:
        head = zlib.decompressobj(31).decompress(data, _HEAD.size)
    except zlib.error:
        raise InputError(
            f"{path}: an SPZ file must begin with a gzip header or NGSP, got {data[:4]!r}"
        ) from None
    if len(head) >= 4 and head[:4] != _MAGIC:
        raise InputError(f"cannot read {path} as SPZ: the magic number must be {_MAGIC!r}, got {head[:4]!r}")
    _check_start(path, head, _HEAD.size)
    _, version, n, degree, point, _, _ = _HEAD.unpack(head)
    _check_head(path, degree, point)
    widths = _widths(version, degree)
    size = _HEAD.size + n * sum(widths.values())
    if max(_MAX_UNCHECKED, len(data)) < n and size <= 1040 * len(data):
        raise InputError(f"{path}: {n} splats must have at least as many bytes, got {len(data)}")
    if size <= 1040 * len(data):  # else it is truncated, and has no data to expand
        _check_memory(path, n, widths)
    try:
        # limited by the declared size, and by gzip's maximum ratio of about 1040
        stream = zlib.decompressobj(31)
        data_bytes = stream.decompress(data, size + 1) if size <= 1040 * len(data) else b""
    except zlib.error as error:
        raise InputError(f"{path}: the SPZ file is damaged ({error})") from None
    if len(data_bytes) < size or (len(data_bytes) == size and not stream.eof):
        raise InputError(f"{path}: truncated: its header declares {size} bytes, got {len(data_bytes)}")
    parts, place = {}, _HEAD.size
    for name, width in widths.items():
        parts[name] = np.frombuffer(data_bytes, np.uint8, n * width, place).reshape(n, width)
        place += n * width
    return version, n, degree, point, parts, b""


def _check_memory(path: Path, n: int, widths: dict[str, int]) -> None:
    check_expansion(path, n * (sum(widths.values()) + 4 * (14 + widths["rest"])), f"{n:,} splats")


def _frames(path: Path, data: bytes) -> tuple[int, int, int, int, dict[str, np.ndarray], bytes]:
    """Read version 4: version, number of splats, SH degree, fractional bits, arrays (n, bytes),
    extensions."""
    _check_start(path, data, _HEAD_4.size)
    _, version, n, degree, point, flags, streams, table = _HEAD_4.unpack_from(data)
    _check_head(path, degree, point)
    if version != 4:
        raise InputError(f"{path}: an NGSP file must have SPZ version 4, got {version}; it is damaged")
    widths = {name: width for name, width in _widths(version, degree).items() if width}
    if n == 0:  # a file without splats has no arrays
        widths = {}
    if streams != len(widths):
        raise InputError(f"{path}: SPZ of degree {degree} must have {len(widths)} arrays, got {streams}")
    place = table + streams * _SIZES.size
    if table < _HEAD_4.size or place > len(data):
        raise InputError(f"{path}: truncated: its table must end by byte {place}, got {len(data)} bytes")
    _check_memory(path, n, _widths(version, degree))
    parts = {
        name: np.zeros((n, width), np.uint8)
        for name, width in _widths(version, degree).items()
        if not n or not width
    }
    for (name, width), (packed, size) in zip(
        widths.items(), _SIZES.iter_unpack(data[table:place]), strict=True
    ):
        if size != n * width:
            raise InputError(f"{path}: the array {name} must expand to {n * width} bytes, got {size}")
        if packed > len(data) - place:
            raise InputError(
                f"{path}: truncated: {name} must end by byte {len(data)}, got the end {place + packed}"
            )
        try:
            array = zstd.decompress(memoryview(data)[place : place + packed], size)
        except ValueError as error:
            raise InputError(f"{path}: the SPZ file is damaged ({name}: {error})") from None
        parts[name] = np.frombuffer(array, np.uint8).reshape(n, width)
        place += packed
    return version, n, degree, point, parts, data[_HEAD_4.size : table] if flags & _HAS_EXTENSIONS else b""


def _known(
    path: Path, extensions: bytes, n: int
) -> tuple[tuple[int, int, int], np.ndarray | None, np.ndarray | None]:
    """Signs of the axes, labels and coplanar groups from extensions; other extensions are ignored."""
    axes, integers, place = _TO_RDF[0], {}, 0
    while place < len(extensions):
        if len(extensions) - place < _RECORD.size:
            raise InputError(f"{path}: the SPZ file is damaged: an extension is truncated")
        kind, length = _RECORD.unpack_from(extensions, place)
        place += _RECORD.size
        if length > len(extensions) - place:
            raise InputError(f"{path}: the SPZ file is damaged: an extension is truncated")
        value = extensions[place : place + length]
        place += length
        if kind == _AXES:
            system = int.from_bytes(value, "little") if length == 4 else -1
            if system not in _TO_RDF:
                raise InputError(
                    f"{path}: the coordinate system must be one of {', '.join(map(str, _TO_RDF))}, got "
                    f"{system}; convert it to RUB (4) by nianticlabs/spz"
                )
            axes = _TO_RDF[system]
        elif kind in (_LABELS, _GROUPS):
            try:
                integers[kind] = np.frombuffer(zstd.decompress(value, 4 * n), "<i4").astype(np.int32)
            except ValueError as error:
                raise InputError(f"{path}: the SPZ file is damaged (extension: {error})") from None
    return axes, integers.get(_LABELS), integers.get(_GROUPS)


def save_spz(cloud: SplatCloud, path: Path, version: int = 4) -> None:
    """Write an SPZ file, with as many fractional bits as the cloud's extent allows, at most 20 (1 um).

    version: 4, or 3 for older readers, without labels and coplanar groups.

    Raises InputError for boxes, splats further than 8388 km from the origin, or a file that cannot be
    written.
    """
    refuse_boxes(cloud, "an SPZ file")
    if version not in (3, 4):
        raise InputError(f"version of SPZ must be 3 or 4, got {version!r}")
    rotated = cloud.transformed(HALF_TURN)
    means, sh = means_of(rotated).astype(np.float64), coefficients(rotated)
    largest = float(np.abs(means).max(initial=0.0))
    point = min(_FINEST, int(np.floor(_BITS - np.log2(max(largest, 1e-9) * (1 + 1e-6)) - 1e-9)))
    if point < 0:
        raise InputError(f"coordinates in SPZ must be at most {2**_BITS:,} m, got {largest:g} m")
    degree, n = int(np.sqrt(sh.shape[1])) - 1, len(cloud)
    fixed = np.rint(means * 2.0**point).astype("<i4")
    parts = [
        fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3].tobytes(),
        _byte(rotated.opacities * 255.0),
        _byte((sh[:, 0] * _COLOR + 0.5) * 255.0),
        _byte((np.log(three_scales(rotated).astype(np.float64)) + 10.0) * 16.0),
        _packed(rotated.quats),
        _byte(sh[:, 1:] * 128.0 + 128.0),
    ]
    if version == 3:
        head = _HEAD.pack(_MAGIC, 3, n, degree, point, 0, 0)
        data = gzip.compress(head + b"".join(parts), mtime=0)
    else:
        data = _version_4(cloud, degree, point, [part for part in parts if part])
    write_file(path, data)


def _version_4(cloud: SplatCloud, degree: int, point: int, parts: list[bytes]) -> bytes:
    extensions = b""
    integers = {_LABELS: cloud.labels if cloud.labels.any() else None, _GROUPS: cloud.coplanar_groups}
    for kind, numbers in integers.items():
        if numbers is not None:
            value = zstd.compress(numbers.astype("<i4").tobytes())
            extensions += _RECORD.pack(kind, len(value)) + value
    frames = [zstd.compress(part) for part in parts]
    flags, table = _HAS_EXTENSIONS if extensions else 0, _HEAD_4.size + len(extensions)
    head = _HEAD_4.pack(_MAGIC, 4, len(cloud), degree, point, flags, len(parts), table)
    sizes = [_SIZES.pack(len(frame), len(part)) for frame, part in zip(frames, parts, strict=True)]
    return b"".join([head, extensions, *sizes, *frames])


def _byte(values: np.ndarray) -> bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).tobytes()


def _fixed(data: np.ndarray) -> np.ndarray:
    """Decode signed 24-bit integers to (n, 3)."""
    wide = np.zeros((len(data), 3, 4), np.uint8)
    wide[:, :, 1:] = data.reshape(-1, 3, 3)
    return wide.view("<i4")[:, :, 0] >> 8


def _packed(quats: np.ndarray) -> bytes:
    """Encode unit quaternions w, x, y, z: index of the largest of x, y, z, w, and sign and 9 bits of each of
    the others."""
    q = quats[:, [1, 2, 3, 0]].astype(np.float64)
    largest = np.abs(q).argmax(axis=1)
    q *= np.where(np.take_along_axis(q, largest[:, None], 1) < 0, -1, 1)
    word = largest.astype(np.uint32)
    for i in range(4):
        size = np.floor(511 * np.abs(q[:, i]) * np.sqrt(2) + 0.5).astype(np.uint32)
        entry = (word << 10) | ((q[:, i] < 0).astype(np.uint32) << 9) | np.minimum(size, 511)
        word = np.where(largest == i, word, entry)
    return word.astype("<u4").tobytes()


def _smallest_three(data: np.ndarray) -> np.ndarray:
    word = np.ascontiguousarray(data).view("<u4")[:, 0].astype(np.uint32)
    largest, q = word >> 30, np.zeros((len(word), 4))
    for i in (3, 2, 1, 0):
        stored = largest != i
        size = (word & 511) / 511 / np.sqrt(2)
        q[:, i] = np.where(stored, np.where(word >> 9 & 1, -size, size), 0)
        word = np.where(stored, word >> 10, word)
    omitted = np.sqrt(np.maximum(0, 1 - (q * q).sum(axis=1)))
    q[np.arange(len(q)), largest] = omitted
    return q[:, [3, 0, 1, 2]]


def _first_three(data: np.ndarray) -> np.ndarray:
    xyz = data / 127.5 - 1.0
    w = np.sqrt(np.maximum(0, 1 - (xyz * xyz).sum(axis=1)))
    return np.column_stack([w, xyz])
