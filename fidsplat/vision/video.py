"""Pictures as a video: H.264 in MP4, by the ffmpeg that imageio-ffmpeg brings."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.errors import InputError
from fidsplat.files import ordinary_file, writable_folder


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
        InputError: as `check_video`; no picture.
    """
    file = check_video(path)
    import imageio_ffmpeg  # type: ignore[import-not-found]

    descriptor, name = tempfile.mkstemp(prefix=f".{file.name}.", suffix=".part.mp4", dir=file.parent)
    os.close(descriptor)
    writer = None
    try:
        for number, picture in enumerate(pictures):
            even = np.pad(picture, ((0, picture.shape[0] % 2), (0, picture.shape[1] % 2), (0, 0)), "edge")
            if writer is None:
                size: Any = even.shape[1::-1]
                encoding: Any = {"fps": rate, "codec": "libx264", "quality": 8, "macro_block_size": 2}
                writer = imageio_ffmpeg.write_frames(name, size, **encoding)
                writer.send(None)
            writer.send(np.ascontiguousarray(even))
            yield number
        if writer is None:
            raise InputError(f"cannot write {file}: there is no picture")
        writer.close()
        writer = None
        os.chmod(name, 0o644)
        os.replace(name, file)
    except OSError as error:
        raise InputError(f"cannot write {file}: {error.strerror or error}") from error
    finally:
        if writer is not None:
            writer.close()
        Path(name).unlink(missing_ok=True)
