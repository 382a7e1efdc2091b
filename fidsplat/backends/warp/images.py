"""The output images of a picture, on the device until somebody asks for them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fidsplat.backends.interface import Images
from fidsplat.backends.warp.launch import Launcher
from fidsplat.backends.warp.picture import Into
from fidsplat.backends.warp.runtime import kernels, load, quiet
from fidsplat.effects import Output

_CONVERTING = threading.Lock()


class WarpImages(Images):
    """The output images of one picture, on the device until asked for."""

    shares_arrays = True

    def __init__(
        self,
        outputs: tuple[Output, ...],
        into: Into,
        size: tuple[int, int],
        launcher: Launcher,
        stats: dict[str, int],
    ) -> None:
        """into: where they are drawn, a view's or a batch's."""
        self._outputs = {output.name: output for output in outputs}
        self.into, self._size, self._launcher, self._stats = into, size, launcher, stats
        self.settle: Callable[[], WarpImages | None] | None = None
        """of a picture that was drawn ahead: waits for it; what it is drawn again as, in the same arrays"""
        self.timed: Callable[[], dict[str, float]] | None = None
        """of a picture that a graph has drawn: what its stages take"""

    def _settled(self) -> None:
        if self.settle:
            again = self.settle()
            self.settle = None
            if again:
                self._launcher, self._stats, self.timed = again._launcher, again._stats, None

    @property
    def stats(self) -> Mapping[str, int]:
        """How many splats there were, were drawn, and pairs of splats and tiles."""
        self._settled()
        return self._stats

    @property
    def arrays(self) -> Mapping[str, Any]:
        """What holds the images, drawn or not."""
        return self.into.arrays

    def device_array(self, name: str) -> Any:
        """The image as a wp.array (h, w) or (h, w, 3) on the device; no copy."""
        self._settled()
        output, array = self._outputs[name], self.into.arrays[name]
        return array.reshape(self._size if output.channels == 1 else (*self._size, output.channels))

    def read(self, name: str) -> np.ndarray:
        """The image as a NumPy array of its own."""
        # a CPU array's numpy() is its own memory, which device_array gives away
        return np.array(self.device_array(name).numpy())

    def read_uint8(self, name: str) -> np.ndarray:
        """Copy an image in 8 bits, converted on the device."""
        drawn = self.device_array(name)
        made = load().empty(drawn.size, dtype=load().uint8, device=drawn.device)
        given = [drawn.flatten(), made]
        with _CONVERTING, quiet():  # pictures are read in any thread, and the first read compiles
            # not by `Launcher`, whose commands would keep the image
            load().launch(
                kernels("uint8").to_uint8, drawn.size, given, device=drawn.device, record_tape=False
            )
        return made.numpy().reshape(drawn.shape)

    def wait(self) -> None:
        """Until the device has drawn it."""
        self._settled()
        self._launcher.finish()

    @property
    def timings(self) -> dict[str, float]:
        """Milliseconds on the device by stage, in the order in which they ran."""
        self._settled()
        return self.timed() if self.timed else self._launcher.timings()
