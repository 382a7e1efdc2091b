"""Calibration of a simulated camera with known intrinsics: errors of OpenCV by number of views."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fidsplat.cameras import BrownConrady, Camera, Fisheye
from fidsplat.capture.capture import Capture
from fidsplat.capture.sensor import Sensor
from fidsplat.markers import Marker, marker
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.util.arguments import number, whole_number
from fidsplat.util.errors import InputError, unknown
from fidsplat.vision.calibration import BoardView, calibrate, find_board, parameters, projection_errors

LENSES = {
    "none": None,
    "brown_conrady": BrownConrady(k1=-0.25, k2=0.08, p1=0.001, p2=-0.0005, k3=0.01),
    "fisheye": Fisheye(k1=0.05, k2=-0.01, k3=0.002, k4=-0.0005),
}
COUNTS = (3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
"""numbers of views that are compared"""
DRAWS = 15
"""random subsets of views for each number of views"""
TARGET = 0.1
"""maximum error of the projection in pixels for `needed`"""
TILT = 45.0
"""largest tilt of the board in degrees"""
WIDTHS = 0.45, 0.9
"""range of the board's width relative to the image's width"""


@dataclass(frozen=True)
class CalibrationSettings:
    """Camera, board and views of a calibration.

    Raises:
        InputError: a value is out of range.
    """

    lens: str = "brown_conrady"
    """NAME: none, brown_conrady or fisheye"""
    size: tuple[int, int] = (640, 480)
    """WIDTH HEIGHT: pixels of the images"""
    fov: float = 70.0
    """DEGREES: horizontal field of view, without the distortion"""
    board: str = "charuco:9x6:5x5_100"
    """SPEC: ChArUco board, 0.3 m wide"""
    views: int = 64
    """N: number of images of the board"""
    electrons: float = 10_000.0
    """N: electrons at white, for shot noise; inf: no noise"""
    seed: int = 0
    """N: seed of poses and noise"""

    def __post_init__(self) -> None:
        if self.lens not in LENSES:
            raise InputError(unknown("lens", self.lens, LENSES))
        whole_number("views", self.views, 3, 10_000)
        whole_number("the seed", self.seed, 0, 2**31)
        number("fov", self.fov, "degrees from 10 to 150", 10, 150)

    @cached_property
    def truth(self) -> Camera:
        """The camera, with an off-centre principal point and pixels that are not square."""
        width, height = self.size
        f = width / 2 / math.tan(math.radians(self.fov) / 2)
        return Camera.pinhole(
            width, height, f, 1.01 * f, 0.505 * width, 0.49 * height, lens=LENSES[self.lens]
        )

    @cached_property
    def made(self) -> Marker:
        """The ChArUco board as a marker."""
        return marker(self.board, size=0.3)

    def camera(self, rng: np.random.Generator) -> Camera:
        """The camera at a random pose from which the board is visible."""
        width, tilt, around, roll = rng.uniform((*WIDTHS[:1], 0, 0, -0.5), (*WIDTHS[1:], 1, 2 * math.pi, 0.5))
        distance = self.made.size * self.truth.fx / (width * self.truth.width)
        tilt = math.radians(TILT) * math.sqrt(tilt)
        back = np.array(
            [math.sin(tilt) * math.cos(around), math.sin(tilt) * math.sin(around), -math.cos(tilt)]
        )
        # the board reaches the corners of the image, where distortion is largest; half of it may be outside
        edges = np.array([1.0, self.truth.height / self.truth.width])
        aside = rng.uniform(-0.5, 0.5, 2) * edges / width * self.made.size
        target = np.array([*aside, 0.0])
        looking = Camera.look_at(
            *self.size, 1.0, target + distance * back, target, (math.sin(roll), -math.cos(roll), 0.0)
        )
        return self.truth.with_pose(looking.world_to_camera)


class DetectedBoard(NamedTuple):
    """A detected board with the errors of its corners."""

    view: BoardView
    errors: np.ndarray
    """(n, 2) pixels, detected minus true corners"""


def rendered_views(settings: CalibrationSettings, renderer: Renderer) -> Iterator[DetectedBoard | None]:
    """Render views of the board and detect its corners; yields None if too few corners are found."""
    rng, scene = np.random.default_rng(settings.seed), Scene(markers=(PlacedMarker(settings.made),))
    resident = renderer.upload(scene)
    cameras = [settings.camera(rng) for _ in range(settings.views)]
    for k, camera in enumerate(cameras):
        sensor = Sensor(full_well=settings.electrons, seed=settings.seed * 10_000 + k)
        capture = Capture(camera, background=(0.5, 0.5, 0.5), sensor=sensor)
        view = find_board(renderer.render(resident, capture).to_uint8(), settings.made)
        if view is None:
            yield None
            continue
        points = settings.made.corners[0] + np.pad(view.points, ((0, 0), (0, 1)))
        yield DetectedBoard(view, view.corners - camera.project(points))


def errors_by_count(settings: CalibrationSettings, views: list[BoardView]) -> Iterator[dict[str, Any]]:
    """Calibrate from random subsets of each number of views.

    Yields `views`; `projection_px`, the RMS error of the projection after removal of a rotation (median of
    the subsets, with quartiles); and `errors`, the median absolute error of each parameter.
    """
    rng, true = np.random.default_rng(settings.seed), parameters(settings.truth)
    counts = [count for count in COUNTS if count < len(views)] + [len(views)]
    for count in counts:
        projection, deviations = [], []
        for _ in range(1 if count == len(views) else DRAWS):
            chosen = rng.choice(len(views), count, replace=False)
            try:
                calibrated = calibrate([views[k] for k in chosen], settings.truth)
            except InputError:  # OpenCV fails for some subsets of few views
                projection.append(math.inf)
                continue
            projection.append(float(np.sqrt((projection_errors(calibrated, settings.truth) ** 2).mean())))
            deviations.append([abs(value - true[name]) for name, value in parameters(calibrated).items()])
        # the median without interpolation, since failures are infinite
        low, middle, high = np.percentile(projection, (25, 50, 75), method="nearest").tolist()
        errors = np.median(deviations, axis=0).tolist() if deviations else [math.inf] * len(true)
        yield {
            "views": count,
            "projection_px": middle,
            "quartiles_px": [low, high],
            "errors": dict(zip(true, errors, strict=True)),
        }


def needed(rows: list[dict[str, Any]]) -> int | None:
    """The smallest number of views from which on three of four calibrations are within `TARGET`; None if
    there is none."""
    count = None
    for row in reversed(rows):
        if row["quartiles_px"][1] > TARGET:
            break
        count = row["views"]
    return count


def write_chart(rows: list[dict[str, Any]], file: Path) -> None:
    """Write a chart of the projection error by number of views, with quartiles."""
    from fidsplat.experiments.charts import chart  # here, since it imports matplotlib

    rows = [row for row in rows if math.isfinite(row["quartiles_px"][1])]
    with chart(file, size=(6.0, 4.0)) as (_, (axes,)):
        counts, middle = [row["views"] for row in rows], [row["projection_px"] for row in rows]
        spread = np.transpose([row["quartiles_px"] for row in rows]) if rows else ((), ())
        axes.fill_between(counts, *spread, alpha=0.25, label="quartiles")
        axes.plot(counts, middle, "o-", label="median of random choices of views")
        axes.axhline(TARGET, color="#777777", linestyle="--", label=f"{TARGET} pixels")
        axes.set(xscale="log", yscale="log", xlabel="views", ylabel="RMS error of projection [pixels]")
        axes.legend(frameon=False)
