"""Structure from motion by COLMAP (pycolmap): features, matches and incremental mapping.

COLMAP's database stores features and matches, photograph by photograph and pair by pair, so that an
interrupted run resumes.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.photographs.settings import LENSES
from fidsplat.util.errors import InputError, required_package
from fidsplat.util.progress import Progress

EXHAUSTIVE = 80
"""up to this number of images all pairs are matched; beyond, a video's frames with their neighbours"""
NEIGHBOURS, STRIDE = 12, 10
"""frames of a long video are matched with the next ones; every STRIDE-th with each other to close loops"""
AT_ONCE, PAIRS = min(8, os.cpu_count() or 1), 16
"""photographs and pairs between two reports of progress"""
FEATURE_SIDE, FEATURES = 2000, 4096
"""maximum side in pixels of the photographs in which features are detected; maximum number of features of
each"""
FEW_FEATURES = 200
HUBER = 0.25
"""pixels: threshold of Huber's loss of the last bundle adjustment"""
MIN_MATCHES = 15
"""matches that COLMAP's mapper needs of a pair"""


@dataclass(frozen=True, eq=False)
class Model:
    """Cameras and points of structure from motion."""

    names: tuple[str, ...]
    """names of the registered photographs, sorted"""
    cameras: tuple[Camera, ...]
    """camera of each"""
    points: np.ndarray
    """(m, 3) float64, in the unit of the model"""
    colors: np.ndarray
    """(m, 3) uint8"""
    pixels: tuple[np.ndarray, ...]
    """for each photograph (k, 2): its features, pixels"""
    tracks: tuple[np.ndarray, ...]
    """for each photograph (k,): indices of the features' points"""

    @property
    def reprojection(self) -> float:
        """Root mean square of the features' reprojection errors in pixels."""
        errors = [
            camera.project(self.points[track]) - pixels
            for camera, track, pixels in zip(self.cameras, self.tracks, self.pixels, strict=True)
        ]
        return float(np.sqrt(np.nanmean((np.concatenate(errors) ** 2).sum(1))))


def require_pycolmap() -> Any:
    """Import pycolmap and disable its log. Raises InputError if it is not installed."""
    with required_package("pycolmap", "capture"):
        import pycolmap  # type: ignore[import-not-found]
    pycolmap.logging.minloglevel = 3
    with contextlib.suppress(ValueError):  # outside of the main thread
        # its import replaces the handler by one that prints a stack trace
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return pycolmap


def extract(
    database: Path, photos: Path, groups: Sequence[Sequence[str]], lens: str, progress: Progress
) -> None:
    """Extract the SIFT features of all photographs.

    groups: names of the photographs that share one camera.
    """
    pycolmap = require_pycolmap()
    options = pycolmap.ImageReaderOptions()
    options.camera_model = LENSES[lens]
    names = [name for group in groups for name in group]
    with pycolmap.Database.open(database) as data:
        present = {
            image.name: data.num_keypoints_for_image(image.image_id) for image in data.read_all_images()
        }
    for group in groups:
        if group[0] not in present:
            pycolmap.import_images(database, photos, pycolmap.CameraMode.SINGLE, list(group), options)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size, extraction.sift.max_num_features = FEATURE_SIDE, FEATURES
    left = [name for name in names if not present.get(name)]
    for first in range(0, len(left), AT_ONCE):
        progress("features", 1 - (len(left) - first) / len(names))
        some = left[first : first + AT_ONCE]
        pycolmap.extract_features(
            database,
            photos,
            some,
            reader_options=options,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )


def match(database: Path, ordered: bool, progress: Progress) -> None:
    """Match features between pairs. ordered: the images are frames of a video."""
    pycolmap = require_pycolmap()
    with pycolmap.Database.open(database) as data:
        images = sorted(data.read_all_images(), key=lambda image: image.name)
        pairs = [
            (one.name, other.name)
            for one, other in _pairs(images, ordered)
            if not data.exists_two_view_geometry(one.image_id, other.image_id)
        ]
    options = pycolmap.ImportedPairingOptions()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    listed = database.with_name("pairs.txt")
    options.match_list_path = listed
    for first in range(0, len(pairs), PAIRS):
        progress("matches", first / len(pairs))
        listed.write_text("".join(f"{one} {other}\n" for one, other in pairs[first : first + PAIRS]))
        pycolmap.match_image_pairs(
            database,
            pairing_options=options,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )


