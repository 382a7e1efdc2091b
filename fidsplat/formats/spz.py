"""SPZ, Niantic's compressed splats: reads versions 2 and 3, writes 3. Format: nianticlabs/spz, load-spz.cc.

Gzip of a header of 16 bytes and arrays of all splats: positions (3 x 24 bits, fixed point), opacities,
colours and scales (a byte each), rotations (version 2: 3 bytes x, y, z; version 3: 4 bytes with the three
smallest of x, y, z, w and the index of the omitted one), higher SH (a byte each). Axes: y up, z backward.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path

import numpy as np

from fidsplat.formats.plain import HALF_TURN, cloud_of, coefficients, content, refuse_boxes, three_scales
from fidsplat.formats.plain import world_means as means_of
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write
from fidsplat.util.limits import check_expansion

_HEAD = struct.Struct("<IIIBBBB")
_MAGIC = 0x5053474E
_COLOR = 0.15
_MIN_SCALE = float(np.exp(-10.0))
"""smallest scale [m] of the format; a third scale of this size marks a disk"""
_REST = {0: 0, 1: 3, 2: 8, 3: 15}
_FINEST, _BITS = 20, 23
"""maximum number of fractional bits, and bits of a coordinate without its sign"""
_MAX_UNCHECKED = 2**20
"""number of splats above which a file must have at least a byte for each"""


def load_spz(path: Path) -> SplatCloud:
    """Read an SPZ file. Raises InputError for a damaged file or another version."""
    data = content(path, (b"\x1f\x8b", b"NGSP"))
    if data[:4] == _MAGIC.to_bytes(4, "little"):  # version 4 is not compressed by gzip
        raise InputError(
            f"{path}: the version of SPZ must be 2 or 3, got {int.from_bytes(data[4:8], 'little')}"
        )
    try:
        head = zlib.decompressobj(31).decompress(data, _HEAD.size)
        magic, version, n, degree, point, _, _ = _HEAD.unpack(head)
    except (zlib.error, struct.error):
        raise InputError(f"{path} is not an SPZ file: it must begin with a gzip header") from None
    if magic != _MAGIC:
        raise InputError(f"{path} is not an SPZ file: its magic number differs")
    if version not in (2, 3) or degree not in _REST or point > _BITS:
        raise InputError(
            f"{path}: SPZ must have version 2 or 3, SH degree 0 to 3 and at most {_BITS} fractional bits, "
            f"got version {version}, degree {degree} and {point} bits"
        )
    widths = {"means": 9, "opacities": 1, "colors": 3, "scales": 3, "quats": 4 if version == 3 else 3}
    widths["rest"] = 3 * _REST[degree]
    size = _HEAD.size + n * sum(widths.values())
    if max(_MAX_UNCHECKED, len(data)) < n and size <= 1040 * len(data):
        raise InputError(f"{path}: {n} splats must have at least as many bytes, got {len(data)}")
    if size <= 1040 * len(data):  # bytes of the file and of the arrays
        check_expansion(path, n * (sum(widths.values()) + 4 * (14 + widths["rest"])), f"{n:,} splats")
    try:
        # not more than the header declares, nor than gzip's maximum ratio of about 1040
        stream = zlib.decompressobj(31)
        whole = stream.decompress(data, size + 1) if size <= 1040 * len(data) else b""
    except zlib.error as error:
        raise InputError(f"{path}: the SPZ file is damaged ({error})") from None
    if len(whole) < size or (len(whole) == size and not stream.eof):
        raise InputError(f"{path}: cut short: its header declares {size} bytes, got {len(whole)}")
    parts, place = {}, _HEAD.size
    for name, width in widths.items():
        parts[name] = np.frombuffer(whole, np.uint8, n * width, place).reshape(n, width)
        place += n * width
    means = _fixed(parts["means"]) / 2.0**point
    quats = _smallest_three(parts["quats"]) if version == 3 else _first_three(parts["quats"])
    scales = np.exp(parts["scales"] / 16.0 - 10.0)
    dc = ((parts["colors"] / 255.0 - 0.5) / _COLOR).astype(np.float32)
    rest = (parts["rest"].reshape(n, _REST[degree], 3).astype(np.float32) - 128) / 128
    sh = np.concatenate([dc[:, None], rest], axis=1)
    opacities = (parts["opacities"][:, 0] / 255.0).astype(np.float32)
    return cloud_of(path, means, quats, scales, opacities, sh, _MIN_SCALE).transformed(HALF_TURN)


def save_spz(cloud: SplatCloud, path: Path) -> None:
    """Write an SPZ file, with as many fractional bits as the extent of the cloud allows, at most 20 (1 um).

    Raises InputError for boxes, splats further than 8388 km from the origin, or a file that cannot be
    written.
    """
    refuse_boxes(cloud, "an SPZ file")
    rotated = cloud.transformed(HALF_TURN)
    means, sh = means_of(rotated).astype(np.float64), coefficients(rotated)
    furthest = float(np.abs(means).max(initial=0.0))
    point = min(_FINEST, int(np.floor(_BITS - np.log2(max(furthest, 1e-9) * (1 + 1e-6)) - 1e-9)))
    if point < 0:
        raise InputError(f"coordinates in SPZ must be at most {2**_BITS:,} m, got {furthest:g} m")
    degree = int(np.sqrt(sh.shape[1])) - 1
    fixed = np.rint(means * 2.0**point).astype("<i4")
    parts = [
        _HEAD.pack(_MAGIC, 3, len(cloud), degree, point, 0, 0),
        fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3].tobytes(),
        _byte(rotated.opacities * 255.0),
        _byte((sh[:, 0] * _COLOR + 0.5) * 255.0),
        _byte((np.log(three_scales(rotated).astype(np.float64)) + 10.0) * 16.0),
        _packed(rotated.quats),
        _byte(sh[:, 1:] * 128.0 + 128.0),
    ]
    with atomic_write(path) as stream:
        stream.write(gzip.compress(b"".join(parts), mtime=0))


def _byte(values: np.ndarray) -> bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).tobytes()


def _fixed(data: np.ndarray) -> np.ndarray:
    """Decode signed 24-bit integers to (n, 3)."""
    wide = np.zeros((len(data), 3, 4), np.uint8)
    wide[:, :, 1:] = data.reshape(-1, 3, 3)
    return wide.view("<i4")[:, :, 0] >> 8


def _packed(quats: np.ndarray) -> bytes:
    """Encode unit quaternions w, x, y, z: index of the largest of x, y, z, w, sign and 9 bits of the
    others."""
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
