"""Reading and writing of image files: RGB images, one-bit marker images, PNG of colours, depth and labels."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from fidsplat.util.arguments import array_of
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of, read_input, utf8_path, write_file
from fidsplat.util.limits import check_expansion
from fidsplat.util.streams import without_stderr

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm")

_CONTAINERS = (
    *((4, kind) for kind in (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide")),
    (0, b"\x1aE\xdf\xa3"),
    (8, b"AVI "),
)
"""(offset, first bytes) of MP4 and QuickTime, Matroska and WebM, and AVI files"""

_PIXEL = 8
"""bytes of memory per pixel while an image is decoded"""
MAX_BITS = 2**26
"""maximum number of values of a marker image: four channels of 4096 x 4096 modules"""


def read_image(path: str | os.PathLike[str], deep: bool = False) -> np.ndarray:
    """Read an image as (h, w, 3) RGB; grey is converted, alpha is dropped.

    deep: False returns uint8, truncating 16 bits; True returns uint8, uint16 or float32 as stored.

    Raises InputError when the file is missing, is not an image that OpenCV reads, or has other pixels.
    """
    image = _read(path, cv2.IMREAD_COLOR | (cv2.IMREAD_ANYDEPTH if deep else 0))
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise InputError(
            f"the pixels of {path} must be integers of 8 or 16 bits or 32-bit floats, got {image.dtype}"
        )
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_rgba(path: str | os.PathLike[str]) -> np.ndarray:
    """Read an image as (h, w, 4) uint8 RGBA, opaque if the file has no alpha.

    The EXIF orientation is ignored; 16 bits are truncated to 8.
    Raises InputError when the file is missing, or is not an image of 8 or 16 bits.
    """
    image = _read(path, cv2.IMREAD_UNCHANGED)
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"the pixels of {path} must be integers of 8 or 16 bits, got {image.dtype}")
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    return _to_rgba(image, path)


def read_on_background(path: str | os.PathLike[str], background: Sequence[float]) -> np.ndarray:
    """Read an image as (h, w, 3) uint8 RGB; transparent pixels are blended over a background of display
    values."""
    rgba = read_rgba(path)
    if rgba[:, :, 3].min() == 255:
        return rgba[:, :, :3].copy()
    opacity = rgba[:, :, 3:] / 255.0
    over = np.clip(background, 0, 1) * 255 * (1 - opacity)
    return np.rint(rgba[:, :, :3] * opacity + over).astype(np.uint8)


def is_video(path: str | os.PathLike[str]) -> bool:
    """Whether a path is an existing file with the suffix of a video."""
    file = path_of(path)
    return file.suffix.lower() in VIDEO_SUFFIXES and file.is_file()


def read_images(
    path: str | os.PathLike[str], skipped: dict[str, str] | None = None
) -> Iterator[tuple[str, np.ndarray]]:
    """Names and images (h, w, 3) uint8 RGB of a file, of a folder's files sorted by name, or of a video.

    skipped: if given, receives the reason for each file of a folder that cannot be read, by its name.

    Raises InputError if there is no image, or one cannot be read.
    """
    file = path_of(path)
    if file.is_dir():
        names = _image_files(file)
        if not names:
            raise InputError(
                f"{file} must contain an image file, got none; known suffixes are {', '.join(IMAGE_SUFFIXES)}"
            )
        for name in names:
            try:
                image = read_image(name)
            except InputError as error:
                if skipped is None:
                    raise
                skipped[str(name)] = str(error)
                continue
            yield str(name), image
    elif is_video(file):
        yield from _frames(file)
    else:
        yield str(path), read_image(file)


def count_images(path: str | os.PathLike[str]) -> int | None:
    """Number of files that `read_images` reads from a path; None for a video."""
    file = path_of(path)
    return len(_image_files(file)) if file.is_dir() else None if is_video(file) else 1


def _image_files(folder: Path) -> list[Path]:
    """Image files of a folder, sorted by name."""
    return sorted(name for name in folder.iterdir() if name.suffix.lower() in IMAGE_SUFFIXES)


def _frames(file: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Names and frames of a video."""
    head = read_input(file, first=12)
    video = cv2.VideoCapture()
    # FFmpeg selects the demuxer by content, whatever the suffix, and playlists and scripts open other files
    # and addresses; therefore only files of known containers are opened
    if any(word == head[at : at + len(word)] for at, word in _CONTAINERS):
        with _silent_opencv(), utf8_path(file.absolute()) as name:
            video.open(str(name), cv2.CAP_FFMPEG)
    number = 0
    while True:
        with _silent_opencv():
            done, frame = video.read()
        if not done:
            break
        yield f"{file}:{number}", cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
        number += 1
    if not number:
        raise InputError(
            f"cannot read {file} as a video with OpenCV; convert it to MP4 (H.264) or to image files"
        )


