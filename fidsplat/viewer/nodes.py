"""3D overlays of the page: outlines and names of markers, camera frusta, and the gizmo."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import matrix_to_quaternion, rigid_matrix
from fidsplat.viewer.scene_file import SplatFile

_OUTLINE = (255, 60, 200)
_CAMERA, _KEYFRAME = (40, 120, 255), (255, 160, 0)
_MANY = 60
"""maximum number of frusta of a trajectory"""


class Nodes:
    """3D overlays of a viser page (its `scene`)."""

    def __init__(self, page: Any) -> None:
        self._page = page
        self._shown: list[Any] = []
        self._gizmo: Any = None
        self._frusta: list[Any] = []
        self.visible = True

    def show(self, scene: Scene, overlay: bool) -> None:
        """Show outlines and names of the scene's markers, and its camera.

        overlay: False hides them, for images of lenses, which the page's pinhole overlay would not match.
        """
        for node in self._shown:
            node.remove()
        self._shown = []
        if not overlay or not self.visible:
            return
        for placed in scene.markers:
            self._shown.append(self._outline(placed))
        if scene.camera is not None and scene.camera.lens is None:
            pose = np.linalg.inv(scene.camera.world_to_camera)
            self._shown.append(self._frustum("/scene camera", scene.camera, pose, _CAMERA, 0.1))

    def within(self, position: Iterable[float], distance: float) -> bool:
        """Whether there are outlines or frusta, and all are within a distance [m] of a position."""
        positions = np.array([node.position for node in (*self._shown, *self._frusta)], float).reshape(-1, 3)
        return len(positions) > 0 and bool(np.linalg.norm(positions - position, axis=1).max() < distance)

    def show_keyframes(self, camera: Camera | None, poses: Iterable[np.ndarray]) -> None:
        """Show frusta of camera-to-world poses (4, 4)."""
        for node in self._frusta:
            node.remove()
        poses = list(poses)
        shown = poses[:: max(1, -(-len(poses) // _MANY))]
        self._frusta = [
            self._frustum(f"/keyframes/{k}", camera, pose, _KEYFRAME, 0.05) for k, pose in enumerate(shown)
        ]

    def show_gizmo(
        self, pose: np.ndarray | None, size: float, moved: Callable[[np.ndarray, bool], None]
    ) -> None:
        """Show a gizmo at a pose (4, 4), or hide it for None.

        size: size of the gizmo [m]. moved: called with the new pose and whether the gizmo was released.
        """
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        if pose is None:
            return
        gizmo = self._page.add_transform_controls(
            "/gizmo",
            scale=size,
            wxyz=matrix_to_quaternion(pose[:3, :3]),
            position=pose[:3, 3],
            depth_test=False,
        )
        self._gizmo = gizmo

        def update(event: Any) -> None:
            position, wxyz = np.asarray(gizmo.position, float), np.asarray(gizmo.wxyz, float)
            if np.isfinite([*position, *wxyz]).all() and wxyz.any():  # messages of a browser are untrusted
                moved(rigid_matrix(position, wxyz), event.phase == "end")

        gizmo.on_update(update)

    def _outline(self, placed: PlacedMarker) -> Any:
        """The edges of a marker, with its name as a child."""
        name = f"/markers/{placed.label}"
        corners = np.asarray(placed.marker.corners, np.float64)
        around = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
        frame = {"wxyz": matrix_to_quaternion(placed.pose[:3, :3]), "position": placed.pose[:3, 3]}
        lines = self._page.add_line_segments(
            name, around, _OUTLINE, thickness=2.0, thickness_units="screen", **frame
        )
        spec = placed.marker.spec
        top = (corners[0] + corners[1]) / 2  # above the upper edge, so that no module is covered
        text = spec if len(spec) <= 40 else f"{spec[:37]}..."
        self._page.add_label(f"{name}/name", text, position=top, anchor="bottom-center", depth_test=True)
        return lines

    def _frustum(self, name: str, camera: Camera | None, pose: np.ndarray, color: Any, scale: float) -> Any:
        wide, tall = (4 / 3, 1.0) if camera is None else (camera.width / camera.fx, camera.height / camera.fy)
        return self._page.add_camera_frustum(
            name,
            fov=float(2 * np.arctan(tall / 2)),
            aspect=wide / tall,
            scale=scale,
            thickness=2.0,
            thickness_units="screen",  # thin edges, as the page's first camera is inside this frustum
            color=color,
            wxyz=matrix_to_quaternion(pose[:3, :3]),
            position=pose[:3, 3],
        )


LIVE_LIMIT = 100_000
"""maximum number of splats of a file that is rendered while it is dragged; larger files move on release"""
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
    """whether it has keyframes"""
    cloud: int = 0
    """index of the splat file among the scene's clouds"""
    splats: SplatCloud | None = None
    """splats of the file at `pose`; None for a marker"""

    @property
    def live(self) -> bool:
        """Whether the object is rendered while it is dragged."""
        return self.splats is None or len(self.splats) <= LIVE_LIMIT

    def moved(self, scene: Scene, pose: np.ndarray) -> Scene | None:
        """The scene with the target at another pose; None if the scene no longer has the target."""
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
    """The marker or splat file with a name of `target_names`; None if the scene no longer contains it."""
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
