"""Test bench of tag detectors: which cause breaks which detector, at which severity."""

from __future__ import annotations

import importlib
import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from fidsplat.experiments.run import device_name, results_of
from fidsplat.experiments.settings import ShardSettings
from fidsplat.experiments.sweep import Key, Record, Sweep, Work, shard, thread_pool
from fidsplat.experiments.tag_causes import (
    CAPTURED,
    CAUSES,
    GREENHOUSE,
    SCENES,
    MarkerView,
    scene_of,
    view_of,
)
from fidsplat.images.files import write_png
from fidsplat.images.filters import defocused, grey_of
from fidsplat.markers.spec import Detector
from fidsplat.render.renderer import Renderer
from fidsplat.util.arguments import whole_number
from fidsplat.util.errors import InputError, unknown
from fidsplat.util.files import read_text, writable_folder, write_file
from fidsplat.vision.bop import BopScene
from fidsplat.vision.coco import CocoAnnotations
from fidsplat.vision.detect import detect
from fidsplat.vision.pose import marker_pose, pose_error
from fidsplat.vision.readers import TITLES, Attempt, Target, attempt, attempt_of, missing_readers, readers
from fidsplat.vision.truth import truth_of

QUICK_STEPS, QUICK_VIEWS = 2, 3
STEPS, VIEWS = 10, 24


@dataclass(frozen=True)
class TagSettings(ShardSettings):
    """Scenes, causes, families and detectors of the test bench."""

    out: Path | None = None
    """Folder for results. By default fidsplat-tags, with --quick fidsplat-tags-quick."""
    quick: bool = False
    """Measure two severities of each cause in three views, in minutes."""
    scene: tuple[str, ...] = ()
    """Scene: greenhouse, biker or playbot. By default greenhouse and biker; repeat for several."""
    cause: tuple[str, ...] = ()
    """Cause of failures. By default all; repeat for several."""
    family: tuple[str, ...] = ()
    """Family: apriltag:36h11, aruco:4x4_50 or qr. By default all; repeat for several."""
    detector: tuple[str, ...] = ()
    """Detector, or module:function for your own; repeat for several. By default all installed ones."""
    severities: int | None = None
    """Number of severities from 0 to 1, without 0. By default 10, with --quick 2."""
    views: int | None = None
    """Number of views of each severity. By default 24, with --quick 3."""
    device: str | None = None
    """D: device; see `fidsplat devices` (default: FIDSPLAT_DEVICE, or auto)"""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of threads that detect. By default one per core."""

    @property
    def folder(self) -> Path:
        return self.out or Path("fidsplat-tags" + ("-quick" if self.quick else ""))

    @property
    def steps(self) -> list[float]:
        """Severities above 0 at which each cause is measured."""
        count = self.severities or (QUICK_STEPS if self.quick else STEPS)
        return [round((k + 1) / count, 6) for k in range(count)]

    @property
    def view_count(self) -> int:
        return self.views or (QUICK_VIEWS if self.quick else VIEWS)

    def check(self) -> None:
        """Raise InputError for numbers out of range."""
        for name, highest in (("severities", 1000), ("views", 100_000), ("workers", 1024)):
            if getattr(self, name) is not None:
                whole_number(f"--{name}", getattr(self, name), 1, highest)


NAME = "tags"
NONE = "none"
"""name of the point without a cause, which is severity 0 of all causes"""
FAMILIES = {"apriltag:36h11": "apriltag:36h11:5", "aruco:4x4_50": "aruco:4x4_50:7", "qr": "qr:fidsplat"}
"""spec of the rendered marker by family"""
OWN = "fidsplat"
"""name of fidsplat's `detect` among the detectors"""
SLOW = "zxing-tall"
"""detector that is measured only on request, since it takes a second for an unreadable image"""
Errors = list[float] | None
"""corner error [pixels, RMS], rotation [degrees], translation [% of the distance]; None: not read"""


def check(options: TagSettings) -> None:
    """Raise InputError for invalid settings."""
    for name, known in (("scene", SCENES), ("cause", CAUSES), ("family", FAMILIES)):
        for text in getattr(options, name):
            if text not in known:
                raise InputError(unknown(name, text, known))
    options.check()
    points_of(options)


