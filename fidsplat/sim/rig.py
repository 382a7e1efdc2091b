"""A rig: splats and cameras that hang on the bodies of a simulator, drawn in many environments at once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture, output_names
from fidsplat.capture.environment import ExternalDepth
from fidsplat.capture.sensor import Sensor
from fidsplat.render.batch import FrameBatch
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.sim.poses import IDENTITY, check_poses, compose, inverse, matrix_of, pose_of
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.arguments import instance, invalid, whole_number
from fidsplat.util.errors import InputError, MissingOutputError, unknown


@dataclass(frozen=True, eq=False)
class RigCamera:
    """A camera and what it hangs on. Raises InputError for a part of the wrong kind."""

    camera: Camera
    """intrinsics and lens. Its own pose is where it stands: `world_to_camera`, or on a body body_to_camera"""
    body: str | None = None
    """the body that carries it; None: the world"""
    sensor: Sensor | None = None
    """what becomes of its rgb; None: what the scene says. Noise is another in every picture"""
    outputs: tuple[str, ...] | None = None
    """names of its output images; None: the rig's"""
    rate: float | None = None
    """pictures a second, for those who keep time; drawing takes no notice of it"""

    def __post_init__(self) -> None:
        if not isinstance(self.camera, Camera):
            raise InputError(f"camera is {self.camera!r}; it must be a Camera, e.g. fs.Camera.pinhole(...)")
        if not isinstance(self.body, str | None):
            raise InputError(
                f"the body of a camera is {self.body!r}; it must be a name, or None for the world"
            )
        if not isinstance(self.sensor, Sensor | None):
            raise InputError(f"the sensor of a camera is {self.sensor!r}; it must be a Sensor or None")
        if self.outputs is not None:
            object.__setattr__(self, "outputs", output_names(self.outputs))

    @property
    def mount(self) -> np.ndarray:
        """(7,) body from camera, OpenCV axes."""
        return inverse(pose_of(self.camera.world_to_camera))


