"""A robot that finds its way through a greenhouse by tags: how far a simulated camera moves the result."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.cameras import BrownConrady, Camera, Motion, Shutter, Trajectory
from fidsplat.capture import Capture
from fidsplat.errors import InputError, unknown
from fidsplat.files import atomic_write, writable_folder
from fidsplat.formats import load_trajectory, save_trajectory
from fidsplat.provenance import run_facts
from fidsplat.render import Renderer
from fidsplat.sensor import Sensor
from fidsplat.sim.greenhouse import AISLE, Greenhouse
from fidsplat.sim.localiser import Localiser
from fidsplat.sim.robot import BODY, Errors, Run, camera_at, drive
from fidsplat.vision.detect import Detection, detect
from fidsplat.vision.images import to_uint8

RATE = 4.0
"""pictures a second"""
RESULTS, REPORT, CHART = "localise.json", "localise.md", "localise.svg"
FAMILY = "apriltag:36h11"
CAMERA = "eye"
"""name of the camera in logs"""
_LENS = BrownConrady(k1=-0.18, k2=0.03, p1=0.0005, p2=-0.0003)
_SENSOR = Sensor(full_well=2000.0, read_noise=6.0, bits=8)


@dataclass(frozen=True)
class Variant:
    """One way of seeing tags."""

    mixture: str | None = "exact"
    """of the markers; None: no pictures are taken"""
    lens: BrownConrady | None = None
    exposure_time: float = 0.0
    readout: float = 0.0
    sensor: Sensor | None = None
    ideal: bool = False
    """no pictures: the tags that `exact` sees, with corners where they are"""


VARIANTS = {
    "odometry": Variant(mixture=None),
    "ideal corners": Variant(mixture=None, ideal=True),
    "exact": Variant(),
    "fitted": Variant("fitted"),
    "paper": Variant("paper"),
    "lens": Variant(lens=_LENS),
    "blur": Variant(exposure_time=0.03),
    "rolling shutter": Variant(readout=0.03),
    "noise": Variant(sensor=_SENSOR),
    "all of these": Variant("exact", _LENS, 0.03, 0.03, _SENSOR),
}
"""What is compared, by name: wheels and gyroscope alone; corners without error; mixtures; and effects on
`exact`"""


@dataclass(frozen=True)
class Localise:
    """The experiment. Raises InputError for a greenhouse that cannot be."""

    rows: int = 4
    plants: int = 12
    seed: int = 0
    speed: float = 0.5
    """metres a second"""

    @property
    def house(self) -> Greenhouse:
        """Where it takes place."""
        return Greenhouse(self.rows, self.plants, self.seed)

    @property
    def camera(self) -> Camera:
        """640 x 480, 80 degrees across."""
        return Camera.look_at(640, 480, math.radians(80), (0, 0, 0), (0, 0, 1))

    def run(self) -> Run:
        """The drive: up one aisle, down the next."""
        ends, path = (-0.8, self.house.length + 0.8), []
        for aisle in range(self.rows + 1):
            y = (aisle - 0.5) * AISLE
            path += [(x, y) for x in (ends if aisle % 2 == 0 else ends[::-1])]
        return drive(self.house.mjcf(BODY), np.array(path), self.speed, Errors(seed=self.seed))

    def shots(self, run: Run) -> np.ndarray:
        """Numbers of the moments of a drive at which pictures are taken."""
        return np.unique(np.searchsorted(run.times, np.arange(1 / RATE, run.times[-1], 1 / RATE)))

    def pictures(self, variant: Variant, run: Run, renderer: Renderer) -> Iterator[np.ndarray]:
        """What the camera sees at each moment, (480, 640, 3) uint8."""
        scene = replace(self.house, mixture=variant.mixture).scene
        plain = Capture(
            replace(self.camera, lens=variant.lens),
            background=scene.background,
            motion=Motion(run.camera.inverse()),
        )
        captures = []
        for k in self.shots(run):
            shutter = Shutter(
                float(run.times[k]), variant.exposure_time, 5, variant.readout, rows_per_band=30
            )
            sensor = None if variant.sensor is None else replace(variant.sensor, seed=int(k))
            captures.append(plain.with_(shutter=shutter, sensor=sensor))
        for frame in renderer.render_views(renderer.upload(scene), captures):
            yield to_uint8(frame["rgb"])

    def sightings(self, variant: Variant, run: Run, renderer: Renderer) -> Iterator[list[Detection]]:
        """The tags in each picture of a variant."""
        for picture in self.pictures(variant, run, renderer):
            yield detect(picture, (FAMILY,), qr=False)

    def localised(
        self, run: Run, sightings: list[list[Detection]] | None, camera: Camera, noise: float = 0.5
    ) -> tuple[Trajectory, dict[str, Any]]:
        """Where the robot takes itself to be, and how far off that is."""
        first = run.poses[0]
        filtered = Localiser(np.array([*first[:2, 3], math.atan2(first[1, 0], first[0, 0])]), noise)
        tags = {
            placed.marker.id: placed.corners for placed in self.house.markers if placed.marker.id is not None
        }
        at = {} if sightings is None else dict(zip(self.shots(run).tolist(), sightings, strict=True))
        standing = partial(camera_at, camera)
        poses, seen = [first], 0
        for k in range(1, len(run.times)):
            filtered.move(run.wheels[k], float(run.gyro[k]), float(run.times[k] - run.times[k - 1]))
            for tag in at.get(k, []):
                if tag.id in tags:
                    seen += filtered.see(tag.corners, tags[tag.id], standing)
            poses.append(filtered.pose)
        facts = errors_of(run, np.array(poses))
        facts |= {"tags": seen, "refused": filtered.refused}
        return Trajectory(run.times, np.array(poses)), facts

    def ideal(self, run: Run, sightings: list[list[Detection]]) -> list[list[Detection]]:
        """The same tags with corners where they are."""
        tags = {
            placed.marker.id: placed.corners for placed in self.house.markers if placed.marker.id is not None
        }
        found = []
        for k, codes in zip(self.shots(run).tolist(), sightings, strict=True):
            camera = camera_at(self.camera, run.poses[k])
            found.append(
                [replace(code, corners=camera.project(tags[code.id])) for code in codes if code.id in tags]
            )
        return found


def errors_of(run: Run, poses: np.ndarray) -> dict[str, float]:
    """Of estimated poses (n, 4, 4): absolute trajectory error without alignment (root mean square and worst)
    and relative error over a metre (root mean square), in metres on the floor; heading in degrees."""
    off = np.linalg.norm(poses[:, :2, 3] - run.poses[:, :2, 3], axis=1)
    turn = np.einsum("nji,njk->nik", run.poses[:, :3, :3], poses[:, :3, :3])
    heading = np.degrees(np.arctan2(turn[:, 1, 0], turn[:, 0, 0]))
    gone = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(run.poses[:, :2, 3], axis=0), axis=1))])
    after = np.searchsorted(gone, gone + 1.0)
    pairs = np.flatnonzero(after < len(gone))
    steps = [np.linalg.inv(each[pairs]) @ each[after[pairs]] for each in (run.poses, poses)]
    relative = (np.linalg.inv(steps[0]) @ steps[1])[:, :2, 3]
    return {
        "ate_m": float(np.sqrt((off**2).mean())),
        "worst_m": float(off.max()),
        "rpe_m": float(np.sqrt((relative**2).sum(1).mean())) if len(pairs) else 0.0,
        "heading_deg": float(np.sqrt((heading**2).mean())),
    }


class LocaliseFolder:
    """Results on disk: one entry for each variant, trajectories as TUM, a chart and a page. What is there is
    not measured again.

    Raises InputError where the folder holds another experiment, or cannot be written.
    """

    def __init__(self, folder: Path, asked: Localise, device: str, overwrite: bool = False) -> None:
        self.folder, self.asked = writable_folder(folder), asked
        self.key = {"rows": asked.rows, "plants": asked.plants, "seed": asked.seed, "speed": asked.speed}
        self.results: dict[str, Any] = {
            "run": run_facts(device, asked.seed),
            "asked": self.key,
            "variants": {},
        }
        file = self.folder / RESULTS
        if file.exists() and not overwrite:
            try:
                before = json.loads(file.read_text("utf-8"))
            except (OSError, ValueError) as error:
                raise InputError(f"{file} cannot be read ({error}); --overwrite measures again") from None
            if before.get("asked") != self.key:
                raise InputError(
                    f"{file} is of another drive, {before.get('asked')}; give another folder, or --overwrite"
                )
            self.results = before

    def measure(self, names: list[str], renderer: Renderer) -> Iterator[tuple[str, float]]:
        """Measure what is left of the variants; yields words and the share of them that is done."""
        for name in names:
            if name not in VARIANTS:
                raise InputError(unknown("variant", name, VARIANTS))
        left = [name for name in names if name not in self.results["variants"]]
        if not left:
            return
        run = self.asked.run()
        self.results["length_m"] = run.length
        save_trajectory(Trajectory(run.times, run.poses), self.folder / _tum("truth"))
        seen: dict[str, list[list[Detection]]] = {}
        count = len(self.asked.shots(run))
        for done, name in enumerate(left):
            variant = VARIANTS[name]
            source = "exact" if variant.ideal else name
            if (variant.mixture or variant.ideal) and source not in seen:
                found = []
                for codes in self.asked.sightings(VARIANTS[source], run, renderer):
                    found.append(codes)
                    yield name, (done + len(found) / count) / len(left)
                seen[source] = found
            sightings = seen.get(source)
            if variant.ideal and sightings is not None:
                sightings = self.asked.ideal(run, sightings)
            camera = replace(self.asked.camera, lens=variant.lens)
            path, facts = self.asked.localised(run, sightings, camera, 0.05 if variant.ideal else 0.5)
            save_trajectory(path, self.folder / _tum(name))
            self.results["variants"][name] = facts
            with atomic_write(self.folder / RESULTS) as stream:
                stream.write(json.dumps(self.results, indent=2).encode())
            yield name, (done + 1) / len(left)

    def rows(self) -> list[tuple[str, ...]]:
        """A row of text for each variant: name, errors in centimetres and degrees, tags."""
        return [
            (
                name,
                f"{100 * facts['ate_m']:.2f}",
                f"{100 * facts['worst_m']:.2f}",
                f"{100 * facts['rpe_m']:.2f}",
                f"{facts['heading_deg']:.3f}",
                str(facts["tags"]),
                str(facts["refused"]),
            )
            for name, facts in self.results["variants"].items()
        ]

    def write_chart(self) -> Path:
        """The drive from above, as it was and as it was taken to be. Needs matplotlib."""
        from fidsplat.experiments.charts import COLOURS, chart, legend_above

        names = [name for name in self.results["variants"] if (self.folder / _tum(name)).exists()]
        with chart(self.folder / CHART, size=(9.0, 5.0)) as (figure, axes):
            for number, name in enumerate(["truth", *names]):
                path = load_trajectory(self.folder / _tum(name)).poses[::10, :2, 3]  # every fifth of a second
                width, colour = (3.0, "#bbbbbb") if number == 0 else (1.0, COLOURS[number % len(COLOURS)])
                axes[0].plot(path[:, 0], path[:, 1], label=name, color=colour, linewidth=width)
            axes[0].set_aspect("equal")
            axes[0].set_xlabel("x [m]")
            axes[0].set_ylabel("y [m]")
            legend_above(figure, axes[0])
        return self.folder / CHART

    def write_page(self) -> Path:
        """The table as a page."""
        lines = [
            "# A robot among tags",
            "",
            f"{self.results['length_m']:.1f} m through a greenhouse of {self.asked.rows} rows, "
            f"{RATE:g} pictures a second of 640 x 480, on {self.results['run']['device']}.",
            "",
            f"| {' | '.join(HEADS)} |",
            f"|{'---|' * len(HEADS)}",
            *(f"| {' | '.join(row)} |" for row in self.rows()),
            "",
            f"![The drive from above]({CHART})",
            "",
        ]
        with atomic_write(self.folder / REPORT) as stream:
            stream.write("\n".join(lines).encode())
        return self.folder / REPORT


HEADS = ("", "ATE [cm]", "worst [cm]", "RPE over 1 m [cm]", "heading [deg]", "tags", "refused")


def _tum(name: str) -> str:
    return f"{name.replace(' ', '-')}.tum"


def write_log(
    asked: Localise, name: str, renderer: Renderer, path: str, overwrite: bool
) -> Iterator[np.ndarray]:
    """One variant's drive as a log: pictures (JPEG), intrinsics, detections, the gyroscope, where the camera
    is (/tf) and where the robot takes itself to be (/odom). Yields the pictures as they are logged.

    Raises InputError for a variant that takes no pictures, and as `RobotLog`.
    """
    from fidsplat.logs import RobotLog

    variant = VARIANTS[name]
    if variant.mixture is None:
        raise InputError(f"{name!r} takes no pictures, of which a log is made; known: exact, fitted ...")
    run = asked.run()
    shots, camera = asked.shots(run), replace(asked.camera, lens=variant.lens)
    sightings = []
    with RobotLog(path, overwrite=overwrite) as log:
        for k, picture in zip(shots.tolist(), asked.pictures(variant, run, renderer), strict=True):
            time, codes = float(run.times[k]), detect(picture, (FAMILY,), qr=False)
            sightings.append(codes)
            log.image(time, CAMERA, picture, compress="jpeg")
            log.camera_info(time, CAMERA, camera)
            log.transform(time, CAMERA, run.camera.poses[k])
            log.detections(time, CAMERA, codes)
            yield picture
        path_taken, _ = asked.localised(run, sightings, camera)
        for k, time in enumerate(run.times.tolist()):
            log.imu(time, (0, 0, run.gyro[k]), (0, 0, 9.81), frame="base_link")
            log.odometry(time, path_taken.poses[k])
