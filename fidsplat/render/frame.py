"""Frame: the images of one view. FrameBatch: the images of many views."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import chain

import numpy as np

from fidsplat.backends.interface import HostImages, Images, Pipeline, summed
from fidsplat.capture.capture import Capture
from fidsplat.capture.views import CaptureBatch
from fidsplat.render.array_export import ImageMapping, SceneIndices, check_process, with_scene_indices
from fidsplat.render.certified_error import ErrorImage
from fidsplat.streaming.bands import BandData
from fidsplat.util.arguments import invalid, whole_number


class Frame(ImageMapping):
    """A rendered frame: a mapping from output names to read-only NumPy arrays, which are copied from the
    device on first use.

    Shapes and units: `rgb` (h, w, 3) float32; `alpha` (h, w); `depth`, `depth_median`, `depth_first` (h, w)
    metres along z (fisheyes and panoramas: along the ray); `distance`, `distance_median`, `distance_first`
    metres along the ray; `normal` (h, w, 3) unit, camera frame, towards the camera, `normal_world` the same
    in the world's axes; `label`, `splat_id` (h, w) int32, of the fragment or coplanar layer with the largest
    weight; `blended` (h, w) int32, number of composited splats, with several samples the maximum over the
    samples; `error` (h, w), an upper bound of |rgb - ideal| (fidsplat/render/certified_error.py).
    `depth_median` is the depth of the last fragment or layer in front of which the transmittance is above one
    half. Consecutive fragments of weight below 1/255 count as one, at the depth where the sum of their
    weights reaches 1/255. `depth_first` is the depth of the first fragment or layer at which the accumulated
    opacity reaches `Quality.first_hit` (docs/rendering.md has the definitions). In pixels with an alpha below
    1/255 (`_first` outputs: below `first_hit`) `label` and `splat_id` are -1, and depths, distances and
    normals are 0.
    """

    _noun = "frame"

    def __init__(
        self,
        images: Images,
        capture: Capture,
        scene_indices: SceneIndices = None,
        error: ErrorImage | None = None,
        index: int = 0,
    ) -> None:
        """images: the backend's images; index: position of this view in them. capture: its camera and
        settings. scene_indices: indices of the splats in the scene, for `splat_id`. error: the output
        `error`, computed when it is read; None if it was not requested."""
        super().__init__(images, capture.outputs, scene_indices, index)
        self._error, self.capture = error, capture
        """The capture of this frame. `read_back` and `truth_of` of fidsplat.vision use its camera, shutter
        and motion."""

    @property
    def images(self) -> Images:
        """The backend's images; the frames of a batch share them."""
        return self._images

    def to_uint8(self) -> np.ndarray:
        """`rgb` as 8-bit colours, (h, w, 3) uint8: clamped to [0, 1], times 255, rounded to the nearest; NaN
        becomes 0. The device converts the image if it can, so that a quarter of the bytes is copied; a
        conversion on the host is bit-identical.

        Raises:
            InputError: `rgb` was not requested.
        """
        self._check("rgb")
        if "rgb" not in self._arrays:
            check_process(self._pid, "frame")
            converted = self._images.read_uint8("rgb", self._index or 0)
            if converted is not None:
                return converted
        from fidsplat.images.files import to_uint8  # here, since it imports OpenCV

        return to_uint8(self["rgb"])

    def __repr__(self) -> str:
        ms = sum(self.timings.values())
        splats = f", {self.stats['splats']:,} splats" if "splats" in self.stats else ""
        return f"Frame({', '.join(self.outputs)}{splats}, {ms:.1f} ms)"

    def _repr_png_(self) -> bytes:
        """PNG for notebooks: rgb, or else the first output in false colours."""
        from fidsplat.images.files import encode_png  # here, since it imports OpenCV
        from fidsplat.render.output_files import visualisation_of

        name = "rgb" if "rgb" in self.outputs else self.outputs[0]
        return encode_png(visualisation_of(name, self[name]))

    def __reduce__(self):
        """Pickle and copy as NumPy arrays; arrays of `device_array` are not included."""
        return _host_frame, (dict(self), dict(self.timings), dict(self.stats), self.capture.picklable())

    def read_rows(self, name: str, first: int, end: int, into: np.ndarray | None = None) -> np.ndarray:
        """Copy rows of pixels [first, end) of an output into `into`, or into a new array of the complete
        shape, and return it. Only these rows are transferred if the device supports that.

        Raises:
            InputError: rows outside the frame, or an array of another shape or type.
        """
        self._check(name)
        images, index = self._images, self._index or 0
        if name == "error":
            images, index = HostImages({name: self[name][None]}, {}, {}), 0
        empty = images.empty(name)
        if into is None:
            into = empty
        elif not isinstance(into, np.ndarray) or (into.shape, into.dtype) != (empty.shape, empty.dtype):
            raise invalid("into", f"an array {empty.shape} of {empty.dtype}", into)
        whole_number("the end of the rows", end, 0, len(into))
        whole_number("the first row", first, 0, end)
        images.read_rows(name, first, end, into, index)
        if name == "splat_id":
            into[first:end] = with_scene_indices(name, into[first:end], self._scene_indices)
        return into

    @property
    def timings(self) -> Mapping[str, float]:
        if self._images.view_count > 1:
            return {}
        return super().timings if self._error is None else {**super().timings, **self._error.timings}

    @property
    def stats(self) -> Mapping[str, int]:
        return super().stats if self._images.view_count == 1 else {}


