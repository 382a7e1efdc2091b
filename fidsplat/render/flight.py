"""Flights: a scene's pictures along a trajectory, as files that a run which was stopped goes on with."""

from __future__ import annotations

import json
import os
import pickle
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat import __version__
from fidsplat.cameras import Motion, Shutter, Trajectory
from fidsplat.capture.capture import Capture
from fidsplat.formats import load_trajectory, save_trajectory
from fidsplat.images.files import read_image, write_png
from fidsplat.images.video import write_video
from fidsplat.images.visualize import contact_sheet
from fidsplat.render.output_files import save_output, suffixes_of
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import Scene
from fidsplat.util.arguments import real_array
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write, from_json, path_of, read_text, writable_folder
from fidsplat.util.provenance import digest_of

RECORD = "flight.json"
SHEET = "contact-sheet.png"
POSES = "trajectory.tum"
_COLUMNS, _ROWS = 4, 3


@dataclass(frozen=True, eq=False)
class Flight:
    """Pictures of a scene at times, from a camera that moves along a trajectory.

    What else moves in the scene moves by the same clock, and its shutter sees the camera move. Raises
    InputError where there is no time, the times do not increase, or the scene has no camera.
    """

    scene: Scene
    trajectory: Trajectory
    """camera to world"""
    times: Sequence[float] | np.ndarray
    """(n,) seconds on the trajectory's clock, increasing: one picture each"""
    capture: Capture
    """how pictures are taken, but for the camera's motion and the shutter's time"""

    def __post_init__(self) -> None:
        if self.capture.camera is None:
            raise InputError("the scene has no camera; its size and focal lengths are needed for a flight")
        _ = self.path  # times that are none are refused here

    @cached_property
    def path(self) -> Trajectory:
        """The pose of each picture, at the time of its middle row."""
        times = np.atleast_1d(real_array("the times of a flight", self.times, "numbers of seconds"))
        return Trajectory(times, [self.trajectory(time) for time in times])  # type: ignore[arg-type]

    def __len__(self) -> int:
        return len(self.path)

    @cached_property
    def captures(self) -> list[Capture]:
        """How picture k is taken."""
        motion = Motion(self.trajectory.inverse(), self.capture.motion.groups)
        shutter = self.capture.shutter
        return [
            self.capture.with_(motion=motion, shutter=replace(shutter, time=float(time)))
            for time in self.path.times
        ]

    def key(self, device: str) -> str:
        """16 hexadecimal digits of all that its pictures depend on: splats, captures, device, version."""
        content = (self.scene.content, self.capture, self.trajectory, self.path, device, __version__)
        try:
            return digest_of(content)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise InputError(
                f"a flight must be made of data, so that it can go on after a stop: {error}"
            ) from None


