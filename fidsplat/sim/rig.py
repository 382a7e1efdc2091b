"""Rig: splats and cameras attached to the bodies of a simulator, rendered in batches of environments."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture, output_names
from fidsplat.capture.environment import ExternalDepth
from fidsplat.capture.sensor import Sensor
from fidsplat.render.frame import FrameBatch
from fidsplat.render.renderer import Renderer
from fidsplat.render.resident import ResidentCloud
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.sim.poses import IDENTITY, check_poses, compose, inverse, matrix_of, pose_of
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.arguments import instance, invalid, whole_number
from fidsplat.util.errors import InputError, MissingOutputError, unknown


@dataclass(frozen=True, eq=False)
class RigCamera:
    """A camera and the body that carries it. Raises InputError for a field of the wrong type."""

    camera: Camera
    """intrinsics and lens; its pose is the mount: world_to_camera without a body, else body_to_camera"""
    body: str | None = None
    """the body that carries it; None: the world"""
    sensor: Sensor | None = None
    """sensor model of rgb, with different noise for every image; None: the scene's"""
    outputs: tuple[str, ...] | None = None
    """names of its output images; None: the rig's"""
    rate: float | None = None
    """frames per second, as information for schedulers; rendering ignores it"""

    def __post_init__(self) -> None:
        instance("camera", self.camera, Camera, remedy="use fs.Camera.pinhole(...)")
        if not isinstance(self.body, str | None):
            raise invalid("the body of a camera", "a name, or None for the world", self.body)
        if not isinstance(self.sensor, Sensor | None):
            raise invalid("the sensor of a camera", "a Sensor or None", self.sensor)
        if self.outputs is not None:
            object.__setattr__(self, "outputs", output_names(self.outputs))

    @property
    def mount(self) -> np.ndarray:
        """Pose of the camera, (7,) body from camera, OpenCV axes."""
        return inverse(pose_of(self.camera.world_to_camera))


