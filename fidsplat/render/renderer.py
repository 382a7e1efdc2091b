"""Renderer: public interface to rendering."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Unpack
from weakref import WeakKeyDictionary

import numpy as np

from fidsplat.backends.interface import DeviceInfo, Images
from fidsplat.backends.prepare import prepare, prepare_batch
from fidsplat.backends.registry import AUTO, open_backend
from fidsplat.backends.view import NO_CAMERA, View
from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture, CaptureFields, output_names
from fidsplat.capture.environment import background_of
from fidsplat.capture.quality import Quality
from fidsplat.capture.sensor import Sensor
from fidsplat.capture.views import CaptureBatch, capture_batch
from fidsplat.effects.differentiable import check_gradients, with_distortion
from fidsplat.render.array_export import check_process
from fidsplat.render.certified_error import ErrorImage, error_reference
from fidsplat.render.differentiable_frame import DifferentiableFrame
from fidsplat.render.frame import Frame, FrameBatch, stack_bands
from fidsplat.render.lighting import lit_scene
from fidsplat.render.resident import ResidentCloud
from fidsplat.scenes import Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.store.chunked_splats import ChunkedSplats
from fidsplat.store.store import Store
from fidsplat.streaming.device_chunk_cache import DeviceChunkCache, double_buffered
from fidsplat.util import interrupts
from fidsplat.util.arguments import invalid, whole_number
from fidsplat.util.errors import InputError, unknown

_DEFAULT_CAPTURE = Capture()
Subsampling = tuple[int, Callable[[float], object] | None] | None
"""arguments `step` and `progress` of `Pipeline.render_subsampled`; None: all pixels"""
METERING_WIDTH = 96
"""width [pixels] of the small frame in which the light is measured for a sensor"""


def default_device() -> str:
    """Default device: the environment variable FIDSPLAT_DEVICE, else `auto`."""
    return os.environ.get("FIDSPLAT_DEVICE", "").strip() or AUTO


class Renderer:
    """Renders splats on one device. Compiled pipelines and scratch buffers are reused from frame to frame.

    A renderer is thread-safe: it renders the frames of several threads one after another. A forked process
    must open its own renderer.

    Args:
        device: "opencl" (the best OpenCL device), "opencl:NAME" (NAME: cpu, gpu, or a part of a platform's
            or a GPU's name), "warp:cpu", "warp:cuda" (NVIDIA Warp), "reference" (NumPy, float64, slow), or
            "auto" ("opencl", else "warp" with a warning). None: the variable FIDSPLAT_DEVICE, else "auto".
        memory_budget: bytes of device memory for a frame and its cloud; by default nine tenths of the
            device's memory. Tile lists that exceed it are split into ranges of tiles. OpenCL also projects
            larger clouds in slices, and renders in bands of rows; a larger cloud is an error on Warp.
            Smaller budgets are slower, with bit-identical images.

    Raises:
        DeviceError: the device cannot be used; UnknownDeviceError: no device has this name.
        InputError: the memory budget is not a positive integer, or the device does not support one.
    """

    def __init__(self, device: str | None = None, memory_budget: int | None = None) -> None:
        self.backend = open_backend(default_device() if device is None else device)
        self._pid, self._lock = os.getpid(), threading.Lock()
        self._lit_scenes: WeakKeyDictionary[Scene, Scene] = WeakKeyDictionary()
        if memory_budget is not None:
            if isinstance(memory_budget, bool) or not isinstance(memory_budget, int) or memory_budget <= 0:
                raise InputError(
                    f"memory_budget must be a positive whole number of bytes, got {memory_budget!r}; give "
                    "for example 2 * 2**30"
                )
            self.backend.limit_memory(memory_budget)

    def __repr__(self) -> str:
        return f"Renderer({self.device.name!r}, {self.device.title})"

    def __reduce__(self):
        raise InputError(
            "a Renderer holds a device and cannot be pickled or copied; open one where it is used, e.g. "
            f"fs.Renderer({self.device.name!r}) in each worker"
        )

    @property
    def device(self) -> DeviceInfo:
        """The device of this renderer."""
        return self.backend.info

    def upload(self, scene: Scene | SplatCloud | Store) -> ResidentCloud:
        """Copy a scene's splats to the device, to render them many times.

        `render` uses the capture of this scene by default. A store is a scene in
        chunks on disk; its chunks are read when a view needs them.
        """
        check_process(self._pid, "Renderer")
        capture = scene.capture if isinstance(scene, Scene) else _DEFAULT_CAPTURE
        scene = self.lit(scene) if isinstance(scene, Scene) else scene
        scene = Scene(stores=(scene,)) if isinstance(scene, Store) else scene
        cloud = scene.splats if isinstance(scene, Scene) else scene
        if isinstance(cloud, ChunkedSplats):
            return ResidentCloud(self.backend, DeviceChunkCache(cloud, self.backend), capture)
        if not isinstance(cloud, SplatCloud):
            raise invalid("scene", "a Scene, a SplatCloud or a Store", scene, "Scene.load reads a file")
        with self._lock:
            return ResidentCloud(self.backend, self.backend.upload(cloud), capture, cloud.labels)

    def lit(self, scene: Scene) -> Scene:
        """Compute the colours of markers that have `light`; `upload` and `render` call it.

        Returns the scene with these colours, cached for each scene.

        Raises:
            InputError: the light of a marker cannot be computed, e.g. its surroundings are black.
        """
        if not any(placed.light for placed in scene.markers):
            return scene
        if scene not in self._lit_scenes:
            self._lit_scenes[scene] = lit_scene(scene, self)
        return self._lit_scenes[scene]

    def wrap_arrays(
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
        """Wrap arrays on the device as a cloud, without a copy.

        Shapes and units are those of SplatCloud, float32 (labels int32): wp.array, or objects with DLPack
        (torch, CuPy, JAX); NumPy arrays are copied. Scales (n, 3) make 3D Gaussians; a splat whose third
        scale is 0 is a disk. Arrays are read when a frame is rendered, so a simulation may move the splats
        between frames. Quaternions need no unit length; invalid splats (a value that is not finite, a scale
        below 0) are not rendered. `means` are relative to `origin` (3,), a world position.

        Raises:
            InputError: the backend cannot wrap arrays, or one has the wrong shape, type or device.
        """
        check_process(self._pid, "Renderer")
        if (colors is None) == (sh is None):
            given = "none; give one" if colors is None else "both; leave one out"
            raise InputError(f"exactly one of colors (n, 3) and sh (n, k, 3) must be given, got {given}")
        arrays = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
        arrays |= {"colors": colors} if sh is None else {"sh": sh}
        arrays |= {} if labels is None else {"labels": labels}
        with self._lock:
            data = self.backend.wrap_arrays(arrays, np.asarray(tuple(origin), dtype=np.float64))
        return ResidentCloud(self.backend, data, _DEFAULT_CAPTURE)

    def render(
        self,
        scene: Scene | SplatCloud | Store | ResidentCloud,
        capture: Capture | Camera | None = None,
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
        **fields: Unpack[CaptureFields],
    ) -> Frame:
        """Render one frame: `render(scene, Capture(camera, ...))`, or the fields of a capture as arguments.

        Args:
            scene: splats to render.
            capture: camera and settings, or only a camera; by default the capture of the scene or of its
                ResidentCloud.
            outputs, quality, **fields: replace these fields of the capture (`CaptureFields`).

        Raises:
            InputError: no camera, an unknown output or preset, a frame that is too large, a cloud
                uploaded by another renderer.
            DeviceError: the device fails or lacks memory.
        """
        requested = _capture_of(scene, capture, outputs=outputs, quality=quality, **fields)
        return self._render(self._resident(scene), requested)

    def render_differentiable(
        self,
        scene: Scene | SplatCloud | ResidentCloud,
        capture: Capture | Camera | None = None,
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
        *,
        distortion: bool = False,
        **fields: Unpack[CaptureFields],
    ) -> DifferentiableFrame:
        """Render one frame whose `backward` returns gradients; the images are bit-identical to `render`.

        ```python
        frame = renderer.render_differentiable(resident, capture)
        gradients = frame.backward({"rgb": 2 * (frame["rgb"] - photograph)})
        gradients["means"]                                                    # (n, 3) float32
        ```

        Args:
            scene: disks and 3D Gaussians with colours or spherical harmonics; no store (a scene in chunks on
                disk).
            capture, outputs, quality, **fields: as in `render`. Outputs are some of `rgb`, `alpha`, `depth`
                and `normal`; docs/gradients.md lists the supported effects.
            distortion: render the image `distortion` (h, w) too: sum over pairs of a pixel's splats of
                w_i w_j (m_i - m_j)^2, m the depth in normalised device coordinates, as in 2DGS.

        Raises:
            InputError: as `render`; an effect or an output without a gradient.
            DeviceError: the device has no gradients, fails, or lacks the memory to render without bands.
        """
        requested = _capture_of(scene, capture, outputs=outputs, quality=quality, **fields)
        resident = self._resident(scene)
        if isinstance(resident.data, DeviceChunkCache):
            raise InputError(
                "scene must be a SplatCloud or a Scene without stores to be differentiated, got a store; "
                "load its splats first"
            )
        interrupts.check()
        features, view = prepare(resident.data, requested)
        check_gradients(features, requested.outputs)
        with self._lock:
            pipeline = self.backend.gradient_pipeline(with_distortion(features) if distortion else features)
            images = pipeline.forward(resident.data, view)
        return DifferentiableFrame(images, requested, pipeline, self._lock, distortion)

    def render_subsampled(
        self,
        step: int,
        scene: Scene | SplatCloud | ResidentCloud,
        capture: Capture | Camera | None = None,
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
        progress: Callable[[float], object] | None = None,
    ) -> Frame:
        """Render only every step-th pixel in both directions, bit-identical to these pixels of `render`.

        Only the device "reference" supports this.

        Args:
            step: 1 or more.
            scene, capture, outputs, quality: as `render`.
            progress: called with the completed fraction, 0 to 1.

        Raises:
            InputError: as `render`; the device renders complete frames only.
        """
        whole_number("step", step, 1, 2**31 - 1)
        requested = _capture_of(scene, capture, outputs=outputs, quality=quality)
        resident = self._resident(scene)
        if not self.backend.renders_subsampled:
            raise InputError(
                self.backend.unsupported_message(
                    "render subsets of pixels", "use device='reference', or render complete frames"
                )
            )
        return self._render(resident, requested, subsampling=(step, progress))

    def render_band(
        self,
        band: tuple[int, int],
        scene: Scene | SplatCloud | Store | ResidentCloud,
        capture: Capture | Camera | None = None,
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
    ) -> Frame:
        """Render rows of pixels [first, end), bit-identical to `render`.

        The other rows of the frame are undefined. `fs.SeveralDevices` combines bands of several devices.

        Raises:
            InputError: as `render`; rows outside the frame.
        """
        requested = _capture_of(scene, capture, outputs=outputs, quality=quality)
        rows = requested.camera.height if requested.camera is not None else 0
        try:
            first, end = band
        except (TypeError, ValueError):
            raise InputError(f"band must be two rows (first, end), got {band!r}") from None
        whole_number("the first row of a band", first, 0, rows - 1)
        whole_number("the end of a band", end, first + 1, rows)
        return self._render(self._resident(scene), requested, band=band)

    def render_views(
        self,
        scene: Scene | SplatCloud | Store | ResidentCloud,
        captures: Iterable[Capture | Camera],
        outputs: Iterable[str] | None = None,
        quality: Quality | str | None = None,
        **fields: Unpack[CaptureFields],
    ) -> Iterator[Frame]:
        """Render one cloud many times: one Frame for each capture or camera, in order.

        The cloud is uploaded once, kernels and buffers are reused, and an asynchronous device renders the
        next frame while the caller uses the previous one. Arguments and errors: see `render`. A camera
        motion of a capture replaces the pose of its camera. An error of a capture is raised after the frames
        before it.
        """
        # read once: an iterator of names would be exhausted by the first frame
        outputs = None if outputs is None else output_names(outputs)
        background = fields.get("background")
        if background is not None:
            fields["background"] = background_of(background)
        try:
            remaining = iter(captures)
        except TypeError:
            raise invalid("captures", "a list of Capture or Camera", captures) from None
        resident = self._resident(scene)
        requested = (
            _capture_of(scene, capture, outputs=outputs, quality=quality, **fields) for capture in remaining
        )
        if isinstance(resident.data, DeviceChunkCache):
            requested = resident.data.prefetched(requested)
        yield from double_buffered(self._render(resident, capture) for capture in requested)

    def render_batch(
        self,
        scene: Scene | SplatCloud | Store | ResidentCloud,
        captures: Iterable[Capture | Camera] | Capture | Camera,
        *,
        poses: Any = None,
        groups: Mapping[int, Any] | None = None,
        mask: Any = None,
    ) -> FrameBatch:
        """Render many views of one cloud at once. View i is bit-identical to `render` of that view.

        Exception: with stores (scenes in chunks on disk) and `Quality.detail_error` above 0, all views use
        the finest level of detail that any of them needs.

        Args:
            scene: splats to render; a ResidentCloud is not uploaded again.
            captures: one Capture or Camera for each view, with equal size and effects; or one for all views.
                A Camera replaces the camera of the scene's capture, as in `render`.
            poses: (views, 7) float64, camera to world: x y z in metres and a quaternion w x y z of any
                length but 0. They replace the cameras' own poses.
            groups: {label: (views, 7)}: motion of the splats of that label in the world, relative to their
                positions in the cloud (`Motion.groups`).
            mask: (views,) bool: views with False are not rendered; their images are 0, and -1 in `label` and
                `splat_id`.

        Raises:
            InputError: as `render`; numbers of views, sizes, outputs or effects that differ; arrays of
                another shape; an invalid pose; a label that no splat has.
            DeviceError: the device fails or lacks memory.
        """
        resident = self._resident(scene)
        try:
            items = [captures] if isinstance(captures, (Capture, Camera)) else list(captures)
        except TypeError:
            raise invalid("captures", "a list of Capture or Camera", captures) from None
        requested = [_capture_of(scene, item) for item in items]
        if any("error" in capture.outputs for capture in requested):
            raise InputError(
                f"the output 'error' must be rendered one capture at a time, got a batch of {len(requested)}"
                "; call render() for each capture, or leave out the output 'error'"
            )
        views = capture_batch(requested, poses, groups, mask)
        self._refuse_unknown_labels(resident, views)
        return self._render_batch(resident, views)

    def _refuse_unknown_labels(self, resident: ResidentCloud, views: CaptureBatch) -> None:
        if views.groups and resident.labels is not None:
            for label in views.groups:
                if label not in resident.labels:
                    known = map(str, sorted(resident.labels))
                    raise InputError(unknown("label of splats", str(label), known))

    def _render_batch(self, resident: ResidentCloud, views: CaptureBatch) -> FrameBatch:
        interrupts.check()
        if any(capture.sensor.needs_metering for capture in views.captures):
            captures = [views.capture(number) for number in range(len(views))]
            for number in views.active:
                captures[number] = self._metered(resident, captures[number])
            # masked views are not rendered, so they get the sensor of a rendered one
            metered = next((captures[number].sensor for number in views.active), Sensor())
            for number in {*range(len(views))} - {*views.active}:
                captures[number] = captures[number].with_(sensor=metered)
            views = CaptureBatch(tuple(captures), mask=views.mask)
        features, batch = prepare_batch(resident.all_splats, views)
        with self._lock:
            rendered = (batch.view_at(number) for number in range(len(batch)))
            data, scene_indices = resident.gather(
                rendered, features, (capture.quality for capture in views.captures)
            )
            # tile size and work-groups for images of this size
            config = self.backend.frame_config(batch.view, len(batch))
            images = self.backend.pipeline(features, config).render(data, batch)
        return FrameBatch(images, views, scene_indices)

    def _resident(self, scene: Scene | SplatCloud | Store | ResidentCloud) -> ResidentCloud:
        resident = scene if isinstance(scene, ResidentCloud) else self.upload(scene)
        check_process(self._pid, "Renderer")
        if resident.backend is not self.backend:
            raise InputError(
                "the cloud must be uploaded by this Renderer, got one of another Renderer; upload it again"
            )
        return resident

    def _metered(self, resident: ResidentCloud, capture: Capture) -> Capture:
        """The capture with sensor settings metered in a small frame."""
        camera = capture.camera
        if not capture.sensor.needs_metering or camera is None:
            return capture
        if capture.external_depth is None and camera.width > METERING_WIDTH:
            height = max(1, round(camera.height * METERING_WIDTH / camera.width))
            camera = camera.with_size(METERING_WIDTH, height)
        without_sensor = capture.with_(camera=camera, outputs=("rgb",), sensor=Sensor())
        colors = self._render(resident, without_sensor)["rgb"]
        return capture.with_(sensor=capture.sensor.metered(np.asarray(colors)))

    def _render(
        self,
        resident: ResidentCloud,
        capture: Capture,
        band: tuple[int, int] | None = None,
        subsampling: Subsampling = None,
    ) -> Frame:
        """Render one frame. band: rows of pixels [first, end); None: all."""
        interrupts.check()
        capture, data = self._metered(resident, capture), resident.data
        features, view = prepare(resident.all_splats, capture)
        passes, reference = [(features, view)], None
        if "error" in capture.outputs:
            reference = error_reference(data, capture, self.backend)
            passes.append((reference.features, reference.view))
        if band is not None:
            passes = [(features, _restricted(view, band)) for features, view in passes]
        images: list[Images] = []
        with self._lock:  # scratch buffers and kernel arguments belong to one frame at a time
            for features, view in passes:
                pipeline = self.backend.pipeline(features, self.backend.frame_config(view))
                if isinstance(data, DeviceChunkCache):
                    bands = data.bands(view, features, capture.quality, pipeline)
                    return stack_bands(bands, pipeline, capture)
                if subsampling is None:
                    images.append(pipeline.render_view(data, view))
                else:
                    images.append(pipeline.render_subsampled(data, view, *subsampling))
        error = None if reference is None else ErrorImage(images[0], images[1], reference)
        return Frame(images[0], capture, error=error)


def _restricted(view: View, band: tuple[int, int]) -> View:
    """The view restricted to rows of pixels [first, end)."""
    return replace(view, sample_rows=(band[0] * view.samples, band[1] * view.samples))


def _capture_of(scene: Any, capture: Capture | Camera | None, **fields: Any) -> Capture:
    """The given capture, or by default the scene's capture, with the given fields replaced."""
    if not isinstance(capture, Capture):
        if capture is not None:
            fields["camera"] = capture
        capture = scene.capture if isinstance(scene, (Scene, ResidentCloud)) else _DEFAULT_CAPTURE
    requested = capture.with_(**fields)
    if requested.camera is None:
        raise InputError(NO_CAMERA)
    return requested
