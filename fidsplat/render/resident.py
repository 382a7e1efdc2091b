"""ResidentCloud: splats where a renderer draws them."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Any

import numpy as np

from fidsplat.backends.interface import Backend, ResidentData
from fidsplat.backends.view import View
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.effects import FeatureSet
from fidsplat.render.frame import Ids
from fidsplat.streaming.residency import Residency
from fidsplat.util.errors import InputError


class ResidentCloud:
    """A cloud on a renderer's device; rendering it transfers no splat. Of a store, or a scene with stores,
    what views need is brought there when they are drawn, and what the last one needed stays."""

    def __init__(
        self,
        backend: Backend,
        data: ResidentData | Residency,
        capture: Capture,
        labels: np.ndarray | None = None,
    ) -> None:
        self.backend, self.data, self._labels = backend, data, labels
        self.capture = capture
        """how its pictures are taken unless `render` is given another: that of the scene it came from"""

    def __len__(self) -> int:
        return self.data.count

    def __reduce__(self):
        raise InputError(
            "a ResidentCloud is on a device and cannot be pickled or copied; take the SplatCloud, and upload "
            "it there"
        )

    @property
    def memory_bytes(self) -> int:
        """Device memory that it takes; 0 where the device reads the host's own arrays, as OpenCL on a CPU."""
        return self.data.memory_bytes

    @cached_property
    def labels(self) -> frozenset[int] | None:
        """The labels that its splats have; None where they are on the device, or on disk."""
        return None if self._labels is None else frozenset(np.unique(self._labels).tolist())

    @property
    def whole(self) -> Any:
        """What a capture is prepared for: all splats, wherever they are."""
        return self.data.scene if isinstance(self.data, Residency) else self.data

    def seen(
        self, views: Iterable[View], features: FeatureSet, qualities: Iterable[Quality]
    ) -> tuple[Any, Ids]:
        """The splats on the device that these views are drawn from, and their indices in the whole where
        these are not their own."""
        if isinstance(self.data, Residency):
            return self.data.gather(list(views), features, qualities)
        return self.data, None
