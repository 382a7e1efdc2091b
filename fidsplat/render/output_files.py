"""Files of a frame's output images."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from fidsplat.effects import declared_output
from fidsplat.images.files import write_png
from fidsplat.images.visualize import (
    color_counts,
    color_depth,
    color_labels,
    color_normals,
    depth_millimetres,
)
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write
from fidsplat.util.npy import load_npy

_VISUALISATIONS = {
    "color": lambda image: image,
    "depth": color_depth,
    "normal": color_normals,
    "label": color_labels,
    "count": color_counts,
}
"""8-bit visualisation of an output image, by `Output.display`"""


def suffixes_of(name: str) -> tuple[str, ...]:
    """File suffixes of an output in the order of `save_output`; the last is a viewable PNG."""
    output = declared_output(name)
    if output.display == "depth":
        return (".npy", ".png", "-turbo.png")
    return (".npy", ".png") if output.as_array else (".png",)


def save_output(
    name: str, image: np.ndarray, name_of: Callable[[str, str], Path], bits: int | None = None
) -> list[Path]:
    """Write one output image (h, w) or (h, w, 3) and return the files. bits: 16 writes rgb as a 16-bit PNG.
    name_of: function that returns the file for an output's name and a suffix such as ".png"."""
    if name == "rgb" and bits == 16:
        image16 = np.rint(np.clip(np.nan_to_num(image, nan=0.0), 0, 1) * 65535).astype(np.uint16)
        return [write_png(name_of(name, ".png"), image16)]
    arrays = [_write_array(name_of(name, ".npy"), image)] if ".npy" in suffixes_of(name) else []
    if declared_output(name).display == "depth":
        arrays.append(write_png(name_of(name, ".png"), depth_millimetres(image)))
    return [*arrays, write_png(name_of(name, suffixes_of(name)[-1]), visualisation_of(name, image))]


def load_output(file: Path, shape: tuple[int, int]) -> np.ndarray:
    """Read an output image (h, w) that `save_output` wrote as .npy. Raises InputError for an invalid file."""
    try:
        image = load_npy(file)
        if image.shape != shape or image.dtype.kind not in "fi":
            raise ValueError(f"its shape must be {shape}, got {image.shape} of {image.dtype}")
        return image
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {file}: {error}; remove it, and render the image again") from error


def visualisation_of(name: str, image: np.ndarray) -> np.ndarray:
    """8-bit visualisation of an output image, (h, w) or (h, w, 3)."""
    return _VISUALISATIONS[declared_output(name).display](image)


def _write_array(path: Path, array: np.ndarray) -> Path:
    with atomic_write(path) as stream:
        np.save(stream, array)
    return path
