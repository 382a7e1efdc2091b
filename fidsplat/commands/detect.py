"""Command `fidsplat detect`: detect codes in images, videos and robot logs."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from fidsplat.commands.options import Json
from fidsplat.commands.output import console, print_json, print_table
from fidsplat.commands.scenes import load_scene_file
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np

    from fidsplat.scenes import Scene
    from fidsplat.vision.bundles import BundleReading
    from fidsplat.vision.readback import Reading


@dataclass
class Detect:
    """Detect AprilTag, ArUco and QR codes in images, folders of images, videos and robot logs.

    Prints the content and the corners of each code, in pixels: top left, top right, bottom right, bottom left
    as printed; the centre of the first pixel is (0.5, 0.5). --scene adds the pose of each marker and board of
    that scene, its errors against the true pose, and their means. If the scene moves, true poses are those at
    the shutter's time, when the middle row is exposed; in the folder or log of a flight, those of each frame.
    A board or a bundle of markers has one pose.

    Examples:
      fidsplat detect photo.jpg
      fidsplat detect photo.png --family 16h5 --family 7x7_1000
      fidsplat detect flight.mp4 stills/ --json
      fidsplat detect run.mcap --topic /front/image_raw
      fidsplat detect scene.png --scene scene.toml --json
      fidsplat detect fidsplat-flight --scene scene.toml
    """

    images: tyro.conf.Positional[tuple[str, ...]]
    """IMAGE: image, folder of images, video, MCAP file or rosbag2 folder"""
    family: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """FAMILY: tag family, repeat for several (default: the scene's, or 36h11 25h9 4x4_50 5x5_100 6x6_250
    7x7_250)"""
    scene: str | None = None
    """SCENE.toml: scene of the images"""
    topic: str | None = None
    """TOPIC: topic of a log (default: all topics with images)"""
    json: Json = False

    def run(self) -> int:
        from fidsplat.images.tag_dictionaries import parse_family
        from fidsplat.markers.kinds import detectors
        from fidsplat.vision.readback import means

        if not self.images:
            raise InputError("IMAGE must be at least one image, folder of images or video, got none")
        for name in self.family:
            if name not in detectors():
                parse_family(name)
        scene = None if self.scene is None else load_scene_file(self.scene, "for the poses of its markers")
        results: list[dict[str, Any]] = []
        readings: list[Reading] = []
        rows: list[tuple[str, ...]] = []
        for path in self.images:
            for name, image, then in self._images(path, scene):
                result, read, bundled = self._detect(name, image, then)
                results.append(result)
                readings += read
                rows += [(name, *row) for row in (*map(reading_row, read), *map(_bundle_row, bundled))]
        mean = {} if scene is None else {"means": means(readings)}
        if self.json:
            print_json((results[0] if len(results) == 1 else {"pictures": results}) | mean)
            return 0
        _print_codes(results)
        if scene is not None:
            if len(readings) > 1:
                average = mean["means"]
                rows.append(
                    ("", "mean", f"{average['found']} of {average['markers']}", "", *_errors(average))
                )
            errors = ("distance [m]", "position [mm]", "angle [deg]", "corners [px]")
            heads = ("image", "marker", "found", *errors)
            first = int(len(results) == 1)  # a single image needs no column for its name
            rows = [row[first:] for row in rows]
            print_table(console(False), f"Distances and errors, {self.scene}", heads[first:], rows)
        return 0

    def _images(self, path: str, scene: "Scene | None") -> "Iterator[tuple[str, np.ndarray, Scene | None]]":
        """Name, image, and scene at the time of the image."""
        from fidsplat.images.files import is_video, read_images
        from fidsplat.render.flight import RECORD, scene_of_frame

        if path.endswith(".mcap") or (path_of(path) / "metadata.yaml").is_file():
            yield from self._log_images(path, scene)
            return
        if scene is not None and is_video(path):
            raise InputError(
                f"--scene must be given with images of known poses, got the video {path}; give the folder of "
                "the flight, or its log"
            )
        folder = path_of(path)
        for name, image in read_images(folder / "rgb" if (folder / RECORD).is_file() else path):
            yield name, image, None if scene is None else scene_of_frame(scene, Path(name))

    def _log_images(
        self, path: str, scene: "Scene | None"
    ) -> "Iterator[tuple[str, np.ndarray, Scene | None]]":
        from fidsplat.logs import log_images, log_poses
        from fidsplat.render.flight import scene_at

        poses = {} if scene is None else log_poses(path)
        for image in log_images(path, self.topic):
            then = scene
            if scene is not None:
                pose = poses.get((image.frame, image.stamp))
                if pose is None:
                    raise InputError(
                        f"{path} must have a pose of {image.frame!r} in /tf at the time of {image.name} for "
                        "--scene, got none; detect without --scene"
                    )
                then = scene_at(scene, pose, image.stamp / 1e9)
            yield image.name, image.image, then

    def _detect(
        self, name: str, image: "np.ndarray", scene: "Scene | None"
    ) -> tuple[dict[str, Any], list["Reading"], list["BundleReading"]]:
        """Codes of an image for JSON, and readings of the scene's markers and bundles."""
        from fidsplat.vision.bundles import read_bundles
        from fidsplat.vision.detect import detect
        from fidsplat.vision.readback import read_back

        families = self.family or None
        facts: dict[str, Any] = {"image": name, "width": image.shape[1], "height": image.shape[0]}
        if scene is None:
            return facts | {"detections": [_describe(code) for code in detect(image, families)]}, [], []
        try:
            readings, others = read_back(image, scene, families=families)
        except InputError as error:
            raise InputError(f"{name} and {self.scene}: {error}") from None
        detections = [reading.detection for reading in readings if reading.detection is not None]
        facts["detections"] = [_describe(code) for code in (*detections, *others)]
        facts["markers"] = [reading.as_dict() for reading in readings]
        facts["not_in_scene"] = [code.name for code in others]
        assert scene.camera is not None
        bundles = read_bundles(readings, scene.camera)
        if bundles:
            facts["bundles"] = [bundle.as_dict() for bundle in bundles]
        return facts, readings, bundles


