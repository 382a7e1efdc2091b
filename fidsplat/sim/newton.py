"""Rigs with the bodies of all worlds of a Newton model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.render.device_external_depth import device_external_depth
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import Scene
from fidsplat.sim.poses import OPENGL, compose
from fidsplat.sim.rig import RigCamera, SimulatorRig
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.arguments import instance
from fidsplat.util.errors import InputError, required_package, unknown

with required_package("Newton", "tiled"):
    import newton as _newton  # type: ignore[import-not-found]
    import warp as _warp  # type: ignore[import-not-found]

newton: Any = _newton  # type checkers do not know their names
wp: Any = _warp
_TO_XYZW, _TO_WXYZ = [0, 1, 2, 4, 5, 6, 3], [0, 1, 2, 6, 3, 4, 5]


class NewtonRig(SimulatorRig):
    """A rig with splats and cameras attached to the bodies of a Newton model, rendered in all its worlds.

    Args:
        model: newton.Model whose worlds have the same bodies.
        scene: splats and markers; splats with a label in `bodies` are in the frame of their body.
        bodies: {label of splats: label of the body in the first world, or of a global body}.
        cameras, renderer, rest, outputs: as in `Rig`.

    The state that `render` reads is a newton.State. Its `meshes` may be the newton.sensors.SensorCamera that
    renders the shapes, with its lights; for pinhole cameras. Shape i of the model has the label -2 - i.

    Raises:
        InputError: as `Rig`; a body that the model does not have, worlds with different bodies.
    """

    def __init__(
        self,
        model: Any,
        scene: Scene | SplatCloud,
        bodies: Mapping[int, str] | None = None,
        cameras: Mapping[str, Camera | RigCamera] | Iterable[tuple[str, Camera | RigCamera]] = (),
        *,
        renderer: Renderer | None = None,
        rest: Mapping[str, Any] | None = None,
        outputs: Iterable[str] | None = None,
    ) -> None:
        instance("model", model, newton.Model, "a newton.Model")
        super().__init__(scene, bodies, cameras, renderer=renderer, rest=rest, outputs=outputs)
        self._model, self._sensor, self._rays = model, None, dict[str, Any]()
        worlds = model.body_world.numpy() if model.body_count else np.zeros(0, int)
        rows = [np.flatnonzero((worlds == k) | (worlds < 0)) for k in range(max(model.world_count, 1))]
        if len({len(row) for row in rows}) > 1:
            counts = ", ".join(map(str, sorted({len(row) for row in rows})))
            raise InputError(
                f"all worlds of a model must have the same number of bodies, got {counts}; create one "
                "NewtonRig per group of equal worlds"
            )
        names = [model.body_label[k] for k in rows[0]]
        for name in self.bodies:
            if name not in names:
                raise InputError(unknown("body", name, names))
        self._rows = np.stack(rows)[:, [names.index(name) for name in self.bodies]]

    def poses(self, state: Any) -> tuple[np.ndarray, None]:
        """Poses of bodies (world, body, 7). state: newton.State."""
        if not hasattr(state, "body_q"):
            raise InputError(f"state must be a newton.State, got {state!r}")
        every = np.zeros((0, 7)) if state.body_q is None else state.body_q.numpy()
        return every[self._rows][..., _TO_WXYZ].astype(np.float64), None

    def _geometry(self, state: Any, poses: Mapping[str, np.ndarray], meshes: Any) -> Mapping[str, Any]:
        self._pinholes()
        if meshes is True:
            self._sensor = meshes = self._sensor or newton.sensors.SensorCamera(self._model)
        instance("meshes", meshes, newton.sensors.SensorCamera, "True or a newton.sensors.SensorCamera")
        self._model.bvh_refit_shapes(state)
        device, depth_images = self._model.device, {}
        for name, each in self.cameras.items():
            camera = each.camera
            size = camera.width, camera.height
            intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
            if name not in self._rays:
                self._rays[name] = meshes.compute_camera_rays_pinhole_opencv(
                    *size, *intrinsics, device=device
                )
            places = compose(poses[name], OPENGL)[:, _TO_XYZW].astype(np.float32)
            kinds = {"color": wp.uint32, "forward_depth": wp.float32, "shape_index": wp.uint32}
            images = {
                f"{kind}_image": meshes.allocate_image(len(places), *size, dtype)
                for kind, dtype in kinds.items()
            }
            transforms = wp.array(places, dtype=wp.transformf, device=device)
            meshes.update(state, transforms, self._rays[name], **images)
            colors, depths, ids = (array.reshape((len(places), -1)) for array in images.values())
            ids = ids.view(wp.int32)
            depth_images[name] = device_external_depth(
                self.renderer, colors, depths, ids, (camera.height, camera.width), red_bit=0
            )
        return depth_images
