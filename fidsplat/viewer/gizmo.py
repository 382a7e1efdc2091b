"""Target of the page's gizmo: a marker, or the splats of a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fidsplat.scenes import Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.viewer.scene_file import SplatFile

LIVE_LIMIT = 100_000
"""largest number of splats of a file that is rendered while it is dragged; larger files move on release"""
_FILE = "file "


@dataclass(frozen=True, eq=False)
class GizmoTarget:
    """A marker or a splat file that the gizmo moves."""

    kind: str
    """table in the scene file: markers or splats"""
    number: int
    """index of the table"""
    pose: np.ndarray
    """(4, 4) pose at selection"""
    size: float
    """size of the gizmo in metres"""
    animated: bool
    """whether keyframes move it"""
    cloud: int = 0
    """index of the splat file among the scene's clouds"""
    splats: SplatCloud | None = None
    """splats of the file at `pose`; None for a marker"""

    @property
    def live(self) -> bool:
        """Whether the object is rendered while it is dragged."""
        return self.splats is None or len(self.splats) <= LIVE_LIMIT

    def moved(self, scene: Scene, pose: np.ndarray) -> Scene | None:
        """The scene with the target at another pose; None if the scene no longer has it."""
        if self.splats is None:
            if self.number >= len(scene.markers):
                return None
            markers = list(scene.markers)
            markers[self.number] = replace(markers[self.number], pose=pose)
            return replace(scene, markers=tuple(markers))
        if self.cloud >= len(scene.clouds):
            return None
        clouds = list(scene.clouds)
        clouds[self.cloud] = self.splats.transformed(pose @ np.linalg.inv(self.pose))
        return replace(scene, clouds=tuple(clouds))


def target_names(scene: Scene, splat_files: Sequence[SplatFile]) -> list[str]:
    """Names of the markers and of the splat files of the scene file."""
    names = [f"{placed.label}: {placed.marker.spec}" for placed in scene.markers]
    names += [f"{_FILE}{k + 1}: {body.file}" for k, body in enumerate(splat_files)]
    return [name[:60] for name in names]


def find_target(scene: Scene, splat_files: Sequence[SplatFile], name: str) -> GizmoTarget | None:
    """The target of a name of `target_names`; None if the scene no longer has it."""
    number = int(name.removeprefix(_FILE).partition(":")[0]) - 1
    if not name.startswith(_FILE):
        if number not in range(len(scene.markers)):
            return None
        placed = scene.markers[number]
        return GizmoTarget(
            "markers", number, placed.pose, 1.5 * placed.marker.size, placed.motion is not None
        )
    if number not in range(min(len(splat_files), len(scene.clouds))):
        return None
    body, splats = splat_files[number], scene.clouds[number]
    low, high = splats.bounds() if len(splats) else (np.zeros(3), np.ones(3))
    size = 0.3 * float(np.linalg.norm(high - low))
    return GizmoTarget("splats", body.table, body.pose, size, number in scene.cloud_motions, number, splats)