def _host_frame(
    arrays: dict[str, np.ndarray], timings: dict[str, float], stats: dict[str, int], capture: Capture
) -> Frame:
    images = HostImages({name: image[None] for name, image in arrays.items()}, timings, stats)
    return Frame(images, capture)


class FrameBatch(ImageMapping):
    """Rendered views: a mapping from output names to read-only NumPy arrays (views, h, w) or
    (views, h, w, channels), which are copied from the device on first use.

    Names, types and units are those of Frame. Masked views are -1 in `label` and `splat_id`, and 0 in all
    other outputs. View i is bit-identical to `Renderer.render` of that view, except for scenes on disk whose
    levels of detail are used (`Quality.detail_error` above 0; see `Renderer.render_batch`).
    """

    _noun = "batch"

    def __init__(self, images: Images, views: CaptureBatch, scene_indices: SceneIndices = None) -> None:
        super().__init__(images, views.captures[0].outputs, scene_indices)
        self._captures, self.views = views, images.view_count
        """Number of views, including masked ones."""

    def __repr__(self) -> str:
        camera = self._captures.captures[0].camera
        size = "" if camera is None else f", {camera.width} x {camera.height}"
        return f"FrameBatch({self.views} views, {', '.join(self.outputs)}{size})"

    def frame(self, number: int) -> Frame:
        """One view as a Frame, without timings and stats. Images are copied to the host on first use.

        Raises:
            InputError: the number of the view is out of range.
        """
        number = whole_number("number of the view", number, 0, self.views - 1)
        return Frame(self._images, self._captures.capture(number), self._scene_indices, index=number)

    def __reduce__(self):
        """Pickle and copy as NumPy arrays."""
        captures = tuple(capture.picklable() for capture in self._captures.captures)
        views = replace(self._captures, captures=captures)
        return _host_batch, (dict(self), dict(self.timings), dict(self.stats), views)


def _host_batch(
    arrays: dict[str, np.ndarray], timings: dict[str, float], stats: dict[str, int], views: CaptureBatch
) -> FrameBatch:
    return FrameBatch(HostImages(arrays, timings, stats), views)


def stack_bands(bands: Iterable[BandData], pipeline: Pipeline, capture: Capture) -> Frame:
    """Render bands of rows and stack them to one frame.

    The device stores the splats of one band at a time. Each band is copied to the host while the next is
    rendered. A single band stays on the device.
    """
    arrays: dict[str, np.ndarray] = {}
    timings: dict[str, float] = {}
    stats: dict[str, int] = {}
    previous: tuple[Frame, tuple[int, int]] | None = None
    for band in chain(bands, (None,)):  # None: after the last band
        if previous is not None:
            if band is None and not arrays:
                return previous[0]
            previous[0].wait()
            timings, stats = summed([timings, previous[0].timings]), summed([stats, previous[0].stats])
        current = None
        if band is not None:
            images = band.images or pipeline.render_view(band.data, band.view)
            current = Frame(images, capture, band.scene_indices), band.rows
        if previous is not None:
            for name in capture.outputs:
                arrays[name] = previous[0].read_rows(name, *previous[1], arrays.get(name))
        previous = current
    return _host_frame(arrays, timings, stats, capture)
