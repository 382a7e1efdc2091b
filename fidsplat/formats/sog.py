"""SOG, PlayCanvas' "Spatially Ordered Gaussians": meta.json and lossless WebP images with one pixel per
splat, in a folder or a zip file. Reads versions 1 and 2, writes 2. Format: developer.playcanvas.com, "The SOG
Format".

Positions are sign(p) log(1 + |p|) with 16 bits per axis, rotations the three smallest of w, x, y, z with 8
bits each. Scales, colours and SH are indices into code books of 256 values, in version 1 equidistant values.
Axes are those of the source file.
"""

from __future__ import annotations

import json
import lzma
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.formats.plain import cloud_of, coefficients, neighbour, refuse_boxes, three_scales, world_means
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import with_largest_component
from fidsplat.util.errors import InputError, damaged_data
from fidsplat.util.files import atomic_write, from_json, open_input, read_input, write_file
from fidsplat.util.limits import check_expansion

MAX_PART, MAX_META = 2**30, 2**24
"""maximum size in bytes of an image in the zip file, and of meta.json"""
SPARE = 2**16
"""pixels that an image may have in addition to one per splat, since writers pad the last rows"""
_MAX_SIDE, _ROUNDS = 16383, 20
"""maximum side of a WebP image in pixels; iterations of the code book's optimisation"""
_ROW = 64  # palette entries in a row of the image of centroids
MAX_ENTRIES = 2**16
"""maximum number of palette entries, since labels have 16 bits"""
_SPLAT, _BAND = 160, 28
"""bytes of memory per splat while a file is read, and per SH coefficient above degree 0"""
_COEFFICIENTS = {1: 3, 2: 8, 3: 15}


Parts = Callable[[str, int], bytes]
"""function that returns the content of a file of a scene by its name and maximum size in bytes"""


def load_sog(path: Path) -> SplatCloud:
    """Read a .sog file. Raises InputError for a damaged or incomplete file, or another version."""
    try:
        with open_input(path) as stream, zipfile.ZipFile(stream) as archive:
            return _read(path, lambda name, maximum: _member(path, archive, name, maximum))
    except (zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, EOFError, RuntimeError) as error:
        raise InputError(f"cannot read {path} as SOG: its zip file is damaged ({error})") from None


def load_sog_folder(path: Path) -> SplatCloud:
    """Read a meta.json and the images in its folder. Raises InputError for a damaged or incomplete scene."""
    return _read(path, lambda name, maximum: read_input(neighbour(path, name), maximum))


def _read(path: Path, part: Parts) -> SplatCloud:
    # numbers beyond float32 become invalid splats, which `cloud_of` drops
    with damaged_data(f"{path}: the SOG file"), np.errstate(over="ignore", invalid="ignore"):
        return _cloud(path, part)


