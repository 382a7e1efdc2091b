"""What the page shows over our pictures: outlines and names of markers, camera frusta, and the gizmo that
moves a marker."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.splats.rotations import matrix_to_quaternion, rigid_matrix

_OUTLINE = (255, 60, 200)
_CAMERA, _KEYFRAME = (40, 120, 255), (255, 160, 0)
_MANY = 60
"""frusta of one trajectory at most"""


class Nodes:
    """The nodes of a viser page (its `scene`), by the scene that is drawn."""

    def __init__(self, page: Any) -> None:
        self._page = page
        self._shown: list[Any] = []
        self._gizmo: Any = None
        self._frusta: list[Any] = []
        self.visible = True

    def show(self, scene: Scene, overlay: bool) -> None:
        """Outlines and names of the scene's markers, and its camera; none where the lens is not the page's
        own (overlay False), as they would lie beside what is drawn."""
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

    def show_keyframes(self, camera: Camera | None, poses: Iterable[np.ndarray]) -> None:
        """Frusta of keyframes, camera to world (4, 4)."""
        for node in self._frusta:
            node.remove()
        poses = list(poses)
        some = poses[:: max(1, -(-len(poses) // _MANY))]
        self._frusta = [
            self._frustum(f"/keyframes/{k}", camera, pose, _KEYFRAME, 0.05) for k, pose in enumerate(some)
        ]

    def hold(self, pose: np.ndarray | None, size: float, moved: Callable[[np.ndarray, bool], None]) -> None:
        """A gizmo of so many metres at a pose (4, 4); moved is called with the pose to which it was dragged
        and whether it was let go. None: none."""
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

        def tell(event: Any) -> None:
            position, wxyz = np.asarray(gizmo.position, float), np.asarray(gizmo.wxyz, float)
            if np.isfinite([*position, *wxyz]).all() and wxyz.any():  # a message may say anything
                moved(rigid_matrix(position, wxyz), event.phase == "end")

        gizmo.on_update(tell)

    def _outline(self, placed: PlacedMarker) -> Any:
        """Its edges; its name goes with them."""
        name = f"/markers/{placed.label}"
        corners = np.asarray(placed.marker.corners, np.float64)
        around = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
        frame = {"wxyz": matrix_to_quaternion(placed.pose[:3, :3]), "position": placed.pose[:3, 3]}
        lines = self._page.add_line_segments(
            name, around, _OUTLINE, thickness=2.0, thickness_units="screen", **frame
        )
        spec = placed.marker.spec
        top = (corners[0] + corners[1]) / 2  # above its upper edge, where it covers no module
        text = spec if len(spec) <= 40 else f"{spec[:37]}..."
        self._page.add_label(f"{name}/name", text, position=top, anchor="bottom-center")
        return lines

    def _frustum(self, name: str, camera: Camera | None, pose: np.ndarray, color: Any, scale: float) -> Any:
        width, height, fy = (4, 3, 3) if camera is None else (camera.width, camera.height, camera.fy)
        return self._page.add_camera_frustum(
            name,
            fov=float(2 * np.arctan(height / 2 / fy)),
            aspect=width / height,
            scale=scale,
            thickness=2.0,
            thickness_units="screen",  # from inside, where the page begins, only its edges are seen
            color=color,
            wxyz=matrix_to_quaternion(pose[:3, :3]),
            position=pose[:3, 3],
        )