def read_bits(path: str | os.PathLike[str]) -> np.ndarray:
    """Read an image with at most two grey levels as (h, w) uint8, 1 = dark.

    The lower of two levels is dark; a single level is dark if it is below half. Transparent pixels are white.

    Raises InputError when the file cannot be read or has colours or more grey levels.
    """
    image = _read(path, cv2.IMREAD_UNCHANGED)
    if image.size > MAX_BITS:
        raise InputError(
            f"a marker image must have one pixel for each module, got {image.shape[1]} x {image.shape[0]} "
            f"pixels in {path}"
        )
    if image.ndim == 2:
        image = image[:, :, None]
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"a marker image must be a one-bit or 8-bit PNG, got {image.dtype} pixels in {path}")
    top = np.iinfo(image.dtype).max
    colors, alpha = image, None
    if image.shape[2] == 4:
        colors, alpha = image[:, :, :3], image[:, :, 3]
        colors = np.where(alpha[:, :, None] == 0, top, colors)
    grey = colors[:, :, 0]
    levels = np.unique(grey)
    if (colors != grey[:, :, None]).any():
        raise InputError(f"a marker image must be black and white, got colours in {path}; threshold it first")
    if len(levels) > 2:
        raise InputError(
            f"a marker image must have at most two grey levels, got {len(levels)} in {path}; use one pixel "
            "for each module, and threshold it without smoothing"
        )
    dark = levels[0] if len(levels) == 2 or levels[0] <= top // 2 else None
    return (grey == dark).astype(np.uint8) if dark is not None else np.zeros(grey.shape, np.uint8)


def pixels_of(image: np.ndarray) -> np.ndarray:
    """Convert an image to an array. Raises InputError for values other than real numbers."""
    return array_of("an image", image, "rows of real numbers")