class Rig:
    """Splats and cameras attached to bodies by name, rendered in every environment of a simulator.

    Splats with a label in `bodies` are in the frame of their body, or in the world at its `rest` pose; all
    others are static and shared by the environments. A body may have several labels.

    Args:
        scene: splats and markers, with quality, background, fog and sensor. Marker i has the label i + 1.
        bodies: {label: name of the body}.
        cameras: {name: Camera or RigCamera}, or pairs of these.
        renderer: renders the images; None: one for the default device, opened when the first image is
            rendered, so that a process may make a rig and its forks render it.
        rest: {name of a body: pose (7,)} for bodies whose splats are given in the world, at this pose.
        outputs: names of the output images; default the scene's.

    Raises:
        InputError: a label without splats, two cameras of one name, no camera; a scene with moving parts.
    """

    def __init__(
        self,
        scene: Scene | SplatCloud,
        bodies: Mapping[int, str] | None = None,
        cameras: Mapping[str, Camera | RigCamera] | Iterable[tuple[str, Camera | RigCamera]] = (),
        *,
        renderer: Renderer | None = None,
        rest: Mapping[str, Any] | None = None,
        outputs: Iterable[str] | None = None,
    ) -> None:
        self.scene = scene if isinstance(scene, Scene) else Scene((scene,))
        if not self.scene.motion.is_still:
            raise InputError("the scene of a rig must be still, got motion; the simulator moves the bodies")
        if renderer is not None:
            instance("renderer", renderer, Renderer, "an fs.Renderer or None")
        self._renderer = renderer
        self.cameras = _cameras_of(cameras)
        """RigCamera by name, in the order of the images' axis `camera`"""
        self.labels = _bodies_of({} if bodies is None else bodies, self.scene)
        """name of the body by label"""
        mounts = (camera.body for camera in self.cameras.values() if camera.body is not None)
        self.bodies = tuple(dict.fromkeys((*self.labels.values(), *mounts)))
        """names of the bodies whose poses are required, in the order of the axis `body`"""
        self._rest = {}
        if not isinstance(rest, Mapping | None):
            raise invalid("rest", "{name of a body: pose (7,)}", rest)
        for name, pose in ({} if rest is None else rest).items():
            if name not in self.bodies:
                raise InputError(unknown("body", name, self.bodies))
            self._rest[name] = inverse(check_poses(f"rest of {name}", pose, ()))
        self._capture = self.scene.capture.with_(outputs=outputs)
        self._rendered = 0

    @cached_property
    def renderer(self) -> Renderer:
        """The renderer of the images."""
        return Renderer() if self._renderer is None else self._renderer

    @cached_property
    def _cloud(self) -> ResidentCloud:
        """The splats on the device."""
        return self.renderer.upload(self.renderer.lit(self.scene).cloud())

    def render(
        self,
        bodies: Mapping[str, Any] | Any = None,
        cameras: Mapping[str, Any] | Any = None,
        *,
        outputs: Iterable[str] | None = None,
        external_depths: Mapping[str, Sequence[ExternalDepth] | ExternalDepth] | None = None,
        mask: Any = None,
    ) -> RigImages:
        """Render every environment by every camera.

        The images of an environment do not depend on the other environments, bit for bit.

        Args:
            bodies: poses, world from body: {name: (env, 7)} of every body, or (env, body, 7) in the order of
                `Rig.bodies`. None if the rig has no bodies.
            cameras: poses, world from camera, OpenCV axes: {name: (env, 7)} of some cameras, or
                (env, camera, 7). Cameras without one use their mounts.
            outputs: names of the output images; default the rig's.
            external_depths: {camera name: [an ExternalDepth for each environment], or one with the images of
                all}, rendered by another renderer from the same pose.
            mask: (env,) bool; environments with False are not rendered: images are 0, labels -1.

        Raises:
            InputError: an unknown body or camera, a body without a pose, a pose that is not rigid or not
                finite, numbers of environments that differ.
        """
        body_poses = _by_name("body", bodies, self.bodies)
        views = _by_name("camera", cameras, tuple(self.cameras))
        missing = [name for name in self.bodies if name not in body_poses]
        if missing:
            raise InputError(
                f"bodies must have a pose for every body ({', '.join(self.bodies)}), got none for "
                f"{missing[0]!r}"
            )
        count = _environments(body_poses, views)
        poses = {name: self._mounted_pose(name, body_poses, count) for name in self.cameras} | views
        names = None if outputs is None else output_names(outputs)
        external = {name: () for name in self.cameras} | self._external_of(external_depths, count)
        groups = {
            label: compose(body_poses[name], self._rest[name]) if name in self._rest else body_poses[name]
            for label, name in self.labels.items()
        }
        batches = {}
        for name in self.cameras:
            captures: Any = self._captures_of(name, names, external[name], count)
            batches[name] = self.renderer.render_batch(
                self._cloud,
                captures[0] if len(captures) == 1 else captures,
                poses=poses[name],
                groups=groups,
                mask=mask,
            )
        self._rendered += count
        return RigImages(self, batches, body_poses, poses)

    def outputs_of(self, camera: str) -> tuple[str, ...]:
        """Names of a camera's output images, when `render` is called without `outputs`."""
        _known("camera", camera, self.cameras)
        return self.cameras[camera].outputs or self._capture.outputs

    def placed(self, bodies: Mapping[str, np.ndarray]) -> list[PlacedMarker]:
        """The scene's markers for these poses (7,) of the bodies."""
        if not isinstance(bodies, Mapping):
            raise invalid("bodies", "{name of a body: pose (7,)}", bodies)
        placed = []
        for marker in self.scene.markers:
            name = self.labels.get(marker.label)
            if name is not None and name not in bodies:
                raise InputError(f"bodies must have a pose for {name!r}, got poses for {sorted(bodies)}")
            if name is not None:
                pose = compose(bodies[name], self._rest.get(name, IDENTITY))
                marker = replace(marker, pose=matrix_of(pose) @ marker.pose)
            placed.append(marker)
        return placed

    def _mounted_pose(self, name: str, bodies: Mapping[str, np.ndarray], count: int) -> np.ndarray:
        """Poses of a mounted camera, (env, 7) world from camera."""
        camera = self.cameras[name]
        on = np.broadcast_to(IDENTITY, (count, 7)) if camera.body is None else bodies[camera.body]
        return compose(on, camera.mount)

    def _external_of(
        self, external_depths: Any, count: int
    ) -> dict[str, Sequence[ExternalDepth] | ExternalDepth]:
        if not isinstance(external_depths, Mapping | None):
            raise invalid("external_depths", "{camera name: list of ExternalDepth}", external_depths)
        for name, depths in (external_depths or {}).items():
            if name not in self.cameras:
                raise InputError(unknown("camera", name, self.cameras))
            stacked = isinstance(depths, ExternalDepth) and depths.stacked
            if not (stacked or isinstance(depths, Sequence)):
                raise invalid(f"external_depths[{name!r}]", "a list, one for each environment", depths)
            images = len(depths.depth) if isinstance(depths, ExternalDepth) else len(depths)
            if images != count:
                raise InputError(
                    f"external_depths[{name!r}] must have {count} images, got {images}; give one for "
                    "each environment"
                )
        return dict(external_depths or {})

    def _captures_of(
        self,
        name: str,
        outputs: tuple[str, ...] | None,
        external: Sequence[ExternalDepth] | ExternalDepth,
        count: int,
    ) -> list[Capture]:
        """Captures of a camera: one for all environments, or one for each if there is noise or an external
        depth image."""
        rig_camera = self.cameras[name]
        capture = self._capture.with_(
            camera=rig_camera.camera, sensor=rig_camera.sensor, outputs=outputs or self.outputs_of(name)
        )
        noisy = "noise" in capture.sensor.steps
        if isinstance(external, ExternalDepth):
            external = [external.of_views(i) for i in range(count)] if noisy else [external]
        if not noisy:
            return [capture.with_(external_depth=depth) for depth in external] or [capture]
        place = list(self.cameras).index(name)
        seeds = [
            (capture.sensor.seed + 0x9E3779B1 * (self._rendered + i) + 0x85EBCA77 * place) % 2**32
            for i in range(count)
        ]
        return [
            capture.with_(sensor=replace(capture.sensor, seed=seed), external_depth=depth)
            for seed, depth in zip(seeds, external or [None] * count, strict=True)
        ]