class Rig:
    """Splats and cameras bound to bodies by name, drawn in every environment of a simulator.

    Splats with a label that is bound are given in the frame of their body (`rest` says otherwise); all
    others are the world that the environments share. One body may carry several labels.

    Args:
        scene: splats and markers, and with its quality, background, fog and sensor how pictures are taken. A
            scene's marker i has the label i + 1.
        bodies: {label: name of the body}.
        cameras: {name: Camera or RigCamera}, or pairs of these.
        renderer: draws; None: one for the default device.
        rest: {name of a body: pose (7,)} of bodies whose splats lie in the scene where the body was then.
        outputs: names of the output images; default the scene's.

    Raises:
        InputError: a label that no splat has, two cameras of one name, or none; a scene whose parts move by
            themselves.
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
            raise InputError("parts of this scene move by themselves; in a rig the simulator moves them")
        self.cameras = _cameras_of(cameras)
        """RigCamera by name, in the order of the pictures' axis `camera`"""
        cloud = self.scene.cloud()
        self.labels = _bodies_of({} if bodies is None else bodies, cloud)
        """name of the body by label"""
        mounts = (camera.body for camera in self.cameras.values() if camera.body is not None)
        self.bodies = tuple(dict.fromkeys((*self.labels.values(), *mounts)))
        """names of the bodies whose poses are asked for, in the order of the axis `body`"""
        self._rest = {}
        if renderer is not None:
            instance("renderer", renderer, Renderer, "an fs.Renderer or None")
        if not isinstance(rest, Mapping | None):
            raise invalid("rest", "{name of a body: pose (7,)}", rest)
        for name, pose in ({} if rest is None else rest).items():
            if name not in self.bodies:
                raise InputError(unknown("body", name, self.bodies))
            self._rest[name] = inverse(check_poses(f"rest of {name}", pose, ()))
        self.renderer = Renderer() if renderer is None else renderer
        self._cloud = self.renderer.upload(cloud)
        self._capture = self.scene.capture.with_(outputs=outputs)
        self._drawn = 0

    def render(
        self,
        bodies: Mapping[str, Any] | Any = None,
        cameras: Mapping[str, Any] | Any = None,
        *,
        outputs: Iterable[str] | None = None,
        external_depths: Mapping[str, Sequence[ExternalDepth]] | None = None,
        mask: Any = None,
    ) -> RigImages:
        """Pictures of every environment by every camera.

        An environment's pictures have the same bits alone and among others.

        Args:
            bodies: poses, world from body: {name: (env, 7)} of every body, or (env, body, 7) in the order of
                `Rig.bodies`. None where there are none.
            cameras: poses, world from camera, OpenCV axes: {name: (env, 7)} of some cameras, or
                (env, camera, 7). Cameras without one stand where they are mounted.
            outputs: names of the output images; default the rig's.
            external_depths: {camera name: an ExternalDepth for each environment}, rendered by another
                renderer from there.
            mask: (env,) bool; environments that are False are not drawn: 0, and labels of -1.

        Raises:
            InputError: an unknown body or camera, a body without a pose, a pose that is not rigid or not
                finite, numbers of environments that differ.
        """
        given = _by_name("body", bodies, self.bodies)
        views = _by_name("camera", cameras, tuple(self.cameras))
        missing = [name for name in self.bodies if name not in given]
        if missing:
            raise InputError(f"no pose for the body {missing[0]!r}; the rig has {', '.join(self.bodies)}")
        count = _environments(given, views)
        stands = {name: self._stands(name, given, count) for name in self.cameras} | views
        names = None if outputs is None else output_names(outputs)
        drawn = _mask_of(mask, count)
        seen = {name: () for name in self.cameras} | self._external_of(external_depths, count)
        groups = {
            label: compose(given[name], self._rest[name]) if name in self._rest else given[name]
            for label, name in self.labels.items()
        }
        batches = {
            name: self._draw(self._taken_by(name, names, seen[name], count), stands[name], groups, drawn)
            for name in self.cameras
        }
        self._drawn += count
        return RigImages(self, batches, given, stands)

    def outputs_of(self, camera: str) -> tuple[str, ...]:
        """Names of a camera's output images, where `render` is not told others."""
        _known("camera", camera, self.cameras)
        return self.cameras[camera].outputs or self._capture.outputs

    def placed(self, bodies: Mapping[str, np.ndarray]) -> list[PlacedMarker]:
        """The scene's markers where they are when the bodies have these poses (7,)."""
        if not isinstance(bodies, Mapping):
            raise invalid("bodies", "{name of a body: pose (7,)}", bodies)
        placed = []
        for marker in self.scene.markers:
            name = self.labels.get(marker.label)
            if name is not None and name not in bodies:
                raise invalid("bodies", f"poses of all bodies, {name!r} among them", sorted(bodies))
            if name is not None:
                pose = compose(bodies[name], self._rest.get(name, IDENTITY))
                marker = replace(marker, pose=matrix_of(pose) @ marker.pose)
            placed.append(marker)
        return placed

    def _stands(self, name: str, bodies: Mapping[str, np.ndarray], count: int) -> np.ndarray:
        """(env, 7) world from camera, where it is mounted."""
        camera = self.cameras[name]
        on = np.broadcast_to(IDENTITY, (count, 7)) if camera.body is None else bodies[camera.body]
        return compose(on, camera.mount)

    def _external_of(self, external_depths: Any, count: int) -> dict[str, Sequence[ExternalDepth]]:
        if not isinstance(external_depths, Mapping | None):
            raise InputError(
                f"external_depths must be {{camera name: list of ExternalDepth}}, got {external_depths!r}"
            )
        for name, each in (external_depths or {}).items():
            if name not in self.cameras:
                raise InputError(unknown("camera", name, self.cameras))
            if not isinstance(each, Sequence):
                raise InputError(
                    f"external_depths[{name!r}] must be a list, one for each environment, got {each!r}"
                )
            if len(each) != count:
                raise InputError(
                    f"external_depths[{name!r}] must have {count} images, got {len(each)}; give one for "
                    "each environment"
                )
        return dict(external_depths or {})

    def _taken_by(
        self, name: str, outputs: tuple[str, ...] | None, external: Sequence[ExternalDepth], count: int
    ) -> list[Capture]:
        """Captures of a camera: one for all environments, or one for each if there is noise or an external
        depth image."""
        own = self.cameras[name]
        capture = self._capture.with_(
            camera=own.camera, sensor=own.sensor, outputs=outputs or self.outputs_of(name)
        )
        if "noise" not in capture.sensor.steps:
            return [capture.with_(external_depth=one) for one in external] or [capture]
        place = list(self.cameras).index(name)
        seeds = [
            (capture.sensor.seed + 0x9E3779B1 * (self._drawn + i) + 0x85EBCA77 * place) % 2**32
            for i in range(count)
        ]
        return [
            capture.with_(sensor=replace(capture.sensor, seed=seed), external_depth=one)
            for seed, one in zip(seeds, external or [None] * count, strict=True)
        ]

    def _draw(
        self,
        captures: list[Capture],
        poses: np.ndarray,
        groups: dict[int, np.ndarray],
        mask: np.ndarray | None,
    ) -> FrameBatch:
        taken = captures[0] if len(captures) == 1 else captures
        return self.renderer.render_batch(self._cloud, taken, poses=poses, groups=groups, mask=mask)


