"""Output images of one or many views, on the device until they are read."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from fidsplat.backends.interface import Images, batch_stats, check_batch_memory, summed
from fidsplat.backends.warp.command_list import Launcher
from fidsplat.backends.warp.runtime import kernels, load, quiet
from fidsplat.backends.warp.workspace import Workspace
from fidsplat.effects import Output

_CONVERTING = threading.Lock()


@dataclass(eq=False)
class Rendered:
    """Views that were rendered together: their launches and counts."""

    launcher: Launcher
    counts: dict[str, int]
    """numbers of splats, of visible splats and of pairs; final after `settle`"""
    complete: Callable[[], Rendered | None] | None = None
    """for a frame with unknown counts: waits for it, and renders it again if it exceeded its capacity"""
    profile: Callable[[], Mapping[str, float]] | None = None
    """for a replayed frame: renders it again to measure its stages"""

    def settle(self) -> Rendered:
        """Wait for the counts; render the frame again if it exceeded its capacity."""
        if self.complete:
            again = self.complete()
            self.complete = None
            if again:
                self.launcher, self.counts, self.profile = again.launcher, again.counts, None
        return self

    def timings(self) -> Mapping[str, float]:
        """Milliseconds on the device by stage, in the order of execution."""
        return self.profile() if self.profile else self.launcher.timings()


class WarpImages(Images):
    """Output images of one view, or of all views of a batch."""

    shares_arrays = True

    def __init__(
        self,
        workspace: Workspace,
        outputs: Mapping[str, Output],
        size: tuple[int, int],
        view_count: int = 1,
        splats: int = 0,
    ) -> None:
        """Images of (rows, columns) pixels. Raises DeviceError if they exceed the memory budget."""
        self._outputs, self._size, self.view_count, self._splats = outputs, size, view_count, splats
        self.nbytes, pixels = 0, view_count * size[0] * size[1]
        sizes = {}
        for name, output in outputs.items():
            self.nbytes += 4 * pixels * output.channels
            if view_count > 1:  # single frames include images in their plan
                check_batch_memory(view_count, self.nbytes, workspace.memory_budget)
            dtype = getattr(load(), output.dtype)
            sizes[name] = pixels * output.channels, dtype
        pool = workspace.pool

        @cache
        def allocate() -> dict[str, Any]:
            return {name: pool.allocate(name, *size) for name, size in sizes.items()}

        self.allocate = allocate
        """returns `arrays`; allocated at the first call, so that the host submits the frame before"""
        self.rendered: list[Rendered] = []

    @property
    def arrays(self) -> dict[str, Any]:
        """Arrays by output, complete after `wait`."""
        return self.allocate()

    def blank(self) -> None:
        """Fill the images of all views with their empty value, as some views are masked out."""
        for name, output in self._outputs.items():
            self.arrays[name].fill_(output.empty_value)

    def device_array(self, name: str, index: int | None = None) -> Any:
        for part in self.rendered:
            part.settle()
        output, array = self._outputs[name], self.arrays[name]
        shape = self._size if output.channels == 1 else (*self._size, output.channels)
        if index is None:
            return array.reshape((self.view_count, *shape))
        if self.view_count > 1:
            size = math.prod(shape)
            array = array[index * size : (index + 1) * size]
        return array.reshape(shape)

    def read(self, name: str, index: int | None = None) -> np.ndarray:
        # a copy, as numpy() on the CPU shares the memory of `device_array`
        return np.array(self.device_array(name, index).numpy())

    def read_uint8(self, name: str, index: int = 0) -> np.ndarray:
        image = self.device_array(name, index)
        made = load().empty(image.size, dtype=load().uint8, device=image.device)
        given = [image.flatten(), made]
        with _CONVERTING, quiet():  # images are read in any thread, and the first read compiles
            # without a LaunchCache, which would keep the image alive
            load().launch(
                kernels("uint8").to_uint8, image.size, given, device=image.device, record_tape=False
            )
        return made.numpy().reshape(image.shape)

    def wait(self) -> None:
        for part in self.rendered:
            part.settle().launcher.finish()

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds on the device by stage, of all views together."""
        return summed(part.settle().timings() for part in self.rendered)

    @property
    def stats(self) -> Mapping[str, int]:
        return batch_stats((part.settle().counts for part in self.rendered), self._splats)