def points_of(options: TagSettings) -> list[Key]:
    """Points (scene, family, cause, severity) of this shard; those without degradation come first.

    Raises InputError for detectors that cannot be used.
    """
    chosen = [(NONE, 0.0)]
    chosen += [(cause, severity) for cause in options.cause or CAUSES for severity in options.steps]
    families = options.family or tuple(FAMILIES)
    names = {family: list(detectors_of(family, options.detector)) for family in families}
    every = [
        {
            "scene": scene,
            "family": family,
            "cause": cause,
            "severity": severity,
            "views": options.view_count,
            "detectors": names[family],
        }
        for cause, severity in chosen
        for scene in options.scene or (GREENHOUSE, next(iter(CAPTURED)))
        for family in families
        if names[family]
    ]
    if not every:
        raise InputError(
            f"--detector must read one of {', '.join(families)}, got {', '.join(options.detector)}"
        )
    return shard(every, options.shard)


def detectors_of(
    family: str, names: Sequence[str] = ()
) -> dict[str, Callable[[np.ndarray, Target], Attempt]]:
    """Detectors of a family by name, as functions of a grey image and its target.

    names: detectors to use; module:function is the user's own. By default all installed ones except `SLOW`.

    Raises InputError for an unknown name, a missing package, or a function that cannot be imported.
    """
    kind, _, dictionary = family.partition(":")
    detectors: dict[str, Callable[[np.ndarray, Target], Attempt]] = {
        name: partial(attempt, name) for name in readers(kind, dictionary or None)
    }
    detectors[OWN] = partial(
        attempt_with,
        lambda grey: [
            (detection.name, detection.corners)
            for detection in detect(grey, (family,) if dictionary else (), not dictionary)
        ],
    )
    if not names:
        return {name: function for name, function in detectors.items() if name != SLOW}
    every = {OWN, *TITLES}
    for name in names:
        if ":" in name:
            detectors[name] = partial(attempt_with, load_detector(name))
        elif name in missing_readers():
            package = missing_readers()[name]
            raise InputError(
                f"{package} must be installed for the detector {name}, got none; pip install {package}"
            )
        elif name not in every:
            raise InputError(unknown("detector", name, every) + "; or module:function for your own")
    return {name: detectors[name] for name in names if name in detectors}


def load_detector(text: str) -> Detector:
    """Import the function module:function from the path or the working folder. It maps (h, w) uint8 to pairs
    of spec and corners (4, 2) of each detected code. Raises InputError if it cannot be imported."""
    module, _, name = text.partition(":")
    if "" not in sys.path:
        sys.path.insert(0, "")
    try:
        function = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(
            f"--detector must be module:function that can be imported, got {text!r}: {error}"
        ) from error
    if not callable(function):
        raise InputError(f"--detector must name a function, got {text!r}, a {type(function).__name__}")

    def checked(grey: np.ndarray) -> list[tuple[str, np.ndarray]]:
        try:
            found = cast(Detector, function)(grey.copy())  # a detector may write into its image
            return [(str(spec), np.reshape(quad, (4, 2))) for spec, quad in found]
        except Exception as error:
            raise InputError(
                f"--detector {text} must return pairs of a spec and corners (4, 2), got "
                f"{type(error).__name__}: {error}"
            ) from error

    return checked


def attempt_with(function: Detector, grey: np.ndarray, target: Target) -> Attempt:
    """Attempt of a detector that returns pairs of spec and corners."""
    expected = target.payload if target.id is None else target.id
    spec = f"{target.kind}:{expected if target.id is None else f'{target.family}:{expected}'}"
    pairs = (
        (expected if name == spec else None, np.asarray(quad, np.float64)) for name, quad in function(grey)
    )
    return attempt_of(pairs, target)


@contextmanager
def tag_sweep(options: TagSettings) -> Iterator[Sweep]:
    """Sweep of the test bench.

    Raises InputError for invalid options, DeviceError if the device cannot be opened.
    """
    check(options)
    points = points_of(options)
    for scene in {point["scene"] for point in points}:
        scene_of(scene)  # reports download errors before a device is opened
    renderer = Renderer(options.device)
    results = results_of(NAME, options, device_name(renderer))
    begin = partial(begin_point, renderer=renderer, seed=options.seed, names=options.detector)
    with thread_pool(options.workers) as pool:
        yield Sweep(NAME, results, points, begin, options.workers, pool, overlap=True)


def views_of(key: Key, seed: int) -> list[MarkerView]:
    """Test images of a measurement, with its cause applied."""
    spec, cause = FAMILIES[key["family"]], key["cause"]
    views = [view_of(key["scene"], spec, f"{seed} {key['scene']} {k}") for k in range(key["views"])]
    return views if cause == NONE else [CAUSES[cause].apply(view, key["severity"]) for view in views]


