"""Flight: frames of a scene along a camera trajectory, written to files, with resume."""

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
from fidsplat.backends.view import NO_CAMERA
from fidsplat.cameras import Motion, Shutter, Trajectory
from fidsplat.capture.capture import Capture
from fidsplat.formats import load_trajectory, save_trajectory
from fidsplat.formats.trajectories import lens_table
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
CONTACT_SHEET = "contact-sheet.png"
POSES = "trajectory.tum"
_COLUMNS, _ROWS = 4, 3
"""frames per row and column of the contact sheet"""


@dataclass(frozen=True, eq=False)
class Flight:
    """Frames of a scene at given times, from a camera that moves along a trajectory.

    Groups of splats that the scene's `Motion` moves use the same clock. A shutter with an exposure time or a
    readout blurs or skews the image by the camera's motion.

    Raises:
        InputError: no times, times that do not increase, or a scene without a camera.
    """

    scene: Scene
    trajectory: Trajectory
    """camera to world"""
    times: Sequence[float] | np.ndarray
    """(n,) seconds on the trajectory's clock, increasing; one frame per time"""
    capture: Capture
    """camera and settings of every frame; the camera's motion and the shutter's time are replaced"""

    def __post_init__(self) -> None:
        if self.capture.camera is None:
            raise InputError(NO_CAMERA)
        _ = self.path  # raises for invalid times

    @cached_property
    def path(self) -> Trajectory:
        """The camera pose of each frame, at the time of its middle row."""
        times = np.atleast_1d(real_array("the times of a flight", self.times, "numbers of seconds"))
        return Trajectory(times, [self.trajectory(time) for time in times])  # type: ignore[arg-type]

    def __len__(self) -> int:
        return len(self.path)

    @cached_property
    def captures(self) -> list[Capture]:
        """The capture of each frame."""
        motion = Motion(self.trajectory.inverse(), self.capture.motion.groups)
        shutter = self.capture.shutter
        return [
            self.capture.with_(motion=motion, shutter=replace(shutter, time=float(time)))
            for time in self.path.times
        ]

    def key(self, device: str) -> str:
        """Hash of splats, captures, device and version, on which the frames depend; 16 hexadecimal digits."""
        content = (self.scene.content, self.capture, self.trajectory, self.path, device, __version__)
        try:
            return digest_of(content)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise InputError(
                f"a flight must be picklable, so that it can be resumed, got {error}; use a trajectory or a "
                "module-level function for each motion"
            ) from None


