"""Many views of one cloud on a Warp device: parts of as many as memory holds, each one submission."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.interface import BatchImages, summed
from fidsplat.backends.warp.images import WarpImages
from fidsplat.backends.warp.picture import Into
from fidsplat.backends.warp.runtime import load
from fidsplat.backends.warp.workspace import Workspace
from fidsplat.effects import Output
from fidsplat.util.errors import DeviceError, bytes_words

_MOST = {True: 1 << 31, False: 1 << 28}
"""bytes that the views of a part take together on CUDA, and on the CPU: more is no faster"""
_MOST_NUMBERED = 1 << 30
"""samples, and lines of records, of all views of a part; kernels number them in 32 bits"""


def parts(
    views: int, each: int, samples: int, lines: int, workspace: Workspace, free: int
) -> Iterator[tuple[int, int]]:
    """Ranges of views (first, end) that are drawn together.

    Args:
        each: bytes that a view takes. samples, lines: of a view. free: bytes that there are.
    """
    # half is for the lists
    room = min(free // 2, _MOST[workspace.device.is_cuda]) // each
    together = max(1, min(room, _MOST_NUMBERED // max(samples, lines)))
    # of equal size, so that launches of one are those of the next
    count = -(-views // together)
    return pairwise([views * k // count for k in range(count + 1)])


class WarpBatch(BatchImages):
    """The output images of many views, on the device until asked for."""

    shares_arrays = True

    def __init__(
        self, workspace: Workspace, outputs: tuple[Output, ...], batch: ViewBatch, splats: int
    ) -> None:
        """
        Raises:
            DeviceError: they take more than the memory budget, or than the device has.
        """
        self._workspace, self._size, self.views, self._splats = workspace, batch.size, batch.total, splats
        height, width = batch.size
        self.nbytes = 4 * batch.total * height * width * sum(output.channels for output in outputs)
        if self.nbytes > workspace.memory_budget:
            raise DeviceError(
                f"the images of {batch.total} views take {bytes_words(self.nbytes)}, more than the memory "
                f"budget of {bytes_words(workspace.memory_budget)}; draw fewer views or outputs at once"
            )
        self._images: dict[str, tuple[Output, Any]] = {}
        for output in outputs:
            size, dtype = batch.total * height * width * output.channels, getattr(load(), output.dtype)
            array = workspace.pool.fresh(f"{output.name} of {batch.total} views", size, dtype)
            if len(batch.slots) < batch.total:
                array.fill_(output.blank)
            self._images[output.name] = output, array
        self._pictures: list[WarpImages] = []

    def into(self, slots: np.ndarray) -> Into:
        """Where the images of these views go."""
        wp = load()
        numbers = wp.array(slots.astype(np.int32), dtype=wp.int32, device=self._workspace.device)
        return Into({name: array for name, (_, array) in self._images.items()}, numbers)

    def add(self, images: WarpImages) -> None:
        """Views that were drawn together."""
        self._pictures.append(images)

    def _settle(self) -> None:
        """Views that were drawn ahead are drawn."""
        for images in self._pictures:
            images.wait()

    def device_array(self, name: str) -> Any:
        """The images as a wp.array (views, h, w) or (views, h, w, 3) on the device; no copy."""
        self._settle()
        output, array = self._images[name]
        shape = self.views, *self._size
        return array.reshape(shape if output.channels == 1 else (*shape, output.channels))

    def read(self, name: str) -> np.ndarray:
        """The images as a NumPy array of its own."""
        return np.array(self.device_array(name).numpy())

    def read_one(self, name: str, number: int) -> np.ndarray:
        """The image of one view."""
        self._settle()
        output, array = self._images[name]
        shape = self._size if output.channels == 1 else (*self._size, output.channels)
        size = math.prod(shape)
        return np.array(array[number * size : (number + 1) * size].numpy()).reshape(shape)

    def wait(self) -> None:
        """Until the device has drawn all views."""
        self._settle()
        load().synchronize_device(self._workspace.device)

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds by stage, of all views together."""
        return summed(images.timings for images in self._pictures)

    @property
    def stats(self) -> Mapping[str, int]:
        """Of all views together, but for the splats of the cloud."""
        none = {"splats": 0, "visible": 0, "pairs": 0}
        return summed([none, *(images.stats for images in self._pictures)]) | {"splats": self._splats}