def begin_point(key: Key, renderer: Renderer, seed: int, names: Sequence[str] = ()) -> Work:
    """Render the views of a point; returns the function that detects their markers."""
    shots = []
    for view in views_of(key, seed):
        frame = renderer.render(view.complete_scene, view.complete_capture)
        shots.append((view, grey_of(defocused(frame.to_uint8(), view.defocus))))
    return partial(_detect, key, shots, detectors_of(key["family"], names))


def _detect(
    key: Key,
    shots: Iterable[tuple[MarkerView, np.ndarray]],
    detectors: dict[str, Callable[[np.ndarray, Target], Attempt]],
) -> dict[str, Any]:
    """Errors of each view by detector, as `Errors`."""
    errors: dict[str, list[Errors]] = {name: [] for name in key["detectors"]}
    for view, grey in shots:
        printed, camera = view.placed.marker, view.camera
        corners = camera.project(view.placed.corners)
        target = Target(printed.kind, printed.family or "", printed.id, printed.payload, corners)
        for name in errors:
            errors[name].append(errors_of(detectors[name](grey, target).corners, view))
    return {"errors": errors}


def errors_of(corners: np.ndarray | None, view: MarkerView) -> Errors:
    """Errors of detected corners (4, 2); None without corners or pose."""
    if corners is None:
        return None
    camera, placed = view.camera, view.placed
    truth = camera.world_to_camera @ placed.pose
    pixels = float(np.sqrt(((corners - camera.project(placed.corners)) ** 2).sum(1).mean()))
    pose = marker_pose(corners, placed.marker.size, camera)
    if not np.isfinite(pose).all():
        return None
    metres, radians = pose_error(pose, truth)
    return [pixels, math.degrees(radians), 100 * metres / float(np.linalg.norm(truth[:3, 3]))]


def write_labels(options: TagSettings, folder: Path) -> Iterator[Path]:
    """Write images and ground truth of all points; yields the folder of each point.

    FOLDER/train/000000 and so on are scenes of a BOP data set, each with a `coco.json` and its point in
    `point.json`; with a lens, which BOP lacks, only COCO annotations are written. Existing folders of the
    same points are unchanged.

    Raises InputError if the folder of a point has another point.
    """
    renderer = Renderer(options.device)
    every = points_of(replace(options, shard=None))
    for key in points_of(options):
        place = writable_folder(folder / "train" / f"{every.index(key):06d}")
        yield _write_point(key, place, renderer, options.seed)


def _write_point(key: Key, folder: Path, renderer: Renderer, seed: int) -> Path:
    done = folder / "point.json"
    point = json.dumps({name: key[name] for name in key if name != "detectors"} | {"seed": seed})
    if done.is_file():
        if read_text(done) != point:
            raise InputError(
                f"{done} must have the point {point}, got another one; repeat the earlier options, "
                "or give another folder"
            )
        return folder
    (folder / "scene_gt.json").unlink(missing_ok=True)  # of an interrupted run
    coco, bop = CocoAnnotations(), BopScene(folder)
    flat = True
    for k, view in enumerate(views_of(key, seed)):
        scene, capture = view.complete_scene, view.complete_capture.with_(outputs=("rgb", "depth", "label"))
        frame = renderer.render(scene, capture)
        images = {name: frame[name] for name in ("depth", "label")}
        images["rgb"] = defocused(frame.to_uint8(), view.defocus)
        truth = truth_of(images, scene, view.camera)
        coco.add(f"rgb/{k:06d}.png", truth)
        flat = flat and truth.camera.lens is None
        if flat:
            bop.add(images, truth)
        else:
            write_png(folder / "rgb" / f"{k:06d}.png", images["rgb"])
    if flat:
        bop.save()
    coco.save(folder / "coco.json")
    write_file(done, point)
    return folder


def rows_of(record: Record) -> Iterator[dict[str, Any]]:
    """Rows of a record, one per view and detector."""
    key = record.key
    for name, views in record.result["errors"].items():
        for errors in views:
            row = {name: key[name] for name in ("scene", "family", "cause", "severity")}
            row |= {"detector": name, "read": errors is not None}
            pixels, degrees, percent = errors or (math.nan,) * 3
            yield row | {"corner_px": pixels, "rotation_deg": degrees, "translation_percent": percent}
