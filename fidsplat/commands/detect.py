"""`fidsplat detect`."""

from dataclasses import asdict, dataclass, replace
from typing import Annotated

import tyro

from fidsplat.commands.output import Json, console, late_progress, option, print_json, print_table
from fidsplat.errors import InputError


@dataclass
class Detect:
    """Find AprilTag, ArUco and QR codes in a picture.

    Prints what they say and the corners of each, in pixels: top left, top right, bottom right, bottom left as
    printed, the centre of the first pixel at (0.5, 0.5). With --scene also where each marker of that scene
    was seen from its camera, and how far that is from the truth: of a scene that moves, from where things are
    at its shutter's time, when the middle row is exposed.

    Examples:
      fidsplat detect photo.jpg
      fidsplat detect photo.png --family 16h5 --family 7x7_1000
      fidsplat detect scene.png --scene scene.toml --json
    """

    image: Annotated[tyro.conf.Positional[str], option("IMAGE", "PNG, JPEG, BMP, TIFF or WebP")]
    family: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        option(
            "FAMILY",
            "tag family to look for, once more for each (default: the scene's, or 36h11 25h9 4x4_50 5x5_100 "
            "6x6_250 7x7_250)",
        ),
    ] = ()
    scene: Annotated[str | None, option("SCENE.toml", "the scene that the picture shows")] = None
    json: Json = False

    def run(self) -> int:
        from fidsplat.vision.detect import detect
        from fidsplat.vision.dictionaries import parse_family
        from fidsplat.vision.images import read_image

        for name in self.family:
            parse_family(name)
        image = read_image(self.image)
        scene = self._load_scene(image.shape) if self.scene is not None else None
        families = self.family or None
        if scene is not None and families is None:
            from fidsplat.experiments.readback import families_of

            families = families_of(placed.marker for placed in scene.markers)
        found = detect(image, families)
        result = {
            "image": self.image,
            "width": image.shape[1],
            "height": image.shape[0],
            "detections": [{"name": code.name, **asdict(code)} for code in found],
        }
        readings = []
        if scene is not None:
            from fidsplat.experiments.readback import read_back

            camera, markers = _standing(scene)
            readings, others = read_back(found, markers, camera)
            result["markers"] = [reading.as_dict() for reading in readings]
            result["not_in_scene"] = [code.name for code in others]
        if self.json:
            print_json(result)
            return 0
        where = console(False)
        if not found:
            where.print(f"no code found in {self.image}; --family looks for other tags", markup=False)
        else:
            corner = [" ".join(f"({x:.2f}, {y:.2f})" for x, y in code.corners) for code in found]
            rows = [(code.name, at) for code, at in zip(found, corner, strict=True)]
            print_table(where, self.image, ("code", "corners [px]"), rows)
        if readings:
            heads = ("marker", "found", "distance [m]", "position [mm]", "angle [deg]", "corners [px]")
            title = f"Against {self.scene}: distance, and errors"
            print_table(where, title, heads, map(reading_row, readings))
        return 0

    def _load_scene(self, shape: tuple[int, ...]):
        import fidsplat as fs

        with late_progress(console(True)) as progress:
            scene = fs.Scene.load(str(self.scene), progress=progress)
        if scene.camera is None:
            raise InputError(f"{self.scene} has no [camera] table, so the pose of its markers is unknown")
        size = (scene.camera.width, scene.camera.height)
        if size != (shape[1], shape[0]):
            raise InputError(
                f"{self.image} has {shape[1]} x {shape[0]} pixels and the camera of {self.scene} {size[0]} x "
                f"{size[1]}; give the picture that this scene was rendered to"
            )
        return scene


def _standing(scene):
    """The camera and the markers of a scene where they are at its shutter's time."""
    time = 0.0 if scene.shutter is None else scene.shutter.time
    markers = [
        marker if marker.motion is None else replace(marker, pose=marker.motion(time))
        for marker in scene.markers
    ]
    return scene.motion.moved(scene.camera, time), markers


def reading_row(reading) -> tuple[str, ...]:
    """One row of a table of readings."""
    facts = reading.as_dict()

    def number(key: str, digits: int) -> str:
        return "-" if facts[key] is None else f"{facts[key]:.{digits}f}"

    return (
        facts["marker"],
        "yes" if facts["found"] else "no",
        number("distance_m", 3),
        number("position_error_mm", 2),
        number("angle_error_deg", 3),
        number("corner_error_px", 3),
    )
