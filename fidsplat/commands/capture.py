"""Command `fidsplat capture`: make a metric scene from photographs or a video."""

from __future__ import annotations

from dataclasses import dataclass, field
from shlex import quote
from typing import TYPE_CHECKING, Any

import tyro

from fidsplat.commands.options import Json, repeatable
from fidsplat.commands.output import delayed_progress, report
from fidsplat.photographs.dataset import SPLATS
from fidsplat.photographs.settings import CaptureSettings

if TYPE_CHECKING:
    from fidsplat.photographs.steps import Captured

MISSING = 12
"""number of photographs without a camera that are printed"""


@repeatable
@dataclass
class Capture:
    """Make a metric scene from photographs or a video (extra: capture).

    DIR becomes a data set for `fidsplat train`: undistorted images, masks, COLMAP's model in sparse/0, and
    scene.toml. Tags of known size determine the scale. The scene has exact markers instead of them, and
    training ignores their pixels. z is up; the first tag, or the tag of --up, is at the origin. The same
    command resumes; if tags, --up or --scale change, it repeats only the last steps.

    Examples:
      fidsplat capture photos -o bench --tag apriltag:36h11:5=0.16
      fidsplat capture walk.mp4 -o hall --tag qr:door=0.2 --tag apriltag:36h11:6=0.16 --up qr:door
      fidsplat capture photos -o yard --scale a.jpg:812:430,b.jpg:120:655=1.25
      fidsplat train bench -o bench/splats.ply && fidsplat view bench/scene.toml
    """

    photos: tyro.conf.Positional[str]
    """PHOTOS|VIDEO: folder of photographs, or a video"""
    out: str
    """DIR: folder for the data set and its scene file"""
    settings: CaptureSettings = field(default_factory=CaptureSettings)
    overwrite: bool = False
    """restart, also for other photographs"""
    json: Json = False

    def run(self) -> int:
        from fidsplat.photographs.steps import photographs_to_scene

        with delayed_progress() as progress:
            captured = photographs_to_scene(self.photos, self.out, self.settings, progress, self.overwrite)
        facts = _facts(captured)
        return report(self.json, facts, *_words(captured, facts, self.out, self.settings.lens))


def _facts(captured: Captured) -> dict[str, Any]:
    adjusted = captured.adjustment
    facts: dict[str, Any] = {
        "scene": str(captured.files.scene),
        "photographs": captured.photographs,
        "registered": len(captured.model.names),
        "missing": dict(captured.missing),
        "points": len(captured.model.points),
        "reprojection_px": captured.model.reprojection,
        "metric": captured.scale_error is not None,
        "readout_px": captured.readout,
        "doubts": captured.doubts,
        "renamed": {str(file): str(new) for file, new in captured.files.renamed},
        "cameras": [
            {"scene": str(file), "size": [camera.width, camera.height], "fx": camera.fx, "photographs": count}
            for file, camera, count in captured.files.cameras
        ],
    }
    if captured.scale_error is not None:
        facts |= {
            "metres_per_unit": captured.frame.scale,
            "scale_standard_error": captured.scale_error,
        }
    if adjusted is None:
        return facts
    tags = {}
    for spec, pose in zip(adjusted.poses, captured.tags, strict=True):
        views = sum(view.tag == spec for view in adjusted.used)
        scale = adjusted.scales.get(spec)
        tags[spec] = {
            "views": views,
            "rejected": sum(view.tag == spec for view in adjusted.rejected),
            "scale_alone": None if scale is None else scale[0] / adjusted.scale,
            "pose": pose.pose,
        }
    return facts | {"corner_rms_px": adjusted.rms, "tags": tags}


def _words(captured: Captured, facts: dict[str, Any], out: str, lens: str) -> list[str]:
    lines = [
        f"{facts['registered']} of {facts['photographs']} photographs, {facts['points']:,} points, "
        f"reprojection error {facts['reprojection_px']:.2f} px"
    ]
    lines += [f"no camera for {name}: {reason}" for name, reason in captured.missing[:MISSING]]
    if len(captured.missing) > MISSING:
        lines.append(f"no camera for {len(captured.missing) - MISSING} more; --json lists them")
    lines += captured.doubts
    if len(captured.files.cameras) > 1:
        lines += [
            f"{file.name}: {camera.width} x {camera.height}, fx {camera.fx:.0f} px, {count} photographs"
            for file, camera, count in captured.files.cameras
        ]
    if captured.scale_error is None:
        lines.append("lengths are not in metres; give --tag SPEC=METRES, or --scale A,B=METRES")
    else:
        corners = f"; corners of tags {facts['corner_rms_px']:.2f} px" if captured.adjustment else ""
        lines.append(
            f"scale {facts['metres_per_unit']:.6g} m per unit with a standard error of "
            f"{100 * captured.scale_error:.2g} %{corners}"
        )
    if captured.adjustment is not None:
        for spec, tag in facts["tags"].items():
            alone = (
                ""
                if tag["scale_alone"] is None
                else f", scale of this tag alone {100 * (tag['scale_alone'] - 1):+.2f} %"
            )
            others = f", {tag['rejected']} rejected" if tag["rejected"] else ""
            lines.append(f"{spec}: {tag['views']} photographs{others}{alone}")
        lines += [
            f"sizes of {tag} and {other} disagree by {100 * difference:.2g} %; measure their black squares"
            for tag, other, difference in captured.adjustment.disagreements
        ]
    if captured.readout:
        lines.append(
            f"rows are displaced by motion during the readout (rolling shutter), or the lens is not {lens}: "
            f"{captured.readout:.2f} px remain in the errors, and lengths may be wrong by some percent; take "
            "photographs with the camera held still, or give --lens"
        )
    lines += [f"{spec} was not detected" for spec in captured.undetected]
    splats = captured.files.scene.with_name(SPLATS)
    old = {file: new.name for file, new in captured.files.renamed}
    lines += [
        f"{file.name} was edited and is now {name}; copy your changes to the new {file.name}"
        for file, name in old.items()
        if file != splats
    ]
    folder, file, scene = (quote(str(path)) for path in (out, splats, captured.files.scene))
    train, view = f"fidsplat train {folder} -o {file}", f"fidsplat view {scene}"
    if splats in old:
        lines.append(
            f"{splats.name} was trained at other poses and is now {old[splats]}; train again: {train} "
            f"--overwrite; then view it: {view}"
        )
    else:
        lines.append(f"view it: {view}" if splats.exists() else f"train it: {train}; then view it: {view}")
    return lines
