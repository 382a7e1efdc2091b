"""Writer of a training data set from photographs with cameras: undistorted images, masks, model and scene
file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.formats.colmap import save_colmap
from fidsplat.images.files import encode_image, read_image, write_png
from fidsplat.images.visualize import resize_to_width
from fidsplat.markers import marker
from fidsplat.photographs.tags import box_of, module_colors
from fidsplat.scenes.parts import PlacedMarker
from fidsplat.scenes.scene import Scene
from fidsplat.train.boxes import EDGE, marker_mask, outside_boxes
from fidsplat.util.files import atomic_write, write_file, write_json
from fidsplat.util.progress import Progress
from fidsplat.vision.undistort import undistort_masked

SPLATS = "splats.ply"
"""file of the trained splats, which the scene files name"""
PHOTOGRAPHS = "photographs.toml"
"""scene file with the camera of most photographs and its lens, to localise other photographs"""
OTHER_PHOTOGRAPHS = "photographs-[0-9]*.toml"
"""pattern of the scene files of further cameras"""
_QUALITY = 95


def write_images(
    folder: Path,
    photos: Path,
    names: Sequence[str],
    cameras: Sequence[Camera],
    tags: Sequence[PlacedMarker],
    max_side: int,
    progress: Progress,
) -> tuple[list[Camera], list[PlacedMarker]]:
    """Write undistorted images of at most `max_side` pixels a side, and masks that exclude tags and pixels
    outside of the photograph.

    Returns the images' cameras, and the tags with the inks of their print.
    """
    undistorted: list[Camera] = []
    inks: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in tags]
    for name, suffix in ("images", ""), ("masks", ".png"):
        (folder / name).mkdir(exist_ok=True)
        for photo in photos.iterdir():  # other files are of the user
            (folder / name / f"{_image_name(photo.name)}{suffix}").unlink(missing_ok=True)
    for number, (name, camera) in enumerate(zip(names, cameras, strict=True)):
        progress("images", number / len(names))
        image, inside = read_image(photos / name), np.ones((camera.height, camera.width), bool)
        if camera.lens is not None:
            image, inside = undistort_masked(image, camera, inside)
        shrink = max_side / max(camera.width, camera.height)
        if shrink < 1:
            image = resize_to_width(image, round(shrink * camera.width))
            inside = resize_to_width(inside[..., None].astype(np.uint8) * 255, image.shape[1]) == 255
        small = scaled(camera, image.shape[1], image.shape[0])
        for tag, colors in zip(tags, inks, strict=True):
            if (measured := module_colors(tag, image, small)) is not None:
                colors.append(measured)
            inside &= ~marker_mask(box_of(tag), small, EDGE)
        target = folder / "images" / _image_name(name)
        kind = "png" if target.suffix == ".png" else "jpeg"
        with atomic_write(target) as stream:
            stream.write(encode_image(image, kind, _QUALITY))
        if not inside.all():
            write_png(folder / "masks" / f"{target.name}.png", inside)
        undistorted.append(small)
    return undistorted, [_printed(tag, colors) for tag, colors in zip(tags, inks, strict=True)]


def _image_name(name: str) -> str:
    """Name of the undistorted image of a photograph: JPEG or PNG."""
    return name if name.endswith((".jpg", ".jpeg")) else f"{Path(name).stem}.png"


def scaled(camera: Camera, width: int, height: int) -> Camera:
    """The camera of a resized image, without its lens."""
    x, y = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * x,
        fy=camera.fy * y,
        cx=camera.cx * x,
        cy=camera.cy * y,
        lens=None,
    )


def _printed(tag: PlacedMarker, colors: Sequence[tuple[np.ndarray, np.ndarray]]) -> PlacedMarker:
    """The tag with the median inks of its photographs."""
    if not colors:
        return tag
    black, white = np.round(np.median(np.array(colors), axis=0), 3)
    print_marker = tag.marker
    return replace(
        tag,
        marker=marker(
            print_marker.spec, print_marker.size, black=tuple(black.tolist()), white=tuple(white.tolist())
        ),
    )


@dataclass(frozen=True)
class Written:
    """Files of a written model."""

    scene: Path
    """scene file of the undistorted images"""
    cameras: tuple[tuple[Path, Camera, int], ...]
    """scene file of each camera of the photographs, the camera, and its number of photographs"""
    renamed: tuple[tuple[Path, Path], ...]
    """edited scene files, and splats that were trained at other poses, with their new names"""


def write_model(
    folder: Path,
    copies: Path,
    names: Sequence[str],
    cameras: Sequence[Camera],
    points: np.ndarray,
    colors: np.ndarray,
    tags: Sequence[PlacedMarker],
    visible: Sequence[Sequence[str]],
    photographed: Sequence[Camera],
) -> Written:
    """Write COLMAP's model of the undistorted images, without points in the boxes of tags, dataset.json with
    these boxes, and scene files with the tags.

    copies: folder for copies of the scene files, which later runs compare with edited ones.
    visible: for each tag the names of the photographs in which it was detected.
    photographed: cameras of the photographs.
    """
    boxes = [box_of(tag) for tag in tags]
    free = outside_boxes(points, boxes)
    table = [
        {"matrix": box.tolist(), "visible": [_image_name(name) for name in photographs]}
        for box, photographs in zip(boxes, visible, strict=True)
    ]
    model = folder / "sparse" / "0"
    files = folder / "dataset.json", model / "images.bin"
    before = [file.read_bytes() if file.is_file() else b"" for file in files]
    write_json(files[0], {"boxes": table})
    save_colmap(model, [_image_name(name) for name in names], cameras, points[free], colors[free])
    renamed = []
    splats = folder / SPLATS
    if splats.exists() and before != [file.read_bytes() for file in files]:
        renamed.append((splats, _renamed(splats)))
    shared: dict[tuple, list[Camera]] = {}
    for camera in photographed:
        shared.setdefault((camera.width, camera.height, camera.fx, camera.fy, camera.lens), []).append(camera)
    groups = sorted(shared.values(), key=len, reverse=True)
    stem, suffix = Path(PHOTOGRAPHS).stem, Path(PHOTOGRAPHS).suffix
    ours = [PHOTOGRAPHS, *(f"{stem}-{i}{suffix}" for i in range(2, len(groups) + 1))]
    scenes = dict(zip(ours, (group[0] for group in groups), strict=True)) | {"scene.toml": cameras[0]}
    copies.mkdir(exist_ok=True)
    for file in {*copies.glob("*.toml"), *(copies / name for name in scenes)}:
        target, old = folder / file.name, file.read_bytes() if file.exists() else b""
        content = b"" if file.name not in scenes else _scene_file(file, scenes[file.name], tags)
        if content == old and target.exists():
            continue  # also if it was edited
        if target.exists() and target.read_bytes() != old:
            renamed.append((target, _renamed(target)))
        if content:
            write_file(target, content)
        else:  # a camera of earlier photographs
            file.unlink()
            target.unlink(missing_ok=True)
    found = tuple((folder / name, group[0], len(group)) for name, group in zip(ours, groups, strict=True))
    return Written(folder / "scene.toml", found, tuple(sorted(renamed)))


def _scene_file(file: Path, camera: Camera, tags: Sequence[PlacedMarker]) -> bytes:
    """Write a scene with tags and the trained splats to a file; returns its content."""
    Scene(camera=camera, markers=tuple(tags)).save(file)
    content = file.read_bytes() + f'\n[[splats]]\nfile = "{SPLATS}"\n'.encode()
    write_file(file, content)
    return content


def _renamed(file: Path) -> Path:
    """Rename a file to a free name; returns the new path."""
    name = (f"{file.stem}.old{'' if i == 1 else i}{file.suffix}" for i in count(1))
    target = next(path for path in (file.with_name(each) for each in name) if not path.exists())
    return file.rename(target)