def _cloud(path: Path, part: Parts) -> SplatCloud:
    meta = from_json(part(path.name if path.suffix == ".json" else "meta.json", MAX_META))
    version = meta.get("version", 1)
    if version not in (1, 2):
        raise InputError(
            f"{path}: the version of SOG must be 1 or 2, got {version!r}; convert it with splat-transform"
        )
    count = int(meta["count"] if version == 2 else meta["means"]["shape"][0])
    high_sh, palette = meta.get("shN"), None
    if high_sh is not None and version == 1:  # version 1 does not store the number of bands
        palette = _image(path, part, high_sh["files"][0], MAX_ENTRIES * _COEFFICIENTS[3])
        bands = {_ROW * k: degree for degree, k in _COEFFICIENTS.items()}.get(palette.shape[1])
        if bands is None:
            widths = ", ".join(str(_ROW * k) for k in _COEFFICIENTS.values())
            raise InputError(
                f"{path}: the width of the SH palette must be one of {widths}, got {palette.shape[1]}"
            )
        high_sh = high_sh | {"bands": bands}
    k = 0 if high_sh is None else _COEFFICIENTS[high_sh["bands"]]
    check_expansion(path, count * (_SPLAT + _BAND * k), f"{count:,} splats")

    def pixels(name: str, number: int = 0) -> np.ndarray:
        """Pixels (count, 4) uint8 of an image with one pixel per splat."""
        file = meta[name]["files"][number]
        image = _image(path, part, file, count).reshape(-1, 4)
        if not 0 <= count <= len(image):
            raise InputError(f"{path}: {file} must have a pixel for each of {count} splats, got {len(image)}")
        return image[:count]

    low, high = pixels("means", 0)[:, :3].astype(np.uint16), pixels("means", 1)[:, :3].astype(np.uint16)
    lowest, highest = (np.array(meta["means"][end], np.float64).reshape(3) for end in ("mins", "maxs"))
    position = lowest + (highest - lowest) * ((high << 8 | low) / 65535.0)
    means = np.sign(position) * np.expm1(np.abs(position))
    base = pixels("sh0")
    if version == 2:
        log_scales = _book(meta["scales"])[pixels("scales")[:, :3]]
        dc, opacities = _book(meta["sh0"])[base[:, :3]], base[:, 3] / np.float32(255)
    else:
        log_scales = _between(meta["scales"], pixels("scales")[:, :3], 3)
        values = _between(meta["sh0"], base, 4)
        dc, opacities = values[:, :3], 1 / (1 + np.exp(-values[:, 3]))
    sh = dc[:, None].astype(np.float32)
    if high_sh is not None:
        labels = pixels("shN", 1).astype(np.int64)
        entries = _palette(path, part, high_sh, labels[:, 0] | labels[:, 1] << 8, palette)
        rest = _book(high_sh)[entries] if version == 2 else _between(high_sh, entries, 1)
        sh = np.concatenate([sh, rest.astype(np.float32)], axis=1)
    quats = _quaternions(path, pixels("quats"))
    return cloud_of(path, means.astype(np.float32), quats, np.exp(log_scales), opacities, sh)


def _member(path: Path, archive: zipfile.ZipFile, name: str, maximum: int) -> bytes:
    try:
        info = archive.getinfo(name)
    except KeyError:
        raise InputError(f"{path}: a SOG file must have {name}, got none") from None
    if info.file_size > maximum:
        raise InputError(f"{path}: {name} must have at most {maximum} bytes, got {info.file_size}")
    return archive.read(info)


def _image(path: Path, part: Parts, name: str, count: int) -> np.ndarray:
    """Read an image (h, w, 4) uint8 RGBA of about `count` pixels; larger ones are rejected before
    decoding."""
    from fidsplat.images.files import declared_pixels, decode_rgba  # here, since it imports OpenCV

    data = part(name, MAX_PART)
    pixels = declared_pixels(data)
    if pixels > 2 * max(count, 0) + SPARE:
        raise InputError(f"{path}: {name} must have about {count} pixels, got {pixels}")
    return decode_rgba(data if pixels and data[:4] in (b"\x89PNG", b"RIFF") else b"", f"{path}: {name}")


def _between(part: dict[str, Any], bytes_: np.ndarray, columns: int) -> np.ndarray:
    """Decode version 1: equidistant values between the limits of each column."""
    lowest, highest = (np.array(part[end], np.float64).reshape(columns) for end in ("mins", "maxs"))
    return lowest + (highest - lowest) * (bytes_ / 255.0)


def _book(part: dict[str, Any]) -> np.ndarray:
    return np.array(part["codebook"], np.float32).reshape(256)


