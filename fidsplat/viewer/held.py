"""What the gizmo of a page moves: a marker, or the splats of a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fidsplat.scenes import Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.viewer.edits import Body

LIGHT = 100_000
"""splats of a file that is moved while it is dragged; larger ones once they are let go"""
_FILE = "file "


@dataclass(frozen=True, eq=False)
class Held:
    """What the gizmo moves."""

    kind: str
    """of its table in the scene file: markers or splats"""
    number: int
    """of that table, from 0"""
    pose: np.ndarray
    """(4, 4) where it was when it was taken"""
    size: float
    """metres, of the gizmo"""
    moves: bool
    """by keyframes"""
    cloud: int = 0
    """number of the splat file among the scene's clouds"""
    splats: SplatCloud | None = None
    """of the splat file, at `pose`"""

    @property
    def light(self) -> bool:
        """Whether it is shown while it is dragged."""
        return self.splats is None or len(self.splats) <= LIGHT

    def moved(self, scene: Scene, pose: np.ndarray) -> Scene | None:
        """The scene with it at a pose; None where it is not there any more."""
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


def movable(scene: Scene, bodies: Sequence[Body]) -> list[str]:
    """Names of the markers, and of the splat files of the scene file."""
    names = [f"{placed.label}: {placed.marker.spec}" for placed in scene.markers]
    names += [f"{_FILE}{k + 1}: {body.file}" for k, body in enumerate(bodies)]
    return [name[:60] for name in names]


def held_by(scene: Scene, bodies: Sequence[Body], name: str) -> Held | None:
    """What a name of `movable` is of; None where it is not there any more."""
    number = int(name.removeprefix(_FILE).partition(":")[0]) - 1
    if not name.startswith(_FILE):
        if number not in range(len(scene.markers)):
            return None
        placed = scene.markers[number]
        return Held("markers", number, placed.pose, 1.5 * placed.marker.size, placed.motion is not None)
    if number not in range(min(len(bodies), len(scene.clouds))):
        return None
    body, splats = bodies[number], scene.clouds[number]
    low, high = splats.bounds() if len(splats) else (np.zeros(3), np.ones(3))
    size = 0.3 * float(np.linalg.norm(high - low))
    return Held("splats", body.table, body.pose, size, number in scene.cloud_motions, number, splats)
