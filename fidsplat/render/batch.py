"""FrameBatch: the images of many views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fidsplat.backends.interface import HostImages, Images
from fidsplat.capture.views import Views
from fidsplat.render.array_export import ImageMapping, SceneIds
from fidsplat.render.frame import Frame
from fidsplat.util.errors import InputError


class FrameBatch(ImageMapping):
    """Rendered views: a mapping from output names to read-only NumPy arrays (views, h, w) or
    (views, h, w, channels), which are copied from the device on first use.

    Names, types and units are those of Frame. Masked views are -1 in `label` and `splat_id`, and 0 in all
    other outputs. View i is bit-identical to `Renderer.render` of that view, except for stores with
    `detail_error` (`Renderer.render_batch`).
    """

    _noun = "batch"

    def __init__(self, images: Images, views: Views, ids: SceneIds = None) -> None:
        super().__init__(images, views.captures[0].outputs, ids)
        self._views = views

    def __repr__(self) -> str:
        camera = self._views.captures[0].camera
        size = "" if camera is None else f", {camera.width} x {camera.height}"
        return f"FrameBatch({self.views} views, {', '.join(self.outputs)}{size})"

    @property
    def views(self) -> int:
        """Number of views, including masked ones."""
        return self._images.views

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
