"""Renderer: the facade that people use."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fidsplat.backends.base import Adopts, DeviceInfo, GivesArrays, Images, ResidentData
from fidsplat.backends.exposure import exposed_view
from fidsplat.backends.registry import open_backend
from fidsplat.cameras import Camera, Motion, Shutter
from fidsplat.effects import select
from fidsplat.errors import InputError, MissingOutputError
from fidsplat.quality import Quality
from fidsplat.scenes import Scene
from fidsplat.sensor import Sensor
from fidsplat.splats import SplatCloud
from fidsplat.surroundings import Fog, Gradient, Panorama, background_of

_NO_SCENE = Scene(())
_INSTANT = Shutter()


class Frame(Mapping):
    """A finished picture: a mapping from an output's name to a read-only NumPy array, copied from the
    device on first use.

    Shapes and units: `rgb` (h, w, 3) float32; `alpha` (h, w); `depth`, `depth_median`, `depth_first` (h, w)
    metres along z, `distance`, `distance_median`, `distance_first` metres along the ray; `normal` (h, w, 3)
    unit, camera frame, towards the camera, `normal_world` the same in the world's axes; `label`, `splat_id`
    (h, w) int32; `blended` (h, w) int32. Where less than 1/255 is covered, or of first hits less than
    `Quality.first_hit`, labels and ids are -1, the others of these 0.
    """

    def __init__(self, images: Images, outputs: tuple[str, ...]) -> None:
        self._images, self._process = images, os.getpid()
        self._arrays: dict[str, np.ndarray] = {}
        self.outputs = outputs
        """Names of the images, in the order in which they were asked for."""

    def __getitem__(self, name: str) -> np.ndarray:
        self._check(name)
        if name not in self._arrays:
            check_process(self._process, "frame")
            self._arrays[name] = image = self._images.read(name)
            image.flags.writeable = False  # what is kept is what was drawn
        return self._arrays[name]

    def device_array(self, name: str) -> Any:
        """The image where it was drawn, without a copy: on a Warp device a wp.array, (h, w) or (h, w, 3).

        It belongs to this frame: the next picture is drawn into another array. `wp.to_torch`, DLPack and
        `__cuda_array_interface__` make a tensor of it on the same device.

        Raises:
            InputError: an output that was not asked for, or the backend has no arrays to give.
        """
        self._check(name)
        check_process(self._process, "frame")
        if not isinstance(self._images, GivesArrays):
            raise InputError(
                f"this device keeps {name} in no array that others can use; draw with device='warp:cuda' or "
                "'warp:cpu', or take frame[name], which is copied to the host"
            )
        return self._images.device_array(name)

    def _check(self, name: str) -> None:
        if not isinstance(name, str) or name not in self.outputs:
            raise MissingOutputError(
                f"this frame has no {name!r}; it was rendered with {', '.join(self.outputs)}; name it there"
            )

    def __iter__(self) -> Iterator[str]:
        return iter(self.outputs)

    def __len__(self) -> int:
        return len(self.outputs)

    def __reduce__(self):
        """Pickled and copied as NumPy arrays: what `device_array` gives stays on its device."""
        return _kept_frame, (dict(self), dict(self.timings), dict(self.stats))

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds on the device by stage: project, sort, bin, blend, resolve."""
        return self._images.timings

    @property
    def stats(self) -> Mapping[str, int]:
        """splats (in the cloud), visible (not culled), pairs (of splats and tiles)."""
        return self._images.stats


@dataclass(frozen=True)
class _KeptImages:
    """Images that are no longer on a device."""

    arrays: dict[str, np.ndarray]
    timings: Mapping[str, float]
    stats: Mapping[str, int]

    def read(self, name: str) -> np.ndarray:
        return self.arrays[name]


def _kept_frame(arrays: dict[str, np.ndarray], timings: dict[str, float], stats: dict[str, int]) -> Frame:
    return Frame(_KeptImages(arrays, timings, stats), tuple(arrays))


def check_process(opened_by: int, what: str) -> None:
    """Raises InputError in a fork of the process that opened it, where its driver does not work."""
    if opened_by != os.getpid():
        raise InputError(
            f"this {what} belongs to process {opened_by}, of which this one is a fork; open a Renderer in "
            "each process, and read frames before the fork"
        )