class FlightFolder:
    """A folder with a flight's pictures: OUTPUT/000000.png and so on, as `fidsplat render` writes outputs;
    their poses in trajectory.tum and, for a pinhole, transforms.json, which makes it a data set; and in
    flight.json what they are of.

    Args:
        overwrite: whether pictures of another flight are replaced.
        source: file of what is drawn, of which the record tells `fidsplat view`.

    Raises:
        InputError: it holds another flight, or cannot be written.
    """

    def __init__(
        self,
        folder: str | Path,
        flight: Flight,
        device: str,
        overwrite: bool = False,
        source: str | Path | None = None,
    ) -> None:
        self.folder, self.flight, self.device = path_of(folder), flight, device
        self._source = None if source is None else os.path.relpath(source, self.folder)
        self.key = flight.key(device)
        before = self._recorded()
        if before is not None and before.get("key") != self.key and not overwrite:
            raise InputError(
                f"{self.folder} holds another flight, of {before.get('frames', 'some')} pictures; give "
                "another folder, or --overwrite to draw over it"
            )
        if before is None and not overwrite and len(self.left()) < len(flight):
            raise InputError(
                f"{self.folder} holds pictures that no {RECORD} there tells of; give another folder, or "
                "--overwrite to draw over them"
            )
        writable_folder(self.folder)
        for name in flight.capture.outputs:
            writable_folder(self.folder / name)
        if overwrite:
            self._clear()
        self._write(RECORD, self._facts())
        self._save_poses()

    def left(self) -> list[int]:
        """Numbers of the pictures that are not whole yet."""
        outputs = self.flight.capture.outputs
        return [
            k
            for k in range(len(self.flight))
            if not all(
                self.file(k, name, suffix).exists() for name in outputs for suffix in suffixes_of(name)
            )
        ]

    def file(self, k: int, name: str, suffix: str) -> Path:
        """Where a file of picture k belongs."""
        return self.folder / name / f"{k:06d}{suffix}"

    def draw(self, renderer: Renderer) -> Iterator[int]:
        """Draw what is left; yields the number of each picture once its files are whole."""
        left = self.left()
        if not left:
            return
        resident = renderer.upload(self.flight.scene)
        bits = self.flight.capture.sensor.bits
        frames = renderer.render_views(resident, [self.flight.captures[k] for k in left])
        for k, frame in zip(left, frames, strict=True):
            for name in frame.outputs:
                image = frame.to_uint8() if name == "rgb" and bits != 16 else frame[name]
                save_output(name, image, lambda output, suffix, k=k: self.file(k, output, suffix), bits)
            yield k

    def pictures(self) -> list[Path]:
        """One picture of each time that people can look at: of the first output."""
        name = self.flight.capture.outputs[0]
        return [self.file(k, name, suffixes_of(name)[-1]) for k in range(len(self.flight))]

    def write_sheet(self) -> Path:
        """Twelve pictures, evenly spread over the flight, on one sheet."""
        files = self.pictures()
        some = sorted({round(k) for k in np.linspace(0, len(files) - 1, min(len(files), _COLUMNS * _ROWS))})
        cells = [(f"{float(self.flight.path.times[k]):.2f} s", read_image(files[k])) for k in some]
        rows = [cells[start : start + _COLUMNS] for start in range(0, len(cells), _COLUMNS)]
        return write_png(self.folder / SHEET, contact_sheet(rows, width=320))

    def write_video(self, path: str | Path, rate: float) -> Iterator[int]:
        """The pictures as a video; yields the number of each once it is in. Raises InputError without the
        extra `video`."""
        return write_video(path, (read_image(file) for file in self.pictures()), rate)

    def _clear(self) -> None:
        # what lies here under our names is not of this flight
        for name in self.flight.capture.outputs:
            for suffix in suffixes_of(name):
                for file in (self.folder / name).glob(f"[0-9][0-9][0-9][0-9][0-9][0-9]{suffix}"):
                    file.unlink()

    def _recorded(self) -> dict[str, Any] | None:
        file = self.folder / RECORD
        if not file.exists():
            return None
        try:
            found = from_json(read_text(file))
        except ValueError:
            found = {}
        return found if isinstance(found, dict) else {}

    def _facts(self) -> dict[str, Any]:
        path = self.flight.path
        return {
            "fidsplat": __version__,
            "key": self.key,
            "device": self.device,
            "source": self._source,
            "frames": len(path),
            "outputs": list(self.flight.capture.outputs),
            "times": np.asarray(path.times).tolist(),
        }

    def _write(self, name: str, facts: dict[str, Any]) -> None:
        with atomic_write(self.folder / name) as stream:
            stream.write((json.dumps(facts, indent=2) + "\n").encode())

    def _save_poses(self) -> None:
        save_trajectory(self.flight.path, self.folder / POSES)
        camera, names = self.flight.capture.camera, self.pictures()
        if camera is not None and camera.lens is None:
            images = [str(file.relative_to(self.folder)) for file in names]
            save_trajectory(self.flight.path, self.folder / "transforms.json", camera, images)


def seen_in_flight(scene: Scene, picture: Path) -> Scene:
    """The scene with its camera and its clock as they were in a picture of a flight's folder; as it is for
    any other picture."""
    folder = picture.parent.parent
    if not picture.stem.isdigit() or not (folder / RECORD).is_file():
        return scene
    path, number = load_trajectory(folder / POSES), int(picture.stem)
    if number >= len(path):
        return scene
    return _at(scene, path, float(path.times[number]))


def seen_from(scene: Scene, pose: np.ndarray, time: float) -> Scene:
    """The scene with its camera at a pose (4, 4), camera to world, and its clock at a time [s]."""
    return _at(scene, Trajectory([time], pose[None]), time)


def _at(scene: Scene, path: Trajectory, time: float) -> Scene:
    shutter = Shutter() if scene.shutter is None else scene.shutter
    return replace(scene, camera_motion=path.inverse(), shutter=replace(shutter, time=time))
