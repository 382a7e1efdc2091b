"""ResidentCloud: splats on the device of a renderer."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Any

import numpy as np

from fidsplat.backends.interface import Backend, DeviceCloud
from fidsplat.backends.view import View
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.effects import FeatureSet
from fidsplat.render.array_export import SceneIndices
from fidsplat.streaming.device_chunk_cache import DeviceChunkCache
from fidsplat.util.errors import InputError


class ResidentCloud:
    """A cloud on a renderer's device, which is rendered without another upload. For a store (a
    scene in chunks on disk), only the chunks that a view needs are uploaded and cached."""

    def __init__(
        self,
        backend: Backend,
        data: DeviceCloud | DeviceChunkCache,
        capture: Capture,
        labels: np.ndarray | None = None,
    ) -> None:
        """data: an uploaded cloud, or the device chunk cache of a store."""
        self.backend, self.data, self._labels = backend, data, labels
        self.all_splats: Any = data.scene if isinstance(data, DeviceChunkCache) else data
        """all splats of the scene: the uploaded cloud, or the store on disk"""
        self.capture = capture
        """capture of the uploaded scene, the default of `render`"""

    def __len__(self) -> int:
        return self.data.count

    def __reduce__(self):
        raise InputError(
            "a ResidentCloud is on a device and cannot be pickled or copied; pickle the SplatCloud, and "
            "upload it in the other process"
        )

    @property
    def memory_bytes(self) -> int:
        """Bytes of device memory; 0 if the device reads the host's arrays, such as OpenCL on a CPU."""
        return self.data.memory_bytes

    @cached_property
    def labels(self) -> frozenset[int] | None:
        """Labels of its splats; None if they are only on the device or on disk."""
        return None if self._labels is None else frozenset(np.unique(self._labels).tolist())

    def gather(
        self, views: Iterable[View], features: FeatureSet, qualities: Iterable[Quality]
    ) -> tuple[Any, SceneIndices]:
        """Upload the splats that these views need. Returns them and their scene indices."""
        if isinstance(self.data, DeviceChunkCache):
            return self.data.gather(list(views), features, qualities)
        return self.data, None
