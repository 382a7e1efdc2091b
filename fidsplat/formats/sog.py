"""SOG, PlayCanvas' "Spatially Ordered Gaussians", version 2, read only: a zip of meta.json and lossless WebP
pictures with a pixel for each splat. Layout: developer.playcanvas.com, "The SOG Format".

Positions have 16 bits an axis of sign(p) log(1 + |p|), rotations the three smallest of w, x, y, z in 8 bits;
scales, colours and SH are places in code books of 256. Axes are those of the file that it was made of.
"""

from __future__ import annotations

import lzma
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.formats.plain import cloud_of
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import InputError
from fidsplat.util.files import from_json, open_input
from fidsplat.util.limits import check_expansion

MAX_PART, MAX_META = 2**30, 2**24
"""bytes of a picture within the zip and of meta.json: none of so many splats as fit a machine is larger"""
SPARE = 2**16
"""pixels that a picture may have beyond those it is for: writers fill up its last rows"""
_ROW = 64  # palette entries in a row of the picture of centroids
MOST_ENTRIES = 2**16
"""of the palette: labels have 16 bits"""
_SPLAT, _BAND = 160, 28
"""bytes of memory that a splat takes while it is read, and each of its SH coefficients above degree 0"""
_COEFFICIENTS = {1: 3, 2: 8, 3: 15}


def load_sog(path: Path) -> SplatCloud:
    """Read a .sog file. Raises InputError where it is damaged, lacks a part, or has another version."""
    try:
        with open_input(path) as stream, zipfile.ZipFile(stream) as archive:
            return _cloud(path, archive)
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, EOFError, RuntimeError) as error:
        raise InputError(f"{path} is not a SOG file: its zip is damaged ({error})") from None
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: the SOG file is damaged ({type(error).__name__}: {error})") from None


def _cloud(path: Path, archive: zipfile.ZipFile) -> SplatCloud:
    meta = from_json(_part(path, archive, "meta.json", MAX_META))
    if meta.get("version") != 2:
        raise InputError(f"{path}: SOG of version {meta.get('version')!r}; version 2 is read")
    count, bands = int(meta["count"]), _COEFFICIENTS[meta["shN"]["bands"]] if "shN" in meta else 0
    check_expansion(path, count * (_SPLAT + _BAND * bands), f"{count:,} splats")

    def pixels(part: str, number: int = 0) -> np.ndarray:
        """(count, 4) uint8 of a picture with a pixel for each splat."""
        name = meta[part]["files"][number]
        found = _picture(path, archive, name, count).reshape(-1, 4)
        if not 0 <= count <= len(found):
            raise InputError(f"{path}: {name} has {len(found)} pixels for {count} splats")
        return found[:count]

    low, high = pixels("means", 0)[:, :3].astype(np.uint16), pixels("means", 1)[:, :3].astype(np.uint16)
    least, most = (np.array(meta["means"][end], np.float64).reshape(3) for end in ("mins", "maxs"))
    place = least + (most - least) * ((high << 8 | low) / 65535.0)
    means = np.sign(place) * np.expm1(np.abs(place))
    scales = np.exp(_book(meta["scales"])[pixels("scales")[:, :3]])
    base = pixels("sh0")
    sh = _book(meta["sh0"])[base[:, None, :3]]
    if "shN" in meta:
        labels = pixels("shN", 1).astype(np.int64)
        sh = np.concatenate(
            [sh, _higher(path, archive, meta["shN"], labels[:, 0] | labels[:, 1] << 8)], axis=1
        )
    quats = _quaternions(path, pixels("quats"))
    return cloud_of(path, means.astype(np.float32), quats, scales, base[:, 3] / np.float32(255), sh)


def _part(path: Path, archive: zipfile.ZipFile, name: str, most: int = MAX_PART) -> bytes:
    try:
        info = archive.getinfo(name)
    except KeyError:
        raise InputError(f"{path}: the SOG file lacks {name}") from None
    if info.file_size > most:
        raise InputError(f"{path}: {name} has {info.file_size} bytes, which no part of a SOG file has")
    return archive.read(info)


def _picture(path: Path, archive: zipfile.ZipFile, name: str, count: int) -> np.ndarray:
    """(h, w, 4) uint8 RGBA of so many pixels that are meant: a small file can hold a huge picture."""
    from fidsplat.images.files import declared_pixels, rgba_pixels  # late: it brings OpenCV

    data = _part(path, archive, name)
    pixels = declared_pixels(data)
    if pixels > 2 * max(count, 0) + SPARE:
        raise InputError(f"{path}: {name} has {pixels} pixels for {count}; it is not read")
    return rgba_pixels(data if pixels and data[:4] in (b"\x89PNG", b"RIFF") else b"", f"{path}: {name}")


def _book(part: dict[str, Any]) -> np.ndarray:
    return np.array(part["codebook"], np.float32).reshape(256)


def _higher(path: Path, archive: zipfile.ZipFile, part: dict[str, Any], labels: np.ndarray) -> np.ndarray:
    """(n, k, 3) SH above degree 0 of the palette's entries."""
    name, k = part["files"][0], _COEFFICIENTS[part["bands"]]
    palette = _picture(path, archive, name, MOST_ENTRIES * k)
    if palette.shape[1] != _ROW * k:
        raise InputError(
            f"{path}: {name} is {palette.shape[1]} pixels wide; {part['bands']} bands have {_ROW * k}"
        )
    entries = palette[:, :, :3].reshape(-1, k, 3)
    if len(labels) and labels.max() >= len(entries):
        raise InputError(
            f"{path}: an SH label, {labels.max()}, is none of the palette's {len(entries)} entries"
        )
    return _book(part)[entries[labels]]


def _quaternions(path: Path, pixels: np.ndarray) -> np.ndarray:
    """(n, 4) w, x, y, z: alpha less 252 names the largest, which is left out."""
    largest = pixels[:, 3].astype(np.int64) - 252
    if (largest < 0).any():
        raise InputError(f"{path}: a rotation's alpha is {int(pixels[:, 3].min())}; it must be 252 to 255")
    three = (pixels[:, :3] / 255.0 * 2 - 1) / np.sqrt(2)
    quats = np.zeros((len(pixels), 4))
    for k in range(4):
        rows = largest == k
        quats[np.ix_(rows, [i for i in range(4) if i != k])] = three[rows]
        quats[rows, k] = np.sqrt(np.maximum(0, 1 - (three[rows] ** 2).sum(axis=1)))
    return quats
