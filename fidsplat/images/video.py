"""Pictures as a video: H.264 in MP4, by the ffmpeg that imageio-ffmpeg brings."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_path, ordinary_file, writable_folder


def check_video(path: str | os.PathLike[str]) -> Path:
    """The path of a video that can be written. Asked before long work.

    Raises:
        InputError: another ending than .mp4, a folder that cannot be written, or the extra is missing.
    """
    file = ordinary_file(path)
    if file.suffix.lower() != ".mp4":
        raise InputError(f"videos are written as MP4: name {file.with_suffix('.mp4')}")
    writable_folder(file.parent)
    try:
        import imageio_ffmpeg  # type: ignore[import-not-found]  # noqa: F401
    except ImportError:
        raise InputError("videos need imageio-ffmpeg; pip install 'fidsplat[video]'") from None
    return file


def write_video(path: str | os.PathLike[str], pictures: Iterable[np.ndarray], rate: float) -> Iterator[int]:
    """Write pictures (h, w, 3) uint8 RGB of one size; yields the number of each once it is in.

    The file is whole or not there. Odd sizes get one more row or column, a copy of the last, which H.264
    wants even.

    Raises:
        InputError: as `check_video`; no picture; ffmpeg cannot write, on a full disk say.
    """
    file = check_video(path)
    import imageio_ffmpeg  # type: ignore[import-not-found]

    with atomic_path(file, file.suffix) as part:
        writer, count = None, 0
        try:
            for number, picture in enumerate(pictures):
                even = np.pad(picture, ((0, picture.shape[0] % 2), (0, picture.shape[1] % 2), (0, 0)), "edge")
                if writer is None:
                    size: Any = even.shape[1::-1]
                    encoding: Any = {"fps": rate, "codec": "libx264", "quality": 8, "macro_block_size": 2}
                    writer = imageio_ffmpeg.write_frames(str(part), size, **encoding)
                    writer.send(None)
                writer.send(np.ascontiguousarray(even))
                count += 1
                yield number
        finally:
            if writer is not None:
                writer.close()
        if not count:
            raise InputError(f"cannot write {file}: there is no picture")
        if not _lasts(part, (count - 1) / rate):
            raise InputError(f"cannot write {file}: ffmpeg stopped before its end; is the disk full?")


def _lasts(file: Path, seconds: float) -> bool:
    """Whether a video can be read and is longer than that: ffmpeg that fails at its end says nothing."""
    import imageio_ffmpeg  # type: ignore[import-not-found]

    reader: Any = imageio_ffmpeg.read_frames(str(file))
    try:
        return next(reader)["duration"] > seconds - 0.02  # it is said in hundredths
    except (OSError, RuntimeError, IndexError, StopIteration):
        return False
    finally:
        reader.close()