class SimulatorRig(Rig):
    """Base of rigs that read poses and geometry from the state of a simulator."""

    def poses(self, state: Any) -> tuple[Any, Any]:
        """Poses of bodies and of cameras as for `Rig.render`; None: the cameras' mounts."""
        raise NotImplementedError

    def _geometry(self, state: Any, poses: Mapping[str, np.ndarray], meshes: Any) -> Mapping[str, Any]:
        """External depth images of the simulator's geometry, for poses (env, 7) of the cameras."""
        raise NotImplementedError

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
        """Render the images of all cameras.

        Args:
            state: state of the simulator, for the class.
            cameras, outputs, external_depths, mask: as in `Rig.render`.
            meshes: whether the simulator's geometry is composited with the splats by depth, or a selection of
                it as described by the class. It is moved 2 mm away from the camera, so that markers on its
                surfaces are visible.

        Raises:
            InputError: as `Rig.render`; a state without poses; meshes with external_depths.
        """
        bodies, camera_poses = self.poses(state)
        body_poses = _by_name("body", bodies, self.bodies)
        mounts = {name: self._mounted_pose(name, body_poses, len(bodies)) for name in self.cameras}
        views = mounts | _by_name("camera", camera_poses, tuple(self.cameras))
        views |= _by_name("camera", cameras, tuple(self.cameras))
        if meshes is not False:
            if external_depths is not None:
                raise InputError(
                    "at most one of meshes and external_depths must be given, got both; leave one out"
                )
            external_depths = self._geometry(state, views, meshes)
        return super().render(body_poses, views, outputs=outputs, external_depths=external_depths, mask=mask)

    def _pinholes(self) -> None:
        """Raise InputError for a camera with a lens."""
        for name, camera in self.cameras.items():
            if camera.camera.lens is not None:
                raise InputError(
                    f"a camera with meshes must be a pinhole, got {name!r} with the lens "
                    f"{camera.camera.lens.kind}; leave it out by cameras="
                )