def _palette(
    path: Path, part: Parts, high_sh: dict[str, Any], labels: np.ndarray, palette: np.ndarray | None
) -> np.ndarray:
    """SH bytes (n, k, 3) above degree 0, looked up in the palette image."""
    name, k = high_sh["files"][0], _COEFFICIENTS[high_sh["bands"]]
    palette = _image(path, part, name, MAX_ENTRIES * k) if palette is None else palette
    if palette.shape[1] != _ROW * k:
        raise InputError(
            f"{path}: the width of {name} must be {_ROW * k} pixels for {high_sh['bands']} bands, got "
            f"{palette.shape[1]}"
        )
    entries = palette[:, :, :3].reshape(-1, k, 3)
    if len(labels) and labels.max() >= len(entries):
        raise InputError(
            f"{path}: SH labels must be less than {len(entries)}, the palette's size, got {labels.max()}"
        )
    return entries[labels]


def _quaternions(path: Path, pixels: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4) w, x, y, z; alpha - 252 is the index of the largest component, which is omitted."""
    largest = pixels[:, 3].astype(np.int64) - 252
    if (largest < 0).any():
        raise InputError(f"{path}: the alpha of a rotation must be 252 to 255, got {int(pixels[:, 3].min())}")
    return with_largest_component((pixels[:, :3] / 255.0 * 2 - 1) / np.sqrt(2), largest)


def save_sog(cloud: SplatCloud, path: Path) -> None:
    """Write a .sog file of version 2. Raises InputError for boxes, an empty cloud, or a file that cannot be
    written."""
    with atomic_write(path) as stream, zipfile.ZipFile(stream, "w") as archive:
        for name, data in sog_parts(cloud).items():
            archive.writestr(zipfile.ZipInfo(name), data)  # a fixed time makes files reproducible


def save_sog_folder(cloud: SplatCloud, path: Path) -> None:
    """Write a meta.json and its images next to it. Raises InputError for boxes, an empty cloud, or a file
    that cannot be written."""
    parts = sog_parts(cloud)
    parts[path.name] = parts.pop("meta.json")  # written last, since it marks a complete scene
    for name, data in parts.items():
        write_file(path.with_name(name), data)


def sog_parts(cloud: SplatCloud) -> dict[str, bytes]:
    """Contents of the files of SOG version 2, by file name: meta.json and images."""
    refuse_boxes(cloud, "a SOG file")
    if not len(cloud):
        raise InputError("a cloud in a SOG file must have at least one splat, got none")
    n, sh = len(cloud), coefficients(cloud)
    means = world_means(cloud).astype(np.float64)
    position = np.sign(means) * np.log1p(np.abs(means))
    lowest, highest = position.min(axis=0), position.max(axis=0)
    extent = np.where(highest > lowest, highest - lowest, 1.0)
    fixed = np.rint((position - lowest) / extent * 65535).astype(np.uint16)
    scales_book, scales = _quantised(np.log(three_scales(cloud).astype(np.float64)))
    color_book, colors = _quantised(sh[:, 0])
    opacities = np.rint(cloud.opacities * 255.0).astype(np.uint8)
    images = {
        "means_l.webp": _pixels(n, (fixed & 255).astype(np.uint8)),
        "means_u.webp": _pixels(n, (fixed >> 8).astype(np.uint8)),
        "quats.webp": _pixels(n, _packed(cloud.quats)),
        "scales.webp": _pixels(n, scales),
        "sh0.webp": _pixels(n, np.column_stack([colors, opacities])),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "fidsplat"},
        "count": n,
        "means": {
            "mins": lowest.tolist(),
            "maxs": (lowest + extent).tolist(),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": scales_book, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book, "files": ["sh0.webp"]},
    }
    if sh.shape[1] > 1:
        k = sh.shape[1] - 1
        entries, labels = _clustered(sh[:, 1:].reshape(n, 3 * k))
        book, codes = _quantised(entries)
        rows = -(-len(entries) // _ROW)
        images["shN_centroids.webp"] = _pixels(len(entries) * k, codes.reshape(-1, 3), (rows, _ROW * k))
        low_high = np.column_stack([labels & 255, labels >> 8, np.zeros(n)]).astype(np.uint8)
        images["shN_labels.webp"] = _pixels(n, low_high)
        bands = int(np.sqrt(k + 1)) - 1
        files = ["shN_centroids.webp", "shN_labels.webp"]
        meta["shN"] = {"count": len(entries), "bands": bands, "codebook": book, "files": files}
    from fidsplat.images.files import encode_webp  # here, since it imports OpenCV

    return {"meta.json": json.dumps(meta).encode()} | {
        name: encode_webp(image) for name, image in images.items()
    }


def _pixels(n: int, values: np.ndarray, shape: tuple[int, int] | None = None) -> np.ndarray:
    """Image (h, w, 4) uint8 whose first n pixels are values (n, 3 or 4); the others are opaque black."""
    width = -(-int(np.ceil(np.sqrt(n))) // 4) * 4
    height, width = shape or (-(-n // width), width)
    if max(height, width) > _MAX_SIDE:
        raise InputError(
            f"a SOG file must have at most {_MAX_SIDE**2:,} splats, got {n:,}; write streamed SOG "
            "(lod-meta.json)"
        )
    image = np.zeros((height * width, 4), np.uint8)
    image[:, 3] = 255
    image[:n, : values.shape[1]] = values
    return image.reshape(height, width, 4)


def _quantised(values: np.ndarray) -> tuple[list[float], np.ndarray]:
    """Code book of 256 numbers, and for each value the index (uint8) of the nearest number: Lloyd's algorithm
    in one dimension."""
    ordered = np.sort(values.astype(np.float64), axis=None)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    rows = np.linspace(0, len(ordered) - 1, 128).astype(int)
    # half of the initial entries at quantiles, half equidistant, so that rare large values have a small error
    book = np.sort(np.concatenate([ordered[rows], np.linspace(ordered[0], ordered[-1], 128)]))
    for _ in range(_ROUNDS):
        ends = np.concatenate([[0], np.searchsorted(ordered, (book[1:] + book[:-1]) / 2), [len(ordered)]])
        counts = np.diff(ends)
        book = np.where(counts > 0, np.diff(sums[ends]) / np.maximum(counts, 1), book)
        book.sort()
    book = book.astype(np.float32).astype(np.float64)
    return book.tolist(), np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)


def _clustered(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Palette of at most 65,536 vectors, and the index of each vector (n, d) in it: median cut, which halves
    each group along its coordinate of largest variance until the palette is full."""
    distinct, inverse = np.unique(vectors, axis=0, return_inverse=True)
    if len(distinct) <= MAX_ENTRIES:
        return distinct, inverse.reshape(-1)
    groups = [np.arange(len(vectors))]
    while len(groups) < MAX_ENTRIES:
        halves = []
        for rows in groups:
            part = vectors[rows]
            axis = int(part.var(axis=0).argmax())
            order, half = np.argpartition(part[:, axis], len(rows) // 2), len(rows) // 2
            halves += [rows[order[:half]], rows[order[half:]]] if half else [rows]
        if len(halves) == len(groups):
            break
        groups = halves
    labels = np.zeros(len(vectors), np.int64)
    means = np.zeros((len(groups), vectors.shape[1]))
    for number, rows in enumerate(groups):
        labels[rows], means[number] = number, vectors[rows].mean(axis=0)
    return means, labels


def _packed(quats: np.ndarray) -> np.ndarray:
    """Encode quaternions w, x, y, z as bytes (n, 4), the inverse of `_quaternions`."""
    q = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(q).argmax(axis=1)
    q = q * np.where(np.take_along_axis(q, largest[:, None], 1) < 0, -1, 1)
    pixels = np.zeros((len(q), 4), np.uint8)
    pixels[:, 3] = 252 + largest
    for k in range(4):
        rows = largest == k
        three = q[np.ix_(rows, [i for i in range(4) if i != k])]
        pixels[rows, :3] = np.rint((three * np.sqrt(2) + 1) / 2 * 255)
    return pixels
