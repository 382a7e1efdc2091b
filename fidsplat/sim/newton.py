"""Rigs with the bodies of all worlds of a Newton model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.environment import ExternalDepth
from fidsplat.render.device_surface import device_surface
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import Scene
from fidsplat.sim.poses import OPENGL, compose
from fidsplat.sim.rig import Rig, RigCamera, RigImages
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.arguments import instance
from fidsplat.util.errors import InputError, unknown

try:
    import newton as _newton  # type: ignore[import-not-found]
    import warp as _warp  # type: ignore[import-not-found]
except ImportError as error:
    raise InputError(f"cannot import Newton ({error}); pip install 'fidsplat[tiled]'") from None

newton: Any = _newton  # type checkers do not know their names
wp: Any = _warp
SHAPE = -2
"""label of shape 0 among `meshes`; shape i of the model has SHAPE - i"""
SHAPE_OFFSET = 2e-3
"""metres by which shapes are moved away from the camera"""
_TO_XYZW, _TO_WXYZ = [0, 1, 2, 4, 5, 6, 3], [0, 1, 2, 6, 3, 4, 5]


class NewtonRig(Rig):
    """A rig with splats and cameras attached to the bodies of a Newton model, rendered in all its worlds.

    Args:
        model: newton.Model whose worlds have the same bodies.
        scene: splats and markers; those with a label in `bodies` in the frame of their body.
        bodies: {label of splats: label of the body in the first world, or of a global body}.
        cameras, renderer, rest, outputs: as in `Rig`.

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
        if len({len(own) for own in rows}) > 1:
            raise InputError(
                f"the worlds of a model must have the same bodies, got {sorted({len(own) for own in rows})} "
                "bodies; make a rig for each kind of world"
            )
        names = [model.body_label[k] for k in rows[0]]
        for name in self.bodies:
            if name not in names:
                raise InputError(unknown("body", name, names))
        self._rows = np.stack(rows)[:, [names.index(name) for name in self.bodies]]

    def poses(self, state: Any) -> np.ndarray:
        """Poses of bodies (world, body, 7). state: newton.State."""
        if self._rows.size and getattr(state, "body_q", None) is None:
            raise InputError(f"state must be a newton.State with bodies, got {state!r}")
        if not self._rows.size:
            return np.zeros((len(self._rows), 0, 7))
        return state.body_q.numpy()[self._rows][..., _TO_WXYZ].astype(np.float64)

    def render(  # type: ignore[override]
        self,
        state: Any,
        cameras: Mapping[str, Any] | None = None,
        *,
        outputs: Iterable[str] | None = None,
        external_depths: Mapping[str, Sequence[ExternalDepth] | ExternalDepth] | None = None,
        mask: Any = None,
        meshes: Any = False,
    ) -> RigImages:
        """Render the images of all cameras in all worlds.

        Args:
            state: newton.State.
            cameras, outputs, external_depths, mask: as in `Rig.render`.
            meshes: whether the model's shapes, rendered by Newton, are composited with the splats by depth;
                or the newton.sensors.SensorCamera that renders them, with its lights. Shape i of the model
                has the label `SHAPE` - i. Shapes are moved 2 mm away from the camera, so that markers on
                their surfaces are visible.

        Raises:
            InputError: as `Rig.render`; meshes with external_depths, or with a camera that has a lens.
        """
        bodies, views = self.poses(state), dict(cameras or {})
        count = len(bodies)
        given = {name: bodies[:, k] for k, name in enumerate(self.bodies)}
        views = {name: self._mounted_pose(name, given, count) for name in self.cameras} | views
        if meshes is not False:
            if external_depths is not None:
                raise InputError("meshes and external_depths exclude each other; give one of them")
            external_depths = self._shapes(state, views, meshes)
        return super().render(given, views, outputs=outputs, external_depths=external_depths, mask=mask)

    def _shapes(self, state: Any, views: Mapping[str, Any], meshes: Any) -> dict[str, ExternalDepth]:
        """Images of the model's shapes for each camera and all worlds."""
        if meshes is True:
            self._sensor = meshes = self._sensor or newton.sensors.SensorCamera(self._model)
        instance("meshes", meshes, newton.sensors.SensorCamera, "True or a newton.sensors.SensorCamera")
        self._model.bvh_refit_shapes(state)
        device, found = self._model.device, {}
        for name, each in self.cameras.items():
            camera = each.camera
            if camera.lens is not None:
                raise InputError(
                    f"a camera with meshes must be a pinhole, got {name!r} with the lens {camera.lens.kind}"
                )
            size = camera.width, camera.height
            if name not in self._rays:
                numbers = camera.fx, camera.fy, camera.cx, camera.cy
                self._rays[name] = meshes.compute_camera_rays_pinhole_opencv(*size, *numbers, device=device)
            poses = compose(views[name], OPENGL)[:, _TO_XYZW]
            arrays = [
                make(len(poses), *size)
                for make in (
                    meshes.allocate_image_color,
                    meshes.allocate_image_depth_forward,
                    meshes.allocate_image_shape_index,
                )
            ]
            images = dict(
                zip(("color_image", "forward_depth_image", "shape_index_image"), arrays, strict=True)
            )
            transforms = wp.array(poses.astype(np.float32), dtype=wp.transformf, device=device)
            meshes.update(state, transforms, self._rays[name], **images)
            flat = [array.reshape((len(poses), -1)) for array in arrays]
            flat[2] = flat[2].view(wp.int32)
            found[name] = device_surface(
                self.renderer, *flat, size[::-1], red=0, label=SHAPE, offset=SHAPE_OFFSET
            )
        return found
