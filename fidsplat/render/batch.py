"""FrameBatch: the images of many views."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from fidsplat.backends.interface import HostImages, Images
from fidsplat.capture.views import Views
from fidsplat.render.array_export import ArrayExport
from fidsplat.render.frame import Frame, SceneIds, check_process, refuse_scene_ids, with_scene_ids
from fidsplat.util.errors import InputError, MissingOutputError


class FrameBatch(ArrayExport):
    """Rendered views: a mapping from output names to read-only NumPy arrays (views, h, w) or
    (views, h, w, channels), which are copied from the device on first use.

    Names, types and units are those of Frame. Masked views are -1 in `label` and `splat_id`, and 0 in all
    other outputs. View i is bit-identical to `Renderer.render` of that view, except for stores with
    `detail_error` (`Renderer.render_batch`).
    """

    def __init__(self, images: Images, views: Views, ids: SceneIds = None) -> None:
        """ids: scene indices of the splats on the device, for `splat_id`."""
        self._images, self._process, self._ids = images, os.getpid(), ids
        self._views = views
        self._arrays: dict[str, np.ndarray] = {}
        self.outputs = views.captures[0].outputs
        """Names of the images, in the requested order."""

    _noun = "batch"

    def __repr__(self) -> str:
        camera = self._views.captures[0].camera
        size = "" if camera is None else f", {camera.width} x {camera.height}"
        return f"FrameBatch({self.views} views, {', '.join(self.outputs)}{size})"

    @property
    def views(self) -> int:
        """Number of views, including masked ones."""
        return self._images.views

    def __getitem__(self, name: str) -> np.ndarray:
        self._check(name)
        if name not in self._arrays:
            check_process(self._process, "batch")
            self._arrays[name] = images = with_scene_ids(name, self._images.read(name), self._ids)
            images.flags.writeable = False  # cached
        return self._arrays[name]

    def device_array(self, name: str) -> Any:
        """The images on their device, without a copy, (views, h, w) or (views, h, w, channels).

        On an OpenCL device it is a pyopencl.array.Array. On a Warp device it is a wp.array, which DLPack
        converts to a tensor.

        The batch owns the arrays; the next batch has new ones.

        Raises:
            InputError: an output that was not requested, or the backend shares no arrays.
        """
        self._check(name)
        check_process(self._process, "batch")
        refuse_scene_ids(name, self._ids)
        return self._images.device_array(name)

    def _is_shared(self, name: str) -> bool:
        """Whether the device shares an array of these images."""
        return self._images.shares_arrays and not (name == "splat_id" and self._ids is not None)

    def frame(self, number: int) -> Frame:
        """One view as a Frame, without timings and stats. Images are copied to the host on first use.

        Raises:
            InputError: the number of the view is out of range.
        """
        if (
            isinstance(number, bool)
            or not isinstance(number, (int, np.integer))
            or not 0 <= number < self.views
        ):
            raise InputError(f"the view must be a number from 0 to {self.views - 1}, got {number!r}")
        return Frame(self._images, self._views.capture(int(number)), self._ids, index=int(number))

    def wait(self) -> FrameBatch:
        """Wait until the device has rendered this batch; nothing is copied."""
        self._images.wait()
        return self

    def _check(self, name: str) -> None:
        if not isinstance(name, str) or name not in self.outputs:
            raise MissingOutputError(
                f"an output of this batch must be one of {', '.join(self.outputs)}, got {name!r}; add it to "
                "`outputs` when you render"
            )

    def __iter__(self) -> Iterator[str]:
        return iter(self.outputs)

    def __len__(self) -> int:
        return len(self.outputs)

    def __reduce__(self):
        """Pickled and copied as NumPy arrays."""
        views = replace(self._views, captures=tuple(one.picklable() for one in self._views.captures))
        return _host_batch, (dict(self), dict(self.timings), dict(self.stats), views)

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds on the device by stage, for all views together."""
        return self._images.timings

    @property
    def stats(self) -> Mapping[str, int]:
        """Number of splats in the cloud, and of visible splats and pairs of all views together."""
        return self._images.stats


def _host_batch(
    arrays: dict[str, np.ndarray], timings: dict[str, float], stats: dict[str, int], views: Views
) -> FrameBatch:
    return FrameBatch(HostImages(arrays, timings, stats), views)
