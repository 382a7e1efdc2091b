"""Pipeline from photographs to a metric data set; the folder `work` has the completed steps."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fidsplat.markers import marker
from fidsplat.photographs.adjustment import Adjustment, adjust
from fidsplat.photographs.dataset import (
    OTHER_PHOTOGRAPHS,
    PHOTOGRAPHS,
    Written,
    scaled,
    write_images,
    write_model,
)
from fidsplat.photographs.frame import WorldFrame, leaning, world_frame
from fidsplat.photographs.mapping import (
    Model,
    extract,
    map_incrementally,
    match,
    read_model,
    require_pycolmap,
    unregistered,
)
from fidsplat.photographs.photos import camera_groups, copy_frames, copy_photos, name_key, source_files
from fidsplat.photographs.picks import parse_scale, scale_of
from fidsplat.photographs.rolling_shutter import MIN_DISPLACEMENT, MIN_FRACTION, readout_motion
from fidsplat.photographs.settings import CaptureSettings
from fidsplat.photographs.tags import detect_tags, parse_tags, same_tag
from fidsplat.scenes.parts import PlacedMarker
from fidsplat.util.errors import InputError, unknown
from fidsplat.util.files import from_json, path_of, read_text, writable_folder, write_json
from fidsplat.util.progress import Progress, no_progress

INPUTS = "inputs.json"
SKIPPED = "skipped.json"
"""file in `work` with the photographs that cannot be read, each with the reason"""
SCENES = "scenes"
"""folder in `work` with copies of the scene files"""
WRITTEN = "written"
"""empty file in `work` once OUTPUTS are of this command"""
OUTPUTS = "images", "masks", "sparse", "dataset.json", "scene.toml", PHOTOGRAPHS


MIN_POINTS, MAX_CORNERS, MAX_SCALE_ERROR, MAX_LEANING = 20, 1.0, 0.005, math.radians(10)
"""limits of a reliable model: points for each photograph; error of tags' corners in pixels, and beyond twice
the features' error; standard error of the scale; angle between the verticals of --up and of the cameras"""


@dataclass(frozen=True, eq=False)
class Captured:
    """A data set made from photographs."""

    files: Written
    photographs: int
    model: Model
    frame: WorldFrame
    adjustment: Adjustment | None
    tags: tuple[PlacedMarker, ...]
    undetected: tuple[str, ...]
    """specs of tags that no photograph contains"""
    missing: tuple[tuple[str, str], ...]
    """photographs without a camera, each with the reason"""
    scale_error: float | None
    """relative standard error of the scale; None if lengths are not in metres"""
    readout: float
    """displacement of rows by motion during the readout [px]; 0 unless a rolling shutter is likely"""
    lean: float
    """angle [rad] between the vertical and that of the cameras' horizontal axes"""

    @property
    def doubts(self) -> list[str]:
        """Reasons to doubt the cameras, the scale or the vertical."""
        doubts, points = [], len(self.model.points)
        cameras = "the cameras may be wrong: {}; take more photographs, with more overlap"
        if points < MIN_POINTS * len(self.model.names):
            doubts.append(cameras.format(f"only {points} points in {len(self.model.names)} photographs"))
        if self.adjustment is not None:
            rms = self.adjustment.rms
            if rms > max(MAX_CORNERS, 2 * self.model.reprojection):
                doubts.append(cameras.format(f"corners of tags are {rms:.1f} px from their projections"))
        if self.scale_error is not None and self.scale_error > MAX_SCALE_ERROR:
            doubts.append(
                f"the scale has a standard error of {100 * self.scale_error:.2g} %; take more photographs of "
                "the tags, or pick points far from each other"
            )
        if self.lean > MAX_LEANING:
            doubts.append(
                f"the vertical of --up is {math.degrees(self.lean):.0f} degrees from that of the cameras; "
                "give a tag that is upright on a wall, or flat"
            )
        return doubts


