"""Output images of one or many views, on the device until they are read."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.interface import Images, summed
from fidsplat.backends.warp.command_list import Launcher
from fidsplat.backends.warp.frame import ImageArrays
from fidsplat.backends.warp.runtime import kernels, load, quiet
from fidsplat.backends.warp.workspace import Workspace
from fidsplat.effects import Output
from fidsplat.util.errors import DeviceError, bytes_words

_CONVERTING = threading.Lock()


class WarpImages(Images):
    """Output images of one view, or of views that were rendered together."""

    shares_arrays = True

    def __init__(
        self,
        outputs: tuple[Output, ...],
        into: ImageArrays,
        size: tuple[int, int],
        launcher: Launcher,
        stats: dict[str, int],
    ) -> None:
        """into: arrays of a view, or of a batch. size: rows and columns of pixels."""
        self._outputs = {output.name: output for output in outputs}
        self.into, self._size, self._launcher, self._stats = into, size, launcher, stats
        self.settle: Callable[[], WarpImages | None] | None = None
        """of a frame whose counts are not known: waits for it, and returns its second rendering into the same
        arrays if it exceeded its capacity"""
        self.profile: Callable[[], dict[str, float]] | None = None
        """of a replayed frame: measures its stages"""

    def _settled(self) -> None:
        if self.settle:
            again = self.settle()
            self.settle = None
            if again:
                self._launcher, self._stats, self.profile = again._launcher, again._stats, None

    @property
    def stats(self) -> Mapping[str, int]:
        """splats, visible, pairs."""
        self._settled()
        return self._stats

    @property
    def arrays(self) -> Mapping[str, Any]:
        """Arrays of the images, complete or not."""
        return self.into.arrays

    def device_array(self, name: str, index: int | None = None) -> Any:
        """The image as a wp.array (1, h, w) or (1, h, w, 3), with an index without the first dimension, on
        the device; no copy."""
        self._settled()
        output, array = self._outputs[name], self.into.arrays[name]
        shape = self._size if output.channels == 1 else (*self._size, output.channels)
        return array.reshape((1, *shape) if index is None else shape)

    def read(self, name: str, index: int | None = None) -> np.ndarray:
        """Copy the image to the host."""
        # a CPU array's numpy() is its own memory, which device_array shares
        return np.array(self.device_array(name, index).numpy())

    def read_uint8(self, name: str, index: int = 0) -> np.ndarray:
        """Copy the image to the host in 8 bits, converted on the device."""
        image = self.device_array(name, index)
        made = load().empty(image.size, dtype=load().uint8, device=image.device)
        given = [image.flatten(), made]
        with _CONVERTING, quiet():  # images are read in any thread, and the first read compiles
            # not by a LaunchCache, which would keep the image alive
            load().launch(
                kernels("uint8").to_uint8, image.size, given, device=image.device, record_tape=False
            )
        return made.numpy().reshape(image.shape)

    def wait(self) -> None:
        """Wait until the device has rendered them."""
        self._settled()
        self._launcher.finish()

    @property
    def timings(self) -> dict[str, float]:
        """Milliseconds on the device by stage, in their order."""
        self._settled()
        return self.profile() if self.profile else self._launcher.timings()


class WarpBatch(Images):
    """Output images of all views of a batch."""

    shares_arrays = True

    def __init__(
        self, workspace: Workspace, outputs: tuple[Output, ...], batch: ViewBatch, splats: int
    ) -> None:
        """
        Raises:
            DeviceError: they exceed the memory budget, or the memory of the device.
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
            if len(batch) < batch.total:
                array.fill_(output.blank)
            self._images[output.name] = output, array
        self._parts: list[WarpImages] = []

    def arrays_of(self, indices: np.ndarray) -> ImageArrays:
        """Output arrays of the views of these indices."""
        wp = load()
        numbers = wp.array(indices.astype(np.int32), dtype=wp.int32, device=self._workspace.device)
        return ImageArrays({name: array for name, (_, array) in self._images.items()}, numbers)

    def add(self, images: WarpImages) -> None:
        """Add views that were rendered together."""
        self._parts.append(images)

    def _settle(self) -> None:
        for images in self._parts:
            images.wait()

    def device_array(self, name: str, index: int | None = None) -> Any:
        """The images as a wp.array (views, h, w) or (views, h, w, 3), with an index that of one view, on the
        device; no copy."""
        self._settle()
        output, array = self._images[name]
        shape = self._size if output.channels == 1 else (*self._size, output.channels)
        if index is None:
            return array.reshape((self.views, *shape))
        size = math.prod(shape)
        return array[index * size : (index + 1) * size].reshape(shape)

    def read(self, name: str, index: int | None = None) -> np.ndarray:
        """Copy the images of all views, or of one, to the host."""
        return np.array(self.device_array(name, index).numpy())

    def wait(self) -> None:
        """Wait until the device has rendered all views."""
        self._settle()
        load().synchronize_device(self._workspace.device)

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds by stage, of all views together."""
        return summed(images.timings for images in self._parts)

    @property
    def stats(self) -> Mapping[str, int]:
        """visible and pairs, sums over all views; splats in the cloud."""
        none = {"splats": 0, "visible": 0, "pairs": 0}
        return summed([none, *(images.stats for images in self._parts)]) | {"splats": self._splats}
