"""Parts of stores on a device: what the last view was drawn of stays there, and what the next one needs is
read while this one is drawn."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np

from fidsplat.backends.base import Backend, ResidentData
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet
from fidsplat.store.streamed import Selection, Streamed


class Residency:
    """What of a scene that is on disk lies on a device. Used by one thread at a time."""

    def __init__(self, scene: Streamed, backend: Backend) -> None:
        self.scene, self._backend = scene, backend
        self._there: tuple[Selection, ResidentData, np.ndarray] | None = None
        self._fetching: threading.Thread | None = None
        self.nodes = 0
        """of the last views"""

    @property
    def count(self) -> int:
        """Splats of the whole."""
        return len(self.scene)

    @property
    def memory_bytes(self) -> int:
        """Device memory of what is there."""
        return 0 if self._there is None else self._there[1].memory_bytes

    def of(
        self, views: Sequence[View], features: FeatureSet, pixels: float
    ) -> tuple[ResidentData, np.ndarray]:
        """The splats that these views see, on the device, and their indices in the whole (n,) int32."""
        selection = self.scene.select(views, features, pixels)
        self.nodes = len(selection)
        if self._there is None or self._there[0] != selection:
            self._there = None  # before the next is there, so that both need not fit
            part, ids = self.scene.part(selection)
            self._there = selection, self._backend.upload(part), ids
        return self._there[1:]

    def fetch(self, view: View, features: FeatureSet, pixels: float) -> None:
        """Read what a view will need, beside what goes on; nothing, while the last such reading goes on."""
        if self._fetching is not None and self._fetching.is_alive():
            return

        def work() -> None:
            self.scene.fetch(self.scene.select([view], features, pixels))

        self._fetching = threading.Thread(target=work, name="fidsplat-fetch", daemon=True)
        self._fetching.start()