_BLOCK = 1 << 14
"""values per block: few enough that they stay in a core's cache between the operations"""
_TASK = 16 * _BLOCK
"""values per task of a thread"""
_MIN_TASKS, _THREADS = 8, 4
"""minimum number of tasks for which threads are faster (900 x 800 pixels); maximum number of threads"""


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Convert floats in [0, 1] to uint8, clamped and rounded; bool becomes 0 or 255, uint8 is unchanged."""
    image = pixels_of(image)
    if image.dtype == np.uint8:
        return image
    if image.dtype == bool:
        return image.astype(np.uint8) * 255
    result, values = np.empty(image.shape, np.uint8), image.reshape(-1)
    flat = result.reshape(-1)

    def convert(begin: int) -> None:
        for first in range(begin, min(begin + _TASK, len(values)), _BLOCK):
            part = np.clip(values[first : first + _BLOCK], 0.0, 1.0)
            if np.isnan(part.sum()):  # NaN would become an undefined integer
                part[np.isnan(part)] = 0.0
            part *= 255.0
            flat[first : first + _BLOCK] = np.rint(part, out=part)

    tasks = range(0, len(values), _TASK)
    if len(tasks) < _MIN_TASKS:
        for begin in tasks:
            convert(begin)
    else:
        with ThreadPoolExecutor(min(_THREADS, os.cpu_count() or 1)) as pool:
            for _ in pool.map(convert, tasks):  # raises the error of a task
                pass
    return result


def write_png(path: str | os.PathLike[str], image: np.ndarray) -> Path:
    """Write a PNG file atomically.

    Args:
        path: the file; its folder must exist.
        image: (h, w) or (h, w, 3) RGB; float in [0, 1] (clamped and rounded), uint8, or uint16 (16-bit PNG).

    Raises InputError if the folder is not writable, or for another shape.
    """
    data = encode_png(image)
    write_file(path, data)
    return Path(path)


def encode_png(image: np.ndarray) -> bytes:
    """Content of a PNG file of an image; shapes and errors as for `write_png`."""
    array = pixels_of(image)
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3) or array.size == 0:
        raise InputError(f"the image of a PNG must be (h, w) or (h, w, 3), got {array.shape}")
    pixels = array if array.dtype == np.uint16 else to_uint8(array)
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    # the default level of OpenCV 5 makes images of few colours four times as large
    done, data = cv2.imencode(".png", np.ascontiguousarray(pixels), [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not done:
        raise ValueError(f"OpenCV could not encode an image of shape {array.shape} as PNG")
    return data.tobytes()


def encode_image(image: np.ndarray, kind: str, quality: int = 95) -> bytes:
    """Encode an image (h, w, 3) RGB, float in [0, 1] or uint8, as "jpeg" (quality 0 to 100) or "png"."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if kind == "jpeg" else []
    done, data = cv2.imencode(f".{kind}", cv2.cvtColor(to_uint8(image), cv2.COLOR_RGB2BGR), options)
    if not done:
        raise ValueError(f"OpenCV could not encode an image of shape {image.shape} as {kind}")
    return data.tobytes()


def declared_pixels(data: bytes) -> int:
    """Number of pixels that the header of a PNG, WebP (RFC 9649), JPEG, BMP or TIFF image declares; 0 for
    another file."""
    head = data[:32]
    body = head[20:30]
    if head[:8] == b"\x89PNG\r\n\x1a\n":
        return int.from_bytes(head[16:20], "big") * int.from_bytes(head[20:24], "big")
    if head[:2] == b"BM":
        width, height = (int.from_bytes(head[at : at + 4], "little", signed=True) for at in (18, 22))
        return abs(width * height)
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        if head[12:16] == b"VP8L":  # width - 1 and height - 1 in 14 bits each
            bits = int.from_bytes(body[1:5], "little")
            return ((bits & 0x3FFF) + 1) * ((bits >> 14 & 0x3FFF) + 1)
        if head[12:16] == b"VP8X":  # width - 1 and height - 1 in 24 bits each
            return (int.from_bytes(body[4:7], "little") + 1) * (int.from_bytes(body[7:10], "little") + 1)
        width, height = (int.from_bytes(body[k : k + 2], "little") & 0x3FFF for k in (6, 8))
        return width * height
    if head[:2] == b"\xff\xd8":
        return _jpeg_pixels(data)
    return _tiff_pixels(data) if head[:4] in (b"II*\0", b"MM\0*") else 0


def _jpeg_pixels(data: bytes) -> int:
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        kind, size = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):  # a frame's header
            height, width = (int.from_bytes(data[at + k : at + k + 2], "big") for k in (5, 7))
            return height * width
        at += 1 if kind == 0xFF else 2 + size
    return 0


def _tiff_pixels(data: bytes) -> int:
    def number(at: int, size: int) -> int:
        return int.from_bytes(data[at : at + size], "little" if data[0] == 0x49 else "big")

    first = number(4, 4)
    sides = {}
    for at in range(first + 2, first + 2 + 12 * number(first, 2), 12):
        sides[number(at, 2)] = number(at + 8, 2 if number(at + 2, 2) == 3 else 4)  # a short, or a long
    return sides.get(256, 0) * sides.get(257, 0)


