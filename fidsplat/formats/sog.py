"""Reading of SOG, PlayCanvas' "Spatially Ordered Gaussians", version 2: a zip of meta.json and lossless WebP
images with a pixel for each splat. Format: developer.playcanvas.com, "The SOG Format".

Positions have 16 bits an axis of sign(p) log(1 + |p|), rotations the three smallest of w, x, y, z in 8 bits;
scales, colours and SH are indices of code books of 256 entries. Axes are those of the source file.
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
"""maximum number of bytes of an image within the zip, and of meta.json"""
SPARE = 2**16
"""pixels that an image may have in addition to one for each splat: writers pad the last rows"""
_ROW = 64  # palette entries in a row of the image of centroids
MAX_ENTRIES = 2**16
"""maximum number of palette entries: labels have 16 bits"""
_SPLAT, _BAND = 160, 28
"""bytes of memory for each splat while a file is read, and for each SH coefficient above degree 0"""
_COEFFICIENTS = {1: 3, 2: 8, 3: 15}


def load_sog(path: Path) -> SplatCloud:
    """Read a .sog file. Raises InputError for a damaged or incomplete file, or another version."""
    try:
        # numbers beyond float32 become splats that are left out
        with (
            np.errstate(over="ignore", invalid="ignore"),
            open_input(path) as stream,
            zipfile.ZipFile(stream) as archive,
        ):
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
        raise InputError(f"{path}: the version of SOG must be 2, got {meta.get('version')!r}")
    count, bands = int(meta["count"]), _COEFFICIENTS[meta["shN"]["bands"]] if "shN" in meta else 0
    check_expansion(path, count * (_SPLAT + _BAND * bands), f"{count:,} splats")

    def pixels(part: str, number: int = 0) -> np.ndarray:
        """Pixels (count, 4) uint8 of an image with a pixel for each splat."""
        name = meta[part]["files"][number]
        found = _image(path, archive, name, count).reshape(-1, 4)
        if not 0 <= count <= len(found):
            raise InputError(f"{path}: {name} must have a pixel for each of {count} splats, got {len(found)}")
        return found[:count]

    low, high = pixels("means", 0)[:, :3].astype(np.uint16), pixels("means", 1)[:, :3].astype(np.uint16)
    lowest, highest = (np.array(meta["means"][end], np.float64).reshape(3) for end in ("mins", "maxs"))
    position = lowest + (highest - lowest) * ((high << 8 | low) / 65535.0)
    means = np.sign(position) * np.expm1(np.abs(position))
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


def _part(path: Path, archive: zipfile.ZipFile, name: str, maximum: int = MAX_PART) -> bytes:
    try:
        info = archive.getinfo(name)
    except KeyError:
        raise InputError(f"{path}: the SOG file lacks {name}") from None
    if info.file_size > maximum:
        raise InputError(f"{path}: {name} must have at most {maximum} bytes, got {info.file_size}")
    return archive.read(info)


def _image(path: Path, archive: zipfile.ZipFile, name: str, count: int) -> np.ndarray:
    """Read an image (h, w, 4) uint8 RGBA of about `count` pixels: a small file can expand to a huge image."""
    from fidsplat.images.files import declared_pixels, decode_rgba  # here, since it imports OpenCV

    data = _part(path, archive, name)
    pixels = declared_pixels(data)
    if pixels > 2 * max(count, 0) + SPARE:
        raise InputError(f"{path}: {name} must have about {count} pixels, got {pixels}")
    return decode_rgba(data if pixels and data[:4] in (b"\x89PNG", b"RIFF") else b"", f"{path}: {name}")


def _book(part: dict[str, Any]) -> np.ndarray:
    return np.array(part["codebook"], np.float32).reshape(256)


def _higher(path: Path, archive: zipfile.ZipFile, part: dict[str, Any], labels: np.ndarray) -> np.ndarray:
    """SH coefficients (n, k, 3) above degree 0, from the palette."""
    name, k = part["files"][0], _COEFFICIENTS[part["bands"]]
    palette = _image(path, archive, name, MAX_ENTRIES * k)
    if palette.shape[1] != _ROW * k:
        raise InputError(
            f"{path}: the width of {name} must be {_ROW * k} pixels for {part['bands']} bands, got "
            f"{palette.shape[1]}"
        )
    entries = palette[:, :, :3].reshape(-1, k, 3)
    if len(labels) and labels.max() >= len(entries):
        raise InputError(
            f"{path}: SH labels must be less than {len(entries)}, the palette's size, got {labels.max()}"
        )
    return _book(part)[entries[labels]]


def _quaternions(path: Path, pixels: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4) w, x, y, z: alpha - 252 is the index of the largest, which is omitted."""
    largest = pixels[:, 3].astype(np.int64) - 252
    if (largest < 0).any():
        raise InputError(f"{path}: the alpha of a rotation must be 252 to 255, got {int(pixels[:, 3].min())}")
    three = (pixels[:, :3] / 255.0 * 2 - 1) / np.sqrt(2)
    quats = np.zeros((len(pixels), 4))
    for k in range(4):
        rows = largest == k
        quats[np.ix_(rows, [i for i in range(4) if i != k])] = three[rows]
        quats[rows, k] = np.sqrt(np.maximum(0, 1 - (three[rows] ** 2).sum(axis=1)))
    return quats