def _print_codes(results: list[dict[str, Any]]) -> None:
    """Print the codes of all images, with a column for the image if there are several."""
    first = int(len(results) == 1)  # a single image needs no column for its name
    title = results[0]["image"] if first else f"{len(results)} images"
    rows = []
    for result in results:
        for code in result["detections"]:
            corners = " ".join(f"({x:.2f}, {y:.2f})" for x, y in code["corners"])
            rows.append((result["image"], code["name"], corners)[first:])
    if not rows:
        console(False).print(f"no code found in {title}; --family selects other tags", markup=False)
        return
    print_table(console(False), title, ("image", "code", "corners [px]")[first:], rows)


def _describe(code) -> dict[str, Any]:
    return {key: getattr(code, key) for key in ("name", "kind", "family", "id", "payload", "corners")}


_ERRORS = (("position_error_mm", 2), ("angle_error_deg", 3), ("corner_error_px", 3))


def reading_row(reading: "Reading") -> tuple[str, ...]:
    facts = reading.as_dict()
    verdict, fraction = "yes" if facts["found"] else "no", facts["visible"]
    if fraction == 0 and not facts["found"]:
        verdict = "faces away" if reading.tilt > math.pi / 2 else "not in view"
    elif fraction <= 0.995:
        verdict += f", {100 * fraction:.0f} % in view"
    return (facts["marker"], verdict, f"{facts['distance_m']:.3f}", *_errors(facts))


def _bundle_row(reading: "BundleReading") -> tuple[str, ...]:
    facts = reading.as_dict() | {"corner_error_px": None}
    count = f"{facts['found']} of {facts['markers']}"
    return (f"bundle {facts['bundle']}", count, f"{facts['distance_m']:.3f}", *_errors(facts))


def _errors(facts: dict[str, Any]) -> tuple[str, ...]:
    return tuple("-" if facts[key] is None else f"{facts[key]:.{digits}f}" for key, digits in _ERRORS)