def _check_size(data: bytes, name: str | os.PathLike[str]) -> None:
    """Raise InputError for an image that declares more pixels than `input_limit` allows, or for a PNG that
    declares a chunk longer than the file, for which libpng would allocate memory."""
    at, png = 8, data[:8] == b"\x89PNG\r\n\x1a\n"
    while png and at + 8 <= len(data) and data[at + 4 : at + 8] != b"IEND":
        length = int.from_bytes(data[at : at + 4], "big")
        if length > len(data):
            raise InputError(
                f"cannot read {name}: a PNG must have chunks within its {len(data):,} "
                f"bytes, got one of {length:,}; give a complete PNG file"
            )
        at += 12 + length
    pixels = declared_pixels(data)
    check_expansion(os.fspath(name), _PIXEL * pixels, f"{pixels:,} pixels", len(data))


def decode_rgb(content: bytes) -> np.ndarray:
    """Decode a file's content to (h, w, 3) uint8 RGB. Raises InputError for content that is not an image or
    exceeds `input_limit`."""
    image = _decode(content, "a compressed image", cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(
            f"a compressed image must be a JPEG or PNG, got {len(content):,} bytes, {content[:8]!r}..."
        )
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def encode_webp(image: np.ndarray) -> bytes:
    """Lossless WebP of an image (h, w, 4) uint8 RGBA; colours of transparent pixels may change."""
    quality = [cv2.IMWRITE_WEBP_QUALITY, 101]
    return cv2.imencode(".webp", cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA), quality)[1].tobytes()


def decode_rgba(data: bytes, name: str) -> np.ndarray:
    """Decode an image file's content to (h, w, 4) uint8 RGBA, alpha 255 if it has none. name: for errors."""
    image = _decode(data, name, cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint8:
        raise InputError(f"{name} must be an image with 8 bits per channel, got other data")
    return _to_rgba(image, name)


def _to_rgba(image: np.ndarray, name: str | os.PathLike[str]) -> np.ndarray:
    """Convert a decoded image, grey, BGR or BGRA, to RGBA."""
    conversions = {1: cv2.COLOR_GRAY2RGBA, 3: cv2.COLOR_BGR2RGBA, 4: cv2.COLOR_BGRA2RGBA}
    channels = 1 if image.ndim == 2 else image.shape[2]
    if channels not in conversions:
        raise InputError(f"{name} must have 1, 3 or 4 channels, got {channels}; convert it to RGB or RGBA")
    return cv2.cvtColor(image, conversions[channels])


def _read(path: str | os.PathLike[str], flags: int) -> np.ndarray:
    data = read_input(path)
    image = _decode(data, path, flags)
    if image is None:
        known = "it is truncated or damaged; copy it again" if declared_pixels(data) else ""
        known = known if data else "it is empty; copy it again"
        raise InputError(
            f"cannot read {path} as an image; {known or 'give a PNG, JPEG, BMP, TIFF or WebP file'}"
        )
    return image


def _decode(data: bytes, name: str | os.PathLike[str], flags: int) -> np.ndarray | None:
    """Decode an image; None if OpenCV cannot. Raises InputError for an image that is too large."""
    _check_size(data, name)
    with _silent_opencv(), contextlib.suppress(cv2.error):  # OpenCV raises above its own limit of pixels
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    return None


@contextlib.contextmanager
def _silent_opencv() -> Iterator[None]:
    """Discard messages of OpenCV, libpng and FFmpeg on stderr about a damaged file, which our error
    reports."""
    if hasattr(cv2, "setLogLevel"):  # OpenCV 4
        read, write = cv2.getLogLevel, cv2.setLogLevel  # type: ignore[attr-defined]
    else:
        read, write = cv2.utils.logging.getLogLevel, cv2.utils.logging.setLogLevel
    before = read()
    write(0)
    try:
        with without_stderr():
            yield
    finally:
        write(before)