class RigImages(Mapping):
    """What the cameras of a rig see: a mapping from an output's name to (env, camera, h, w[, c]).

    `of(camera)` gives one camera's, (env, h, w[, c]), also where cameras have different sizes.
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
                    f"the cameras' pictures have different sizes; take those of one: "
                    f"pictures.of({next(iter(self._batches))!r})[{name!r}]"
                )
            for camera, batch in self._batches.items():
                if name not in batch:
                    raise MissingOutputError(
                        f"the camera {camera!r} has no {name!r}; it gives {', '.join(batch)}; name it there"
                    )
            each = [batch[name] for batch in self._batches.values()]
            # one camera's are not copied: of thousands of environments that takes longer than to draw them
            stacked = each[0][:, None] if len(each) == 1 else np.stack(each, axis=1)
            stacked.flags.writeable = False
            self._arrays[name] = stacked
        return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._outputs)

    def __len__(self) -> int:
        return len(self._outputs)

    def wait(self) -> RigImages:
        """These pictures, once the device has drawn them; nothing is copied."""
        for batch in self._batches.values():
            batch.wait()
        return self

    def of(self, camera: str) -> FrameBatch:
        """What one camera sees: (env, h, w[, c]). Raises InputError for a camera that the rig has not."""
        _known("camera", camera, self._batches)
        return self._batches[camera]

    def camera(self, name: str, environment: int = 0) -> Camera:
        """A camera with the pose that it had."""
        self.of(name)  # a camera of the rig
        whole_number("environment", environment, 0, len(self.cameras[name]) - 1)
        camera = self.of(name).frame(environment).capture.camera
        assert camera is not None  # of a rendered image
        return camera

    def placed(self, environment: int = 0) -> list[PlacedMarker]:
        """The scene's markers where they were."""
        most = min((len(poses) for poses in (*self.bodies.values(), *self.cameras.values())), default=1) - 1
        whole_number("environment", environment, 0, most)
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
        raise InputError(f"cameras is {cameras!r}; it must be {{name: Camera or RigCamera}}") from None
    found: dict[str, RigCamera] = {}
    for name, camera in pairs:
        if not isinstance(name, str) or not name:
            raise InputError(f"the name of a camera is {name!r}; it must be text")
        if name in found:
            raise InputError(f"two cameras have the name {name!r}; give each its own")
        found[name] = camera if isinstance(camera, RigCamera) else RigCamera(camera)
    if not found:
        raise InputError("a rig without a camera draws nothing; give cameras={name: Camera}")
    return found


def _bodies_of(bodies: Mapping[int, str], cloud: SplatCloud) -> dict[int, str]:
    if not isinstance(bodies, Mapping):
        raise InputError(f"bodies is {bodies!r}; it must be {{label of splats: name of the body}}")
    there = set(np.unique(cloud.labels).tolist())
    found: dict[int, str] = {}
    for label, name in bodies.items():
        if isinstance(label, bool) or not isinstance(label, int | np.integer) or not isinstance(name, str):
            raise InputError(
                f"bodies has {label!r}: {name!r}; it must be {{label of splats: name of the body}}"
            )
        if label not in there:
            shown = ", ".join(map(str, sorted(there)[:20]))
            raise InputError(
                f"the body {name!r} has no splats: none has the label {label}; there are {shown or 'none'}"
            )
        found[int(label)] = name
    return found


def _by_name(what: str, poses: Any, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """{name: (env, 7)} of what was given, checked."""
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
            f"the array of poses of each {what} has {array.shape[1]} of them; the rig has {len(names)}: "
            f"{', '.join(names) or 'none'}"
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
            raise InputError(f"the {first} has poses of {count} environments, the {name} of {other}")
    return count


def _mask_of(mask: Any, count: int) -> np.ndarray | None:
    if mask is None:
        return None
    try:
        array = np.asarray(mask)
    except ValueError:  # rows that differ in length
        array = np.empty(0, object)
    if array.dtype != bool or array.shape != (count,):
        raise InputError(f"mask must be ({count},) bool, one for each environment, not {mask!r}")
    return array
