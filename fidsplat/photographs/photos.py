"""Photographs for structure from motion: upright copies of image files, or frames of a video."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fidsplat.images.exif import read_exif, with_exif
from fidsplat.images.files import (
    IMAGE_SUFFIXES,
    VIDEO_SUFFIXES,
    declared_pixels,
    encode_image,
    is_video,
    read_image,
    read_images,
)
from fidsplat.util.errors import InputError
from fidsplat.util.files import read_input
from fidsplat.util.progress import Progress
from fidsplat.vision.video_frames import choose_frames, measure_frames

MIN_PHOTOS = 3
OTHER_SUFFIXES = (
    *(".heic", ".heif", ".avif", ".jxl", ".jp2", ".gif"),
    *(".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"),
)
"""suffixes of photographs that OpenCV does not read; they are reported instead of ignored"""
_QUALITY = 97


def source_files(source: Path) -> list[Path]:
    """Image files of a folder, or a video. Raises InputError for anything else, or too few images."""
    if is_video(source):
        return [source]
    if not source.is_dir():
        raise InputError(
            f"PHOTOS must be a folder of images, or a video ({', '.join(VIDEO_SUFFIXES)}), got {source}"
        )
    files = sorted(
        file
        for file in source.iterdir()
        if file.suffix.lower() in (*IMAGE_SUFFIXES, *OTHER_SUFFIXES) and not file.name.startswith(".")
    )
    if len(files) < MIN_PHOTOS:
        below = any(file.suffix.lower() in IMAGE_SUFFIXES for file in source.glob("*/*"))
        remedy = (
            "put the photographs of its subfolders into one folder"
            if below
            else "take 20 to 200 of the scene, each overlapping the one before by two thirds"
        )
        raise InputError(
            f"a capture must have at least {MIN_PHOTOS} photographs, got {len(files)} in {source}; {remedy}"
        )
    return files


def copy_photos(files: Sequence[Path], folder: Path, progress: Progress) -> list[tuple[str, str]]:
    """Copy photographs into a folder, rotated upright by their EXIF orientation, under names without blanks.
    Files other than JPEG become PNG, since COLMAP reads no WebP.

    Returns the names of skipped files, which cannot be read, each with the reason.

    Raises InputError if fewer than MIN_PHOTOS can be read, or for two names with one `name_key`.
    """
    names: dict[str, str] = {}
    skipped: list[tuple[str, str]] = []
    for number, file in enumerate(files):
        progress("photographs", number / len(files))
        try:
            data = read_input(file)
            if data and not declared_pixels(data):
                raise InputError(
                    f"cannot read {file} as an image; convert it to JPEG"
                    if file.suffix.lower() in OTHER_SUFFIXES
                    else f"cannot read {file} as an image; give a PNG, JPEG, BMP, TIFF or WebP file"
                )
            image, key = read_image(file), name_key(file.name)
        except InputError as error:
            skipped.append((file.name, str(error)))
            continue
        exif, suffix = read_exif(data), file.suffix.lower()
        if suffix not in (".jpg", ".jpeg"):
            data, suffix = encode_image(image, "png"), ".png"
        elif exif.orientation != 1:
            data = with_exif(encode_image(image, "jpeg", _QUALITY), exif)
        if key in names:  # their undistorted images would replace each other
            raise InputError(
                "photographs must have names that differ before the suffix by more than case, got "
                f"{names[key]} and {file.name}; rename or remove one"
            )
        names[key] = file.name
        (folder / f"{'_'.join(file.stem.split())}{suffix}").write_bytes(data)
    if skipped and len(names) < MIN_PHOTOS:
        raise InputError(
            f"a capture must have at least {MIN_PHOTOS} photographs that can be read, got {len(names)} of "
            f"{len(files)}: {skipped[0][1]}"
        )
    return skipped


def name_key(name: str) -> str:
    """Key that a photograph and its copy share: the name without suffix, in lower case, "_" for blanks."""
    return "_".join(Path(name).stem.split()).lower()


def copy_frames(video: Path, folder: Path, count: int, progress: Progress) -> tuple[int, int]:
    """Write the chosen frames of a video; returns the numbers of frames and of chosen ones.

    Raises InputError if too few frames differ.
    """
    measured = []
    for values in measure_frames(frame for _, frame in read_images(video)):
        measured.append(values)
        progress(f"choosing frames, {len(measured)} measured", 0.0)
    sharpness, motion = np.array(measured).T
    chosen = choose_frames(sharpness, motion, count)
    if len(chosen) < MIN_PHOTOS:
        raise InputError(
            f"a video must show the scene from different positions, got {len(chosen)} different of "
            f"{len(measured)} frames; move the camera sideways around the scene"
        )
    wanted = set(chosen)
    for number, (_, frame) in enumerate(read_images(video)):
        progress("frames", number / len(measured))
        if number in wanted:
            (folder / f"frame-{number:06d}.jpg").write_bytes(encode_image(frame, "jpeg", _QUALITY))
    return len(measured), len(chosen)


def camera_groups(folder: Path) -> list[list[str]]:
    """Names of photographs by camera: photographs of equal size and focal length share one."""
    groups: dict[tuple, list[str]] = {}
    for file in sorted(folder.iterdir()):
        data = read_input(file)
        groups.setdefault((_size(file, data), read_exif(data).focal_length), []).append(file.name)
    return list(groups.values())


def _size(file: Path, data: bytes) -> tuple[int, int]:
    height, width = read_image(file).shape[:2]
    return width, height