class RigImages(Mapping):
    """Images of a rig's cameras: a mapping from an output's name to (env, camera, h, w[, c]).

    `of(camera)` returns those of one camera, (env, h, w[, c]), also if cameras have different sizes.
    """

    def __init__(
        self,
        rig: Rig,
        batches: dict[str, FrameBatch],
        bodies: dict[str, np.ndarray],
        cameras: dict[str, np.ndarray],
    ) -> None:
        self.rig = rig
        self.bodies = bodies
        """{name: (env, 7)} world from body"""
        self.cameras = cameras
        """{name: (env, 7)} world from camera, OpenCV axes"""
        self._batches = batches
        self._outputs = tuple(dict.fromkeys(name for batch in batches.values() for name in batch))
        self._arrays: dict[str, np.ndarray] = {}

    def __getitem__(self, name: str) -> np.ndarray:
        if not isinstance(name, str):
            raise MissingOutputError(str(invalid("an output", "a name", name)))
        if name not in self._arrays:
            sizes = {(rig.camera.width, rig.camera.height) for rig in self.rig.cameras.values()}
            if len(sizes) > 1:
                raise InputError(
                    f"the cameras of images[{name!r}] must have one size, got several; use "
                    f"images.of({next(iter(self._batches))!r})[{name!r}]"
                )
            for camera, batch in self._batches.items():
                if name not in batch:
                    raise MissingOutputError(
                        f"the camera {camera!r} must render {name!r}, got {', '.join(batch)}; add it to "
                        "its outputs"
                    )
            images = [batch[name] for batch in self._batches.values()]
            # images of a single camera are not copied: for thousands of environments this would take longer
            # than rendering
            stacked = images[0][:, None] if len(images) == 1 else np.stack(images, axis=1)
            stacked.flags.writeable = False
            self._arrays[name] = stacked
        return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._outputs)

    def __len__(self) -> int:
        return len(self._outputs)

    def wait(self) -> RigImages:
        """Wait until the device has rendered these images; nothing is copied."""
        for batch in self._batches.values():
            batch.wait()
        return self

    def of(self, camera: str) -> FrameBatch:
        """Images of one camera: (env, h, w[, c]). Raises InputError for an unknown camera."""
        _known("camera", camera, self._batches)
        return self._batches[camera]

    def camera(self, name: str, environment: int = 0) -> Camera:
        """A camera with its pose in an environment."""
        frames = self.of(name)
        whole_number("environment", environment, 0, len(self.cameras[name]) - 1)
        camera = frames.frame(environment).capture.camera
        assert camera is not None  # a frame has a camera
        return camera

    def placed(self, environment: int = 0) -> list[PlacedMarker]:
        """The scene's markers with their poses in an environment."""
        max_count = (
            min((len(poses) for poses in (*self.bodies.values(), *self.cameras.values())), default=1) - 1
        )
        whole_number("environment", environment, 0, max_count)
        return self.rig.placed({body: pose[environment] for body, pose in self.bodies.items()})


def _known(what: str, name: Any, names: Iterable[str]) -> None:
    if not isinstance(name, str) or name not in names:
        raise InputError(unknown(what, name, names))


def _cameras_of(cameras: Any) -> dict[str, RigCamera]:
    try:
        pairs = [
            (name, camera) for name, camera in (cameras.items() if isinstance(cameras, Mapping) else cameras)
        ]
    except (TypeError, ValueError):
        raise invalid("cameras", "{name: Camera or RigCamera}", cameras) from None
    rig_cameras: dict[str, RigCamera] = {}
    for name, camera in pairs:
        if not isinstance(name, str) or not name:
            raise invalid("the name of a camera", "text", name)
        if name in rig_cameras:
            raise InputError(f"the names of cameras must be unique, got {name!r} twice; rename one")
        rig_cameras[name] = camera if isinstance(camera, RigCamera) else RigCamera(camera)
    if not rig_cameras:
        raise InputError("cameras must have at least one camera, got none; give cameras={name: Camera}")
    return rig_cameras


def _bodies_of(bodies: Mapping[int, str], scene: Scene) -> dict[int, str]:
    if not isinstance(bodies, Mapping):
        raise invalid("bodies", "{label of splats: name of the body}", bodies)
    known = set(np.unique(scene.cloud().labels).tolist()) if bodies else set()  # stores are read completely
    names: dict[int, str] = {}
    for label, name in bodies.items():
        if isinstance(label, bool) or not isinstance(label, int | np.integer) or not isinstance(name, str):
            raise invalid("bodies", "{label of splats: name of the body}", {label: name})
        if label not in known:
            listed = ", ".join(map(str, sorted(known)[:20]))
            raise InputError(
                f"the label of the body {name!r} must be the label of a splat, got {label}; known: "
                f"{listed or 'none'}"
            )
        names[int(label)] = name
    return names


def _by_name(what: str, poses: Any, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Validated poses {name: (env, 7)}."""
    if poses is None:
        return {}
    if isinstance(poses, Mapping):
        for name in poses:
            if name not in names:
                raise InputError(unknown(what, name, names))
        return {name: check_poses(f"poses of the {what} {name!r}", p, ("env",)) for name, p in poses.items()}
    array = check_poses(f"the array of poses of each {what}", poses, ("env", what))
    if array.shape[1] != len(names):
        raise InputError(
            f"the array of poses must have a column for each {what} of the rig "
            f"({', '.join(names) or 'none'}), "
            f"got {array.shape[1]}"
        )
    return {name: array[:, i] for i, name in enumerate(names)}


def _environments(bodies: Mapping[str, np.ndarray], cameras: Mapping[str, np.ndarray]) -> int:
    counts = {f"body {name!r}": len(poses) for name, poses in bodies.items()}
    counts |= {f"camera {name!r}": len(poses) for name, poses in cameras.items()}
    if not counts:
        return 1
    first, count = next(iter(counts.items()))
    for name, other in counts.items():
        if other != count:
            raise InputError(
                f"the {name} must have poses of {count} environments like the {first}, got {other}"
            )
    return count