def default_device() -> str:
    """The device that is used where none is named: FIDSPLAT_DEVICE, else opencl."""
    return os.environ.get("FIDSPLAT_DEVICE", "").strip() or "opencl"


class ResidentCloud:
    """A cloud on a renderer's device; rendering it transfers no splat."""

    def __init__(self, renderer: Renderer, data: ResidentData) -> None:
        self._renderer, self._data = renderer, data

    def __len__(self) -> int:
        return self._data.count

    def __reduce__(self):
        raise InputError(
            "a ResidentCloud is on a device and cannot be pickled or copied; take the SplatCloud, and upload "
            "it there"
        )

    @property
    def memory_bytes(self) -> int:
        """Device memory that it takes; 0 where the device reads the host's own arrays, as OpenCL on a CPU."""
        return self._data.memory_bytes


class Renderer:
    """Draws splats on one device. Compiled pipelines and scratch buffers are kept from picture to picture.

    Args:
        device: "opencl" (the best OpenCL device), "opencl:NAME" (part of a platform's or device's name, or
            cpu or gpu), "warp:cpu", "warp:cuda" (NVIDIA Warp), or "reference" (NumPy, float64, slow).
            None: what the environment variable FIDSPLAT_DEVICE says, else "opencl".
        memory_budget: bytes of the device that a picture and its cloud may take; by default nine tenths of
            what the device says it has. What needs more is drawn in bands of the picture and, by OpenCL,
            chunks of the cloud, which takes longer and gives the same bits.

    Raises:
        DeviceError: the device cannot be used; UnknownDeviceError: there is no such device.
        InputError: the memory budget is no positive number, or the device has none.
    """

    def __init__(self, device: str | None = None, memory_budget: int | None = None) -> None:
        self.backend = open_backend(default_device() if device is None else device)
        self._process = os.getpid()
        if memory_budget is not None:
            if isinstance(memory_budget, bool) or not isinstance(memory_budget, int) or memory_budget <= 0:
                raise InputError(
                    f"memory_budget is {memory_budget!r}; it must be a whole number of bytes, e.g. 2 * 2**30"
                )
            self.backend.limit_memory(memory_budget)

    def __reduce__(self):
        raise InputError(
            "a Renderer holds a device and cannot be pickled or copied; open one where it is used, e.g. "
            f"fs.Renderer({self.device.name!r}) in each worker"
        )

    @property
    def device(self) -> DeviceInfo:
        """The device that draws."""
        return self.backend.info

    def upload(self, scene: Scene | SplatCloud) -> ResidentCloud:
        """Put a scene's splats on the device, to be rendered many times."""
        check_process(self._process, "Renderer")
        cloud = scene.cloud() if isinstance(scene, Scene) else scene
        if not isinstance(cloud, SplatCloud):
            raise InputError(f"cannot render a {type(scene).__name__}; give a Scene or a SplatCloud")
        return ResidentCloud(self, self.backend.upload(cloud))

    def adopt(
        self,
        *,
        means: Any,
        quats: Any,
        scales: Any,
        opacities: Any,
        colors: Any = None,
        sh: Any = None,
        labels: Any = None,
        origin: Iterable[float] = (0.0, 0.0, 0.0),
    ) -> ResidentCloud:
        """Splats in arrays that are on the device already: drawn where they lie, without a copy.

        Shapes and units are those of SplatCloud, float32 (labels int32): wp.array, or what gives DLPack
        (torch, CuPy, JAX); NumPy arrays are copied. What is in the arrays when a picture is drawn is what it
        shows, so a simulation may move the splats between pictures. Quaternions need no unit length; a splat
        that cannot be drawn (a value that is not finite, a scale below 0) is left out of the picture without
        a word. `origin` (3,): world position of the means' zero.

        Raises:
            InputError: the backend takes no arrays, or one has the wrong shape, type or device.
        """
        if not isinstance(self.backend, Adopts):
            raise InputError(
                f"{self.device.name} takes no arrays of a device; use a Warp device, or a SplatCloud"
            )
        check_process(self._process, "Renderer")
        if (colors is None) == (sh is None):
            raise InputError("give exactly one of colors (n, 3) and sh (n, k, 3)")
        given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
        given |= {"colors": colors} if sh is None else {"sh": sh}
        given |= {} if labels is None else {"labels": labels}
        return ResidentCloud(self, self.backend.adopt(given, np.asarray(tuple(origin), dtype=np.float64)))

    def render(
        self,
        scene: Scene | SplatCloud | ResidentCloud,
        camera: Camera | None = None,
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
        background: Iterable[float] | Gradient | Panorama | None = None,
        motion: Motion | None = None,
        shutter: Shutter | None = None,
        sensor: Sensor | None = None,
        fog: Fog | None = None,
    ) -> Frame:
        """Draw one picture.

        Args:
            scene: what to draw. A Scene's own camera, outputs, quality, background, sensor and fog are used
                where the arguments are left out.
            camera: needed unless the scene has one.
            outputs: names of planes; default rgb.
            quality: a Quality, or text such as "fast" or "fast,samples=2" (`Quality.of`); default standard.
            background: (r, g, b), a Gradient or a Panorama behind the splats; default black.
            motion: how the camera and groups of splats move; default: they stand still.
            shutter: when the picture is taken, and how long that takes; default: at time 0, at once.
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
        sensor, fog = (own.sensor if sensor is None else sensor), (own.fog if fog is None else fog)
        moving = own.motion if motion is None else motion
        when = (own.shutter or _INSTANT) if shutter is None else shutter
        for value, kind in ((sensor, Sensor), (fog, Fog), (moving, Motion), (when, Shutter)):
            if value is not None and not isinstance(value, kind):
                raise InputError(f"{kind.__name__.lower()} is {value!r}; it must be a {kind.__name__}")

        resident = scene if isinstance(scene, ResidentCloud) else self.upload(scene)
        check_process(self._process, "Renderer")
        if resident._renderer is not self:
            raise InputError(
                "this cloud was uploaded by another Renderer; upload it with the one that draws it"
            )
        data = resident._data
        view = exposed_view(camera, chosen, data.origin, behind, moving, when, sensor, fog)
        features = select(
            data,
            names,
            chosen,
            camera,
            moving=bool(view.groups),
            exposed=bool(view.shots),
            sensor=sensor,
            fog=fog,
            background=behind,
        )
        return Frame(self.backend.pipeline(features).render(data, view), names)

    def render_views(
        self,
        scene: Scene | SplatCloud | ResidentCloud,
        cameras: Iterable[Camera],
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
        background: Iterable[float] | Gradient | Panorama | None = None,
        motion: Motion | None = None,
        shutter: Shutter | None = None,
        sensor: Sensor | None = None,
        fog: Fog | None = None,
    ) -> Iterator[Frame]:
        """Draw one cloud from many cameras, one Frame for each, in their order.

        The cloud is uploaded once, kernels and buffers are used again, and on a device that works beside the
        host the next picture is under way while the caller has the last. Arguments and errors: as `render`
        (a motion of the camera takes the place of each camera's pose); an error comes after the pictures of
        the cameras before it.
        """
        own = scene if isinstance(scene, Scene) else _NO_SCENE
        chosen = own.quality if quality is None else quality
        names = own.outputs if outputs is None else outputs
        names = names if isinstance(names, str) else tuple(names)
        behind = background_of(own.background if background is None else background)
        motion = own.motion if motion is None else motion
        shutter = own.shutter if shutter is None else shutter
        sensor, fog = (own.sensor if sensor is None else sensor), (own.fog if fog is None else fog)
        resident = scene if isinstance(scene, ResidentCloud) else self.upload(scene)
        waiting: Frame | None = None
        failure: Exception | None = None
        rest = iter(cameras)
        while True:
            try:
                frame = self.render(resident, next(rest), names, chosen, behind, motion, shutter, sensor, fog)
            except StopIteration:
                break
            except Exception as error:
                failure = error
                break
            if waiting is not None:
                yield waiting
            waiting = frame
        if waiting is not None:
            yield waiting
        if failure is not None:
            raise failure
