"""Video writing: H.264 in MP4, with the ffmpeg of imageio-ffmpeg."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.util.errors import InputError, required_package
from fidsplat.util.files import atomic_path, ordinary_file, writable_folder


def check_video(path: str | os.PathLike[str]) -> Path:
    """Validate the path of an output video: suffix, folder and the package imageio-ffmpeg."""
    file = ordinary_file(path)
    if file.suffix.lower() != ".mp4":
        raise InputError(
            f"a video file must have the suffix .mp4, got {file}; use {file.with_suffix('.mp4')}"
        )
    writable_folder(file.parent)
    with required_package("imageio-ffmpeg", "video"):
        import imageio_ffmpeg  # type: ignore[import-not-found]  # noqa: F401
    return file


def write_video(path: str | os.PathLike[str], frames: Iterable[np.ndarray], rate: float) -> Iterator[int]:
    """Write frames (h, w, 3) uint8 RGB of one size; yields the index of each written frame.

    The file is written atomically. H.264 requires even sizes: the last row or column of an odd size is
    duplicated.

    Raises:
        InputError: as `check_video`, or there is no frame, or ffmpeg cannot write, e.g. on a full disk.
    """
    file = check_video(path)
    import imageio_ffmpeg  # type: ignore[import-not-found]

    with atomic_path(file, file.suffix) as part:
        writer, count = None, 0
        try:
            for number, frame in enumerate(frames):
                even = np.pad(frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)), "edge")
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
            raise InputError(f"a video must have at least one frame, got none for {file}")
        if not _is_complete(part, (count - 1) / rate):
            raise InputError(f"cannot write {file}: ffmpeg stopped early; check that the disk has free space")


def _is_complete(file: Path, seconds: float) -> bool:
    """Whether a video is readable and long enough, since ffmpeg reports no error at the end of a file."""
    import imageio_ffmpeg  # type: ignore[import-not-found]

    reader: Any = imageio_ffmpeg.read_frames(str(file))
    try:
        return next(reader)["duration"] > seconds - 0.02  # the duration is rounded to 0.01 s
    except (OSError, RuntimeError, IndexError, StopIteration):
        return False
    finally:
        reader.close()
