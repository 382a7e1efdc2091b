"""Renderer: the facade that people use."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fidsplat.backends.base import Adopts, DeviceInfo, GivesArrays, Images, ResidentData
from fidsplat.backends.prepare import prepare
from fidsplat.backends.registry import open_backend
from fidsplat.backends.view import NO_CAMERA
from fidsplat.cameras import Camera, Motion, Shutter
from fidsplat.capture import Capture, output_names
from fidsplat.errors import InputError, MissingOutputError
from fidsplat.quality import Quality
from fidsplat.scenes import Scene
from fidsplat.sensor import Sensor
from fidsplat.splats import SplatCloud
from fidsplat.surroundings import Fog, Gradient, Panorama, background_of

_PLAIN = Capture()


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

    def __init__(self, renderer: Renderer, data: ResidentData, capture: Capture) -> None:
        self._renderer, self._data = renderer, data
        self.capture = capture
        """how its pictures are taken unless `render` is given another: that of the scene it came from"""

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

    Threads may share one, whose pictures are then drawn one after another; a process that was forked opens
    its own.

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
        self._process, self._lock = os.getpid(), threading.Lock()
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
        """Put a scene's splats on the device, to be rendered many times. A scene's capture is kept."""
        check_process(self._process, "Renderer")
        cloud = scene.cloud() if isinstance(scene, Scene) else scene
        if not isinstance(cloud, SplatCloud):
            raise InputError(f"cannot render a {type(scene).__name__}; give a Scene or a SplatCloud")
        capture = scene.capture if isinstance(scene, Scene) else _PLAIN
        with self._lock:
            return ResidentCloud(self, self.backend.upload(cloud), capture)

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
        (torch, CuPy, JAX); NumPy arrays are copied. With scales (n, 3) splats are 3D Gaussians, those whose
        third is 0 disks. What is in the arrays when a picture is drawn is what it shows, so a simulation may
        move the splats between pictures. Quaternions need no unit length; a splat that cannot be drawn (a
        value that is not finite, a scale below 0) is left out of the picture without a word. `origin` (3,):
        world position of the means' zero.

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
        with self._lock:
            data = self.backend.adopt(given, np.asarray(tuple(origin), dtype=np.float64))
        return ResidentCloud(self, data, _PLAIN)

    def render(
        self,
        scene: Scene | SplatCloud | ResidentCloud,
        capture: Capture | Camera | None = None,
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
        background: Iterable[float] | Gradient | Panorama | None = None,
        motion: Motion | None = None,
        shutter: Shutter | None = None,
        sensor: Sensor | None = None,
        fog: Fog | None = None,
        *,
        camera: Camera | None = None,
    ) -> Frame:
        """Draw one picture: `render(scene, Capture(camera, ...))`, or the parts of a capture as arguments.

        Args:
            scene: what to draw.
            capture: how; or a camera alone. Without a Capture a Scene's own is taken, which its ResidentCloud
                has too.
            outputs, quality, background, motion, shutter, sensor, fog, camera: take the place of the
                capture's.

        Raises:
            InputError: no camera, an unknown output or preset, a picture that is too large, a cloud uploaded
                elsewhere.
            DeviceError: the device fails or lacks memory.
        """
        asked = _asked(scene, capture, camera, outputs, quality, background, motion, shutter, sensor, fog)
        return self._draw(self._resident(scene), asked)

    def render_views(
        self,
        scene: Scene | SplatCloud | ResidentCloud,
        captures: Iterable[Capture | Camera],
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
        background: Iterable[float] | Gradient | Panorama | None = None,
        motion: Motion | None = None,
        shutter: Shutter | None = None,
        sensor: Sensor | None = None,
        fog: Fog | None = None,
    ) -> Iterator[Frame]:
        """Draw one cloud many times, one Frame for each capture or camera, in their order.

        The cloud is uploaded once, kernels and buffers are used again, and on a device that works beside the
        host the next picture is under way while the caller has the last. Arguments and errors: as `render`
        (a motion of the camera takes the place of each camera's pose); an error comes after the pictures of
        the captures before it.
        """
        outputs = None if outputs is None else output_names(outputs)
        background = None if background is None else background_of(background)  # an iterator ends at once
        try:
            rest = iter(captures)
        except TypeError:
            raise InputError(f"captures is {captures!r}; it must be a list of Capture or Camera") from None
        resident = self._resident(scene)
        waiting: Frame | None = None
        failure: Exception | None = None
        while True:
            try:
                asked = _asked(
                    scene, next(rest), None, outputs, quality, background, motion, shutter, sensor, fog
                )
                frame = self._draw(resident, asked)
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

    def _resident(self, scene: Scene | SplatCloud | ResidentCloud) -> ResidentCloud:
        resident = scene if isinstance(scene, ResidentCloud) else self.upload(scene)
        check_process(self._process, "Renderer")
        if resident._renderer is not self:
            raise InputError(
                "this cloud was uploaded by another Renderer; upload it with the one that draws it"
            )
        return resident

    def _draw(self, resident: ResidentCloud, capture: Capture) -> Frame:
        features, view = prepare(resident._data, capture)
        with self._lock:  # scratch buffers and kernels' arguments belong to one picture at a time
            return Frame(self.backend.pipeline(features).render(resident._data, view), capture.outputs)


def _asked(
    scene: Any,
    capture: Capture | Camera | None,
    camera: Camera | None,
    outputs: Any,
    quality: Any,
    background: Any,
    motion: Any,
    shutter: Any,
    sensor: Any,
    fog: Any,
) -> Capture:
    """The capture that is given or the scene's own, changed by the parts that are given beside it.

    Raises:
        InputError: a part of the wrong kind, or no camera.
    """
    if not isinstance(capture, Capture):
        camera = camera if capture is None else capture
        capture = scene.capture if isinstance(scene, (Scene, ResidentCloud)) else _PLAIN
    asked = capture.with_(
        camera=camera, outputs=outputs, quality=quality, background=background, motion=motion,
        shutter=shutter, sensor=sensor, fog=fog,
    )  # fmt: skip
    if asked.camera is None:
        raise InputError(NO_CAMERA)
    return asked