class FlightFolder:
    """Output folder of a flight: frames, camera poses and the record flight.json.

    Frames are OUTPUT/000000.png and so on, in the formats of `fidsplat render`. Poses are in trajectory.tum
    and, for the lenses of nerfstudio, in transforms.json, which makes the folder a training data set.

    Args:
        overwrite: whether existing frames are deleted and rendered again.
        source: file of the scene, recorded for `fidsplat view`.

    Raises:
        InputError: the folder contains another flight, or cannot be written.
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
        previous = self._read_record()
        if previous is not None and previous.get("key") != self.key and not overwrite:
            raise InputError(
                f"{self.folder} must be empty or contain this flight, got another flight of "
                f"{previous.get('frames', 'some')} frames; give another folder, or --overwrite to replace it"
            )
        if previous is None and not overwrite and len(self.remaining()) < len(flight):
            raise InputError(
                f"{self.folder} must be empty or contain this flight, got frames without {RECORD}; give "
                "another folder, or --overwrite to replace them"
            )
        writable_folder(self.folder)
        for name in flight.capture.outputs:
            writable_folder(self.folder / name)
        if overwrite:
            self._clear()
        with atomic_write(self.folder / RECORD) as stream:
            stream.write((json.dumps(self._record(), indent=2) + "\n").encode())
        self._save_poses()

    def remaining(self) -> list[int]:
        """Numbers of the frames with missing files."""
        outputs = self.flight.capture.outputs
        return [
            k
            for k in range(len(self.flight))
            if not all(
                self.file(k, name, suffix).exists() for name in outputs for suffix in suffixes_of(name)
            )
        ]

    def file(self, k: int, name: str, suffix: str) -> Path:
        """Path of an output of frame k."""
        return self.folder / name / f"{k:06d}{suffix}"

    def render(self, renderer: Renderer) -> Iterator[int]:
        """Render the remaining frames; yields the number of each after its files are written."""
        remaining = self.remaining()
        if not remaining:
            return
        resident = renderer.upload(self.flight.scene)
        bits = self.flight.capture.sensor.bits
        frames = renderer.render_views(resident, [self.flight.captures[k] for k in remaining])
        for k, frame in zip(remaining, frames, strict=True):
            for name in frame.outputs:
                image = frame.to_uint8() if name == "rgb" and bits != 16 else frame[name]
                save_output(name, image, lambda output, suffix, k=k: self.file(k, output, suffix), bits)
            yield k

    def previews(self) -> list[Path]:
        """Viewable image files of the first output of all frames."""
        name = self.flight.capture.outputs[0]
        return [self.file(k, name, suffixes_of(name)[-1]) for k in range(len(self.flight))]

    def write_sheet(self) -> Path:
        """Write a contact sheet of at most twelve frames, evenly spread over the flight."""
        files = self.previews()
        chosen = sorted({round(k) for k in np.linspace(0, len(files) - 1, min(len(files), _COLUMNS * _ROWS))})
        cells = [(f"{float(self.flight.path.times[k]):.2f} s", read_image(files[k])) for k in chosen]
        rows = [cells[start : start + _COLUMNS] for start in range(0, len(cells), _COLUMNS)]
        return write_png(self.folder / CONTACT_SHEET, contact_sheet(rows, width=320))

    def write_video(self, path: str | Path, rate: float) -> Iterator[int]:
        """Write the frames as a video; yields the number of each after it is encoded."""
        return write_video(path, (read_image(file) for file in self.previews()), rate)

    def _clear(self) -> None:
        """Delete existing frames, also of another flight, which have the same file names."""
        for name in self.flight.capture.outputs:
            for suffix in suffixes_of(name):
                for file in (self.folder / name).glob(f"[0-9][0-9][0-9][0-9][0-9][0-9]{suffix}"):
                    file.unlink()

    def _read_record(self) -> dict[str, Any] | None:
        file = self.folder / RECORD
        if not file.exists():
            return None
        try:
            record = from_json(read_text(file))
        except ValueError:
            record = {}
        return record if isinstance(record, dict) else {}

    def _record(self) -> dict[str, Any]:
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

    def _save_poses(self) -> None:
        save_trajectory(self.flight.path, self.folder / POSES)
        camera, names = self.flight.capture.camera, self.previews()
        if camera is not None and lens_table(camera.lens) is not None:
            images = [str(file.relative_to(self.folder)) for file in names]
            save_trajectory(self.flight.path, self.folder / "transforms.json", camera, images)


def scene_of_frame(scene: Scene, image: Path) -> Scene:
    """The scene with the camera pose and time of the flight's frame in this image file; unchanged for other
    files."""
    folder = image.parent.parent
    if not image.stem.isdigit() or not (folder / RECORD).is_file():
        return scene
    path, number = load_trajectory(folder / POSES), int(image.stem)
    if number >= len(path):
        return scene
    return _moved_to(scene, path, float(path.times[number]))


def scene_at(scene: Scene, pose: np.ndarray, time: float) -> Scene:
    """The scene with its camera at a pose (4, 4), camera to world, at a time [s]."""
    return _moved_to(scene, Trajectory([time], pose[None]), time)


def _moved_to(scene: Scene, path: Trajectory, time: float) -> Scene:
    shutter = Shutter() if scene.shutter is None else scene.shutter
    return replace(scene, camera_motion=path.inverse(), shutter=replace(shutter, time=time))
