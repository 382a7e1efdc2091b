"""`fidsplat localise`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import tyro

from fidsplat.commands.options import Device, Json, Overwrite, parse_numbers
from fidsplat.commands.output import console, report, steps_shown
from fidsplat.commands.scenes import load_scene_file
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of, refuse_existing

if TYPE_CHECKING:
    from fidsplat.cameras import Camera
    from fidsplat.localisation import Localisation


@dataclass
class Localise:
    """Find the poses of photographs in a scene, with covariance.

    The scene's camera has the size, intrinsics and lens of the photographs. The initial pose is --start, else
    the pose from the scene's markers in the photograph, else the most similar view of --candidates and of the
    previous photograph. Direct image alignment refines it, independently of exposure and white balance.
    Deviations are standard deviations. A pose is found if 60 % of the textured blocks of the image match the
    scene, or 40 % and detected markers or a small deviation confirm the pose. The exit status is 1 if no pose
    is found.

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
    """FILE: also write the found poses: .tum (times are numbers of images, from 0), .kitti, .json
    (transforms.json) or a folder (COLMAP)"""
    max_side: int = 320
    """N: reduce larger photographs to this number of pixels along the larger side; more are more accurate and
    take longer"""
    overwrite: Overwrite = False
    device: Device = None
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.formats.trajectories import check_trajectory_file
        from fidsplat.images.files import read_images
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
        results: dict[str, Localisation | None] = {}
        reasons: dict[str, str] = {}
        previous: list[Camera] = []
        with steps_shown(console(True), "localising") as show:
            for path in self.images:
                for name, image in read_images(path, reasons):
                    show(f"localising {name}")
                    results |= {file: None for file in reasons if file not in results}
                    at = None if start is None else camera.with_pose(camera_to_world=(start[:3], start[3:]))
                    try:
                        localised = fs.localise(
                            image,
                            scene,
                            at,
                            candidates=[*previous, *candidates],
                            max_side=self.max_side,
                            renderer=renderer,
                            resident=resident,
                        )
                    except InputError as error:
                        results[name], reasons[name] = None, str(error)
                        continue
                    results[name] = localised
                    previous = [localised.camera] if localised.found else []
        results |= {file: None for file in reasons if file not in results}
        if not any(results.values()):
            different = list(dict.fromkeys(reasons.values()))[:3]
            raise InputError(f"{', '.join(self.images)} and {self.scene}: {'; '.join(different)}")
        files = [] if self.out is None else _write(self.out, results, camera)
        facts = [
            {"image": name, "found": False, "start": None}
            | ({"reason": reasons[name]} if result is None else result.as_dict())
            for name, result in results.items()
        ]
        heads = ("image", "found", "position [m]", "± [mm]", "[deg]", "inliers", "start")
        table = (f"Poses in {self.scene}", heads, [_row(result) for result in facts])
        notes = []
        for reason in dict.fromkeys(reasons.values()):
            names = [name for name in reasons if reasons[name] == reason]
            more = f" and {len(names) - 3} more" if len(names) > 3 else ""
            notes.append(f"{', '.join(names[:3])}{more}: {reason}")
        refused = sum(result is not None and not result.found for result in results.values())
        if refused:
            notes.append(
                f"{refused} of {len(facts)} photographs without a pose: less than 60 % of the textured "
                "blocks match (40 % where markers or a small deviation confirm the pose); check the camera's "
                "size, intrinsics and lens, and the splats"
            )
        if files and path_of(files[0]).suffix.lower() == ".kitti" and (refused or reasons):
            notes.append(f"{files[0]} has only the found poses, without names and times; write .tum instead")
        device = renderer.device.title
        values = {"device": device, "images": facts, "files": files}
        report(self.json, values, *notes, *files, table=table)
        if self.out is not None and not files:
            raise InputError(f"a pose must be found to write {self.out}, got none of {len(results)} images")
        return 0 if any(result["found"] for result in facts) else 1


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
    if not poses:
        return []
    times, matrices = zip(*poses.values(), strict=True)
    save_trajectory(Trajectory(times, np.array(matrices)), out, camera, list(poses))
    return [out]