def _pairs(images: Sequence[Any], ordered: bool) -> list[tuple[Any, Any]]:
    if not ordered or len(images) <= EXHAUSTIVE:
        return list(combinations(images, 2))
    near = [
        pair
        for i, image in enumerate(images)
        for pair in ((image, n) for n in images[i + 1 : i + 1 + NEIGHBOURS])
    ]
    return list(dict.fromkeys([*near, *combinations(images[::STRIDE], 2)]))


def map_incrementally(database: Path, photos: Path, folder: Path, progress: Progress) -> Model:
    """Estimate cameras and points, and write the largest model to `folder`, as COLMAP's files.

    Raises InputError if fewer than 3 photographs can be registered.
    """
    pycolmap = require_pycolmap()
    parts = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(parts, ignore_errors=True)
    parts.mkdir()
    with pycolmap.Database.open(database) as data:
        total, placed = data.num_images(), [0]

    def advance() -> None:
        placed[0] += 1
        progress("cameras", min(placed[0] / total, 0.99))

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.min_model_size = 3
    models = pycolmap.incremental_mapping(database, photos, parts, options, next_image_callback=advance)
    largest = max(
        models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None
    )
    if largest is None or largest.num_reg_images() < 3:
        why = "; ".join(f"{name}: {reason}" for name, reason in unregistered(database, ())[:3])
        raise InputError(
            f"photographs must overlap to find their cameras, got {total} of which fewer than 3 fit together "
            f"({why}); take photographs of one scene from positions a small step apart"
        )
    _adjust_robustly(largest)
    shutil.rmtree(parts)
    parts.mkdir()
    largest.write(parts)
    parts.rename(folder)
    return read_model(folder)


def _adjust_robustly(model: Any) -> None:
    """Minimise Huber's loss of the reprojection errors, after COLMAP's mapper with squared errors."""
    pycolmap = require_pycolmap()
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.HUBER
    options.ceres.loss_function_scale = HUBER
    for image in model.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def read_model(folder: Path) -> Model:
    """Read a model with its features."""
    model = require_pycolmap().Reconstruction(folder)
    ids = sorted(model.points3D)
    index = {point: i for i, point in enumerate(ids)}
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    observations = [image.get_observation_points2D() for image in images]
    return Model(
        tuple(image.name for image in images),
        tuple(Camera.from_colmap(image.camera, image) for image in images),
        np.array([model.points3D[i].xyz for i in ids], np.float64).reshape(-1, 3),
        np.array([model.points3D[i].color for i in ids], np.uint8).reshape(-1, 3),
        tuple(np.array([point.xy for point in points], np.float64).reshape(-1, 2) for points in observations),
        tuple(np.array([index[point.point3D_id] for point in points], np.int64) for points in observations),
    )


def unregistered(database: Path, registered: Sequence[str]) -> list[tuple[str, str]]:
    """Names of the photographs that were not registered, each with the reason."""
    pycolmap = require_pycolmap()
    with pycolmap.Database.open(database) as data:
        images = {image.image_id: image.name for image in data.read_all_images()}
        best = dict.fromkeys(images, 0)
        pairs, counts = data.read_two_view_geometry_num_inliers()
        for pair, count in zip(map(pycolmap.pair_id_to_image_pair, pairs), counts, strict=True):
            for image_id, partner in (pair, pair[::-1]):
                if not registered or images[partner] in registered:
                    best[image_id] = max(best[image_id], count)
        features = {image_id: data.num_keypoints_for_image(image_id) for image_id in images}
    missing = []
    for image_id, name in sorted(images.items(), key=lambda item: item[1]):
        if name in registered:
            continue
        if features[image_id] < FEW_FEATURES:
            reason = f"only {features[image_id]} features, it is blurred, dark or blank"
        elif best[image_id] < MIN_MATCHES:
            reason = (
                f"at most {best[image_id]} matches with another, it shows something else or from too far away"
            )
        else:
            reason = f"{best[image_id]} matches with another, but too few with points of the others"
        missing.append((name, reason))
    return missing