def photographs_to_scene(
    source: str | Path,
    out: str | Path,
    settings: CaptureSettings | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> Captured:
    """Make a metric data set for training, and a scene file with the tags, from photographs.

    Args:
        source: a folder of photographs, or a video.
        out: folder. Finished steps in its folder `work` are not repeated for the same photographs.
        progress: called with the current step and its fraction done.
        overwrite: restart, also for other photographs.

    Raises InputError if a photograph cannot be read, if too few can be registered, or if tags contradict.
    """
    settings, report = settings or CaptureSettings(), progress or no_progress
    tags = parse_tags(settings.tag)
    up = None if settings.up is None else same_tag(tags, marker(settings.up, 1.0))
    if settings.up is not None and up is None:
        raise InputError(f"--up must be a tag of --tag, got {settings.up}; give its size by --tag too")
    picks = None if settings.scale is None else parse_scale(settings.scale)
    pycolmap = require_pycolmap()
    files = source_files(path_of(source))
    video, names = len(files) == 1, {name_key(file.name): file.name for file in files}
    if picks is not None and not video:
        for name, _, _ in picks[:2]:
            if name_key(name) not in names:
                raise InputError(unknown("photograph of --scale", name, names.values()))
    folder = writable_folder(out)
    _refuse_foreign(folder, files, overwrite)
    work = _work_folder(folder, files, settings, overwrite)

    def prepare(part: Path) -> None:
        if video:
            copy_frames(files[0], part, settings.frames, report)
        else:
            write_json(work / SKIPPED, copy_photos(files, part, report))

    photos, database = _step(work / "photos", prepare), work / "database.db"
    with _completed(work):
        skipped = [] if video else from_json(read_text(work / SKIPPED))
        groups = camera_groups(photos)
        count = sum(map(len, groups)) + len(skipped)
        if not video and count != len(files):
            raise ValueError(f"{count} of {len(files)} photographs")
        pycolmap.Database.open(database).close()
    if not (work / "model").exists():
        extract(database, photos, groups, settings.lens, report)
        match(database, video, report)
        model = map_incrementally(database, photos, work / "model", report)
    else:
        with _completed(work):
            model = read_model(work / "model")
    adjustment, picked_error = None, None
    pinholes = [scaled(camera, camera.width, camera.height) for camera in model.cameras]
    if tags:
        views = detect_tags(photos, model.names, model.cameras, tags, report)
        adjustment = adjust(pinholes, views, {spec: made.size for spec, made in tags.items()})
        first = next(iter(adjustment.poses)) if up is None else up.spec
        if first not in adjustment.poses:
            raise InputError(
                f"--up must be a tag in the photographs, got {first}, which was not detected; detected are "
                f"{', '.join(adjustment.poses)}"
            )
        frame = world_frame(pinholes, adjustment.scale, adjustment.poses[first], up is not None)
        placed = [
            PlacedMarker(tags[spec], frame.pose(pose), label=i + 1)
            for i, (spec, pose) in enumerate(adjustment.poses.items())
        ]
    else:
        placed = []
        scale, picked_error = (1.0, None) if picks is None else scale_of(model, *picks)
        frame = world_frame(pinholes, scale, middle=np.median(model.points, axis=0))
    cameras = [frame.camera(camera) for camera in model.cameras]
    (work / WRITTEN).touch()
    small, placed = write_images(folder, photos, model.names, cameras, placed, settings.max_side, report)
    used = () if adjustment is None else adjustment.used
    visible = [[model.names[view.image] for view in used if view.tag == tag.marker.spec] for tag in placed]
    points = frame.points(model.points)
    written = write_model(
        folder, work / SCENES, model.names, small, points, model.colors, placed, visible, cameras
    )
    missing = [(name, reason) for name, reason in skipped]
    missing += [(names.get(name_key(name), name), why) for name, why in unregistered(database, model.names)]
    fraction, displaced = readout_motion(model)
    readout = displaced if fraction > MIN_FRACTION and displaced > MIN_DISPLACEMENT else 0.0
    undetected = tuple(spec for spec in tags if adjustment is None or spec not in adjustment.poses)
    return Captured(
        written,
        count,
        model,
        frame,
        adjustment,
        tuple(placed),
        undetected,
        tuple(missing),
        picked_error if adjustment is None else adjustment.scale_error,
        readout,
        0.0 if up is None else leaning(pinholes, frame.rotation[2]),
    )


@contextmanager
def _completed(work: Path) -> Iterator[None]:
    """Convert errors within the block, which reads completed steps, to an InputError with the remedy."""
    try:
        yield
    except (ValueError, RuntimeError, LookupError) as error:
        raise InputError(f"{work} is damaged ({error}); --overwrite restarts") from error


def _step(folder: Path, make: Callable[[Path], None]) -> Path:
    """Run a step, unless its folder exists; the folder is renamed to its final name after the step."""
    if not folder.exists():
        part = folder.with_name(f".{folder.name}.part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        make(part)
        part.rename(folder)
    return folder


def _refuse_foreign(folder: Path, files: list[Path], overwrite: bool) -> None:
    """Raise InputError if the capture would replace the photographs, or files that it did not write."""
    work = folder / "work"
    # of links: the folder of the link, and that of its target
    folders = {place for file in files for place in (file.parent.resolve(), file.resolve().parent)}
    sources = {parent for place in folders for parent in (place, *place.parents)}
    for path in (work, *(folder / name for name in OUTPUTS), *folder.glob(OTHER_PHOTOGRAPHS)):
        if path.is_dir() and any(parent.samefile(path) for parent in sources):
            raise InputError(
                f"photographs must be outside of {path}, which is replaced, got {files[0]}; give another "
                "folder with -o"
            )
        mark = INPUTS if path == work else WRITTEN
        empty = path == work and path.is_dir() and not any(path.iterdir())  # interrupted at the start
        if path.exists() and not (overwrite or empty or (work / mark).exists()):
            raise InputError(
                f"{folder} must be a new folder or of an earlier capture, got {path.name} of something "
                "else; give another folder, or --overwrite to replace it"
            )


def _work_folder(folder: Path, files: list[Path], settings: CaptureSettings, overwrite: bool) -> Path:
    """The folder of completed steps. Raises InputError if it belongs to other photographs."""
    work = folder / "work"
    stats = [[file.name, file.stat().st_size, file.stat().st_mtime_ns] for file in files]
    inputs = {"files": stats, "lens": settings.lens, "frames": settings.frames if len(files) == 1 else None}
    if overwrite:
        for path in (*work.glob("*"), folder / "images", folder / "masks"):
            if path.is_dir() and path.name != SCENES:
                shutil.rmtree(path, ignore_errors=True)
            elif path.is_file():
                path.unlink()
    work.mkdir(exist_ok=True)
    if overwrite:
        (work / WRITTEN).touch()
    known = work / INPUTS
    with _completed(work):
        same = known.exists() and from_json(read_text(known)) == inputs
    if not (work / "photos").exists():
        write_json(known, inputs)
    elif not same:
        raise InputError(
            f"{folder} must be a new folder or of the same photographs and lens, got others; give another "
            "folder, or --overwrite"
        )
    return work
