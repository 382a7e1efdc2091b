"""Command `fidsplat localise`: find the poses of photographs in a scene."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import tyro

from fidsplat.commands.options import Device, Json, Overwrite, parse_numbers
from fidsplat.commands.output import console, report, show_progress
from fidsplat.commands.scenes import load_scene_file
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of, refuse_existing

if TYPE_CHECKING:
    import numpy as np

    from fidsplat.cameras import Camera
    from fidsplat.localisation import Localisation


@dataclass
class Localise:
    """Find the poses of photographs in a scene, with covariance.

    The scene's camera has the size, intrinsics and lens of the photographs. The initial pose is --start; if
    no pose is found from it, the pose from the scene's markers in the photograph, or the most similar view of
    --candidates and of the previous photograph. Direct image alignment refines it, independently of exposure
    and white balance. Deviations are standard deviations. A pose is found if 60 % of the textured blocks of
    the image match the scene, or 40 % and detected markers or a small deviation confirm the pose. The exit
    status is 1 if no pose is found, and 2 if no image has an initial pose. Ctrl-C writes the poses found so
    far.

    Examples:
      fidsplat localise photo.jpg --scene scene.toml
      fidsplat localise photo.jpg --scene scene.toml --start 0.1,0,-1.5,1,0,0,0 --json
      fidsplat localise stills/ --scene scene.toml --candidates sparse/0 -o poses.tum
    """

    images: tyro.conf.Positional[tuple[str, ...]]
    """IMAGE: photograph, folder of photographs, or video"""
    scene: str
    """SCENE: scene file, with the camera of the photographs"""
    start: str | None = None
    """X,Y,Z,QW,QX,QY,QZ: initial pose of the camera in the world, metres and a unit quaternion"""
    candidates: str | None = None
    """FILE: candidates of the initial pose: COLMAP, transforms.json or a trajectory, e.g. of training"""
    out: str | None = None
    """FILE: also write the found poses: .tum (times are numbers of images, from 0), .kitti (only if
    each image has a pose), .json (transforms.json) or a folder (COLMAP)"""
    max_side: int = 320
    """N: reduce larger photographs to this number of pixels along the larger side; more are more accurate and
    take longer"""
    overwrite: Overwrite = False
    device: Device = None
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.formats.trajectories import check_trajectory_file
        from fidsplat.images.files import count_images, read_images
        from fidsplat.scenes.sources import cameras_of

        if not self.images:
            raise InputError("IMAGE must be at least one photograph, folder or video, got none")
        if path_of(self.scene).suffix.lower() != ".toml":
            raise InputError(
                "--scene must be a scene file (.toml) with the camera of the photographs, got "
                f'{self.scene}; write one with [camera] and [[splats]] file = "{self.scene}"'
            )
        start = None
        if self.start is not None:
            start = parse_numbers("--start", self.start, "7 numbers X,Y,Z,QW,QX,QY,QZ", 7)
        scene = load_scene_file(self.scene, "of the photographs")
        camera = scene.camera
        assert camera is not None
        if self.out is not None:
            check_trajectory_file(self.out, camera)
            refuse_existing(path_of(self.out), self.overwrite)
        candidates = [] if self.candidates is None else cameras_of(self.candidates, scene)
        with console(self.json).status("opening the device"):
            renderer = fs.Renderer(self.device)
            resident = renderer.upload(scene)
        fixed = None if start is None else camera.with_pose(camera_to_world=(start[:3], start[3:]))
        results: dict[str, Localisation | None] = {}
        reasons: dict[str, str] = {}
        previous: list[Camera] = []

        def localise(image: np.ndarray) -> Localisation:
            def at(initial: Camera | None) -> Localisation:
                return fs.localise(
                    image,
                    scene,
                    initial,
                    candidates=[*previous, *candidates],
                    max_side=self.max_side,
                    renderer=renderer,
                    resident=resident,
                )

            localised = at(fixed)
            if fixed is None or localised.found:
                return localised
            try:
                other = at(None)
            except InputError:  # no marker of the scene in the image and no candidate
                return localised
            return other if other.found else localised

        def localise_all() -> Iterator[str]:
            for path in self.images:
                for name, image in read_images(path, reasons):
                    results.update((file, None) for file in reasons if file not in results)
                    try:
                        results[name] = localised = localise(image)
                    except InputError as error:
                        results[name], reasons[name] = None, str(error)
                    else:
                        previous[:] = [localised.camera] if localised.found else []
                        if not localised.found:
                            reasons[name] = _refusal(localised)
                    yield name
                results.update((file, None) for file in reasons if file not in results)

        interrupted = None
        try:
            counts = [count_images(path) for path in self.images]
            total = None if None in counts else sum(map(int, filter(None, counts)))
            for _ in show_progress("images", localise_all(), total, label=lambda name: path_of(name).name):
                pass
        except KeyboardInterrupt as stop:
            if not results:
                raise
            interrupted = stop
        with interrupts.postponed():
            status = self._report(results, reasons, camera, renderer.device.title)
        if interrupted is not None:
            raise interrupted
        return status

    def _report(
        self,
        results: dict[str, Localisation | None],
        reasons: dict[str, str],
        camera: Camera,
        device: str,
    ) -> int:
        """Write the found poses and print all results; returns the exit status."""
        if not any(results.values()):
            different = list(dict.fromkeys(reasons.values()))[:3]
            raise InputError(f"{', '.join(self.images)} and {self.scene}: {'; '.join(different)}")
        found = sum(result is not None and result.found for result in results.values())
        numbered = self.out is None or path_of(self.out).suffix.lower() != ".kitti"
        writable = self.out is not None and found > 0 and (numbered or found == len(results))
        files = [] if self.out is None or not writable else _write(self.out, results, camera)
        facts = [
            {"image": name, "found": False, "start": None}
            | ({} if result is None else result.as_dict())
            | ({"reason": reasons[name]} if name in reasons else {})
            for name, result in results.items()
        ]
        heads = ("image", "found", "position [m]", "± [mm]", "[deg]", "inliers", "start")
        table = (f"Poses in {self.scene}", heads, [_row(result) for result in facts])
        notes = []
        for reason in dict.fromkeys(reasons.values()):
            names = [name for name in reasons if reasons[name] == reason]
            more = f" and {len(names) - 3} more" if len(names) > 3 else ""
            notes.append(f"{', '.join(names[:3])}{more}: {reason}")
        values = {"device": device, "images": facts, "files": files}
        report(self.json, values, *notes, *files, table=table)
        if self.out is not None and not files:
            raise InputError(
                f"a pose must be found to write {self.out}, got none of {len(results)} images"
                if not found
                else f"each image must have a pose to write {self.out}, whose lines have no number, got "
                f"{found} of {len(results)}; write .tum, whose times are the numbers of the images"
            )
        return 0 if found else 1


def _refusal(result: Localisation) -> str:
    """Reason why a pose was refused."""
    from fidsplat.localisation.localise import MAX_DEVIATION

    if result.angle_deviation > MAX_DEVIATION:
        return (
            "the image must determine the pose, got a standard deviation of the rotation above "
            f"{math.degrees(MAX_DEVIATION):.1f} degrees; take a photograph with more texture"
        )
    return (
        "60 % of the textured blocks must match the scene (40 % where markers or a small deviation confirm "
        "the pose), got fewer; check the camera's size, intrinsics and lens, and the splats"
    )


def _row(facts: dict[str, Any]) -> tuple[str, ...]:
    if (start := facts["start"]) is None:
        return (facts["image"], "no", "", "", "", "", "none")
    found = facts["found"]
    return (
        facts["image"],
        "yes" if found else "no",
        " ".join(f"{value:.3f}" for value in facts["position"]),
        f"{facts['position_deviation_mm']:.2f}" if found else "",
        f"{facts['angle_deviation_deg']:.3f}" if found else "",
        f"{100 * facts['inliers']:.0f} %",
        start if ", " not in start else f"{start.count(', ') + 1} markers",
    )


def _write(out: str, results: dict[str, Localisation | None], camera: Camera) -> list[str]:
    """Write the found poses as a trajectory, with the numbers of the images as times; returns the files'
    names."""
    import numpy as np

    from fidsplat.cameras import Trajectory
    from fidsplat.formats import save_trajectory

    poses = {
        name: (number, result.camera.camera_to_world)
        for number, (name, result) in enumerate(results.items())
        if result and result.found
    }
    times, matrices = zip(*poses.values(), strict=True)
    save_trajectory(Trajectory(times, np.array(matrices)), out, camera, list(poses))
    return [out]
