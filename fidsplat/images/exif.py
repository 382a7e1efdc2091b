"""Orientation and focal length of photographs from EXIF data (CIPA DC-008, "Exif 2.3")."""

from __future__ import annotations

import struct
from typing import NamedTuple

ORIENTATION, EXIF_TABLE, FOCAL_LENGTH, FOCAL_LENGTH_35 = 0x0112, 0x8769, 0x920A, 0xA405


class Exif(NamedTuple):
    """EXIF segment of a JPEG file."""

    segment: bytes
    """APP1 segment with its marker; empty if the file has none"""
    orientation: int
    """EXIF orientation, 1 to 8; 1: pixels are stored upright"""
    focal_length: tuple[float, ...]
    """focal length in millimetres and its 35 mm equivalent, if the file has them"""

    @property
    def upright(self) -> bytes:
        """The segment with orientation 1, for pixels that were rotated upright."""
        at = _entries(self.segment[10:], _first(self.segment[10:])).get(ORIENTATION) if self.segment else None
        if at is None:
            return self.segment
        order = _order(self.segment[10:])
        place = 10 + at + 8
        return self.segment[:place] + struct.pack(order + "HH", 1, 0) + self.segment[place + 4 :]


def read_exif(data: bytes) -> Exif:
    """Read the EXIF segment of a JPEG file; an empty result if there is none or it is damaged."""
    segment = _segment(data)
    tiff = segment[10:]
    try:
        entries = _entries(tiff, _first(tiff)) if segment else {}
        orientation = _value(tiff, entries.get(ORIENTATION)) or 1
        table = _value(tiff, entries.get(EXIF_TABLE))
        more = _entries(tiff, int(table)) if table else {}
        focal = tuple(_value(tiff, more[tag]) for tag in (FOCAL_LENGTH, FOCAL_LENGTH_35) if tag in more)
    except (struct.error, ValueError, ZeroDivisionError, KeyError):
        return Exif(b"", 1, ())
    return Exif(segment, int(orientation) if 1 <= orientation <= 8 else 1, tuple(f for f in focal if f))


def with_exif(jpeg: bytes, exif: Exif) -> bytes:
    """A JPEG file with an EXIF segment added, for upright pixels."""
    return jpeg[:2] + exif.upright + jpeg[2:]


def _segment(data: bytes) -> bytes:
    at = 2
    while data[:2] == b"\xff\xd8" and at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        size = int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            return data[at : at + 2 + size]
        at += 2 + size
    return b""


def _order(tiff: bytes) -> str:
    return {b"II": "<", b"MM": ">"}[tiff[:2]]


def _first(tiff: bytes) -> int:
    return struct.unpack_from(_order(tiff) + "I", tiff, 4)[0]


def _entries(tiff: bytes, at: int) -> dict[int, int]:
    """Offset of each entry of a table, by tag."""
    order = _order(tiff)
    (count,) = struct.unpack_from(order + "H", tiff, at)
    places = [at + 2 + 12 * i for i in range(count)]
    return {struct.unpack_from(order + "H", tiff, place)[0]: place for place in places}


def _value(tiff: bytes, at: int | None) -> float:
    """First number of an entry; 0 for a missing entry."""
    if at is None:
        return 0
    order = _order(tiff)
    kind, _ = struct.unpack_from(order + "HI", tiff, at + 2)
    if kind == 5:  # a fraction, stored at an offset
        (place,) = struct.unpack_from(order + "I", tiff, at + 8)
        above, below = struct.unpack_from(order + "II", tiff, place)
        return above / below
    return struct.unpack_from(order + {3: "H", 4: "I"}[kind], tiff, at + 8)[0]
