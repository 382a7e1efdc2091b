"""Renderer: the facade that people use."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from fidsplat.backends.base import DeviceInfo, Planes, View
from fidsplat.backends.registry import open_backend
from fidsplat.cameras import Camera
from fidsplat.effects import select
from fidsplat.errors import InputError
from fidsplat.quality import Quality
from fidsplat.scenes import Scene
from fidsplat.sensor import Sensor
from fidsplat.splats import SplatCloud
from fidsplat.surroundings import Fog, Gradient, Panorama, background_of

_NO_SCENE = Scene(())


class Frame(Mapping):
    """A finished picture: a mapping from an output's name to a read-only NumPy array, copied from the
    device on first use.

    Shapes and units: `rgb` (h, w, 3) float32; `alpha` (h, w); `depth`, `depth_median`, `depth_first` (h, w)
    metres along z, `distance`, `distance_median`, `distance_first` metres along the ray, 0 where nothing was
    drawn; `normal` (h, w, 3) unit, camera frame, towards the camera, `normal_world` the same in the world's
    axes; `label`, `splat_id` (h, w) int32, -1 where nothing was drawn; `blended` (h, w) int32.
    """

    def __init__(self, planes: Planes, outputs: tuple[str, ...]) -> None:
        self._planes = planes
        self._arrays: dict[str, np.ndarray] = {}
        self.outputs = outputs
        """Names of the planes, in the order in which they were asked for."""

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.outputs:
            raise KeyError(f"this frame has no {name!r}; it was rendered with {', '.join(self.outputs)}")
        if name not in self._arrays:
            self._arrays[name] = plane = self._planes.read(name)
            plane.flags.writeable = False  # what is kept is what was drawn
        return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.outputs)

    def __len__(self) -> int:
        return len(self.outputs)

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds on the device by stage: project, sort, bin, blend, resolve."""
        return self._planes.timings

    @property
    def stats(self) -> Mapping[str, int]:
        """splats (in the cloud), visible (not culled), pairs (of splats and tiles)."""
        return self._planes.stats


class ResidentCloud:
    """A cloud on a renderer's device; rendering it transfers no splat."""

    def __init__(self, renderer: Renderer, data: Any, count: int) -> None:
        self._renderer, self._data, self._count = renderer, data, count

    def __len__(self) -> int:
        return self._count


class Renderer:
    """Draws splats on one device. Compiled pipelines and scratch buffers are kept from picture to picture.

    Args:
        device: "opencl" (the best OpenCL device), "opencl:NAME" (part of a platform's or device's name, or
            cpu or gpu), or "reference" (NumPy, float64, slow).
        memory_budget: bytes of the device that a picture and its cloud may take; by default nine tenths of
            what the device says it has. What needs more is drawn in bands of the picture and chunks of the
            cloud, which takes longer and gives the same bits.

    Raises:
        DeviceError: the device cannot be used; UnknownDeviceError: there is no such device.
        InputError: the memory budget is no positive number, or the device has none.
    """

    def __init__(self, device: str = "opencl", memory_budget: int | None = None) -> None:
        self.backend = open_backend(device)
        if memory_budget is not None:
            if isinstance(memory_budget, bool) or not isinstance(memory_budget, int) or memory_budget <= 0:
                raise InputError(
                    f"memory_budget is {memory_budget!r}; it must be a whole number of bytes, e.g. 2 * 2**30"
                )
            self.backend.limit_memory(memory_budget)

    @property
    def device(self) -> DeviceInfo:
        """The device that draws."""
        return self.backend.info

    def upload(self, scene: Scene | SplatCloud) -> ResidentCloud:
        """Put a scene's splats on the device, to be rendered many times."""
        cloud = scene.cloud() if isinstance(scene, Scene) else scene
        if not isinstance(cloud, SplatCloud):
            raise InputError(f"cannot render a {type(scene).__name__}; give a Scene or a SplatCloud")
        return ResidentCloud(self, self.backend.upload(cloud), len(cloud))

    def render(
        self,
        scene: Scene | SplatCloud | ResidentCloud,
        camera: Camera | None = None,
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
        background: Iterable[float] | Gradient | Panorama | None = None,
        sensor: Sensor | None = None,
        fog: Fog | None = None,
    ) -> Frame:
        """Draw one picture.

        Args:
            scene: what to draw. A Scene's own camera, outputs, quality, background, sensor and fog are used
                where the arguments are left out.
            camera: needed unless the scene has one.
            outputs: names of planes; default rgb.
            quality: a Quality or a preset's name; default standard.
            background: (r, g, b), a Gradient or a Panorama behind the splats; default black.
            sensor: what becomes of rgb on its way out; default nothing.
            fog: between the camera and what it sees; default none.

        Raises:
            InputError: no camera, an unknown output or preset, a picture that is too large, a cloud uploaded
                elsewhere.
            DeviceError: the device fails or lacks memory.
        """
        own = scene if isinstance(scene, Scene) else _NO_SCENE
        camera = camera or own.camera
        if camera is None:
            raise InputError("no camera: pass camera=fs.Camera... or give the scene a [camera] table")
        if not isinstance(camera, Camera):
            raise InputError(f"camera is {camera!r}; it must be a Camera, e.g. fs.Camera.look_at(...)")
        names = own.outputs if outputs is None else outputs
        names = (names,) if isinstance(names, str) else tuple(dict.fromkeys(names))
        if not names:
            raise InputError("outputs is empty; name at least one, e.g. 'rgb'")
        chosen = Quality.of(own.quality if quality is None else quality)
        behind = background_of(own.background if background is None else background)
        sensor, fog = sensor or own.sensor, fog or own.fog
        for value, kind in ((sensor, Sensor), (fog, Fog)):
            if value is not None and not isinstance(value, kind):
                raise InputError(f"{kind.__name__.lower()} is {value!r}; it must be a {kind.__name__}")

        resident = scene if isinstance(scene, ResidentCloud) else self.upload(scene)
        if resident._renderer is not self:
            raise InputError(
                "this cloud was uploaded by another Renderer; upload it with the one that draws it"
            )
        data = resident._data
        features = select(data, names, chosen, sensor, fog, behind)
        view = View.of(camera, chosen, data.origin, behind, sensor, fog)
        return Frame(self.backend.pipeline(features).render(data, view), names)

    def render_views(
        self,
        scene: Scene | SplatCloud | ResidentCloud,
        cameras: Iterable[Camera],
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
        background: Iterable[float] | Gradient | Panorama | None = None,
        sensor: Sensor | None = None,
        fog: Fog | None = None,
    ) -> Iterator[Frame]:
        """Draw one cloud from many cameras, one Frame for each, in their order.

        The cloud is uploaded once, kernels and buffers are used again, and on a device that works beside the
        host the next picture is under way while the caller has the last. Arguments and errors: as `render`.
        """
        own = scene if isinstance(scene, Scene) else _NO_SCENE
        chosen = own.quality if quality is None else quality
        names = own.outputs if outputs is None else outputs
        behind = own.background if background is None else background
        sensor, fog = sensor or own.sensor, fog or own.fog
        resident = scene if isinstance(scene, ResidentCloud) else self.upload(scene)
        waiting: Frame | None = None
        for camera in cameras:
            frame = self.render(resident, camera, names, chosen, behind, sensor, fog)
            if waiting is not None:
                yield waiting
            waiting = frame
        if waiting is not None:
            yield waiting
