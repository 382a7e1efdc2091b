"""Device chunk cache of a scene with stores (chunks on disk), with prefetch for the next view."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import islice
from typing import TypeVar

import numpy as np

from fidsplat.backends.interface import Backend, DeviceCloud, Images, Pipeline
from fidsplat.backends.prepare import prepare
from fidsplat.backends.termination_depth import TerminationDepths
from fidsplat.backends.view import View
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.effects import FeatureSet
from fidsplat.effects.select import with_termination_depths
from fidsplat.store.chunked_splats import ChunkedSplats, Selection
from fidsplat.streaming import occlusion_test
from fidsplat.streaming.bands import Band, BandData, BandSplitter
from fidsplat.streaming.device_chunks import DeviceChunks
from fidsplat.streaming.level_of_detail import select
from fidsplat.streaming.occlusion_culling import OcclusionCulling
from fidsplat.util.errors import FidsplatError

T = TypeVar("T")


def double_buffered(items: Iterator[T]) -> Iterator[T]:
    """Double buffering: yield each item after the next one is computed. An error is raised after the items
    before it."""
    previous: list[T] = []
    while True:
        try:
            following = list(islice(items, 1))
        except Exception:
            yield from previous
            raise
        yield from previous
        if not following:
            return
        previous = following


class DeviceChunkCache:
    """Device chunk cache of a scene with stores, loaded by view; for one thread at a time."""

    def __init__(self, scene: ChunkedSplats, backend: Backend) -> None:
        self.scene, self._backend, self.chunks = scene, backend, DeviceChunks(scene)
        self._cache = backend.chunk_cache(self.chunks) if backend.has("chunk_cache") else None
        self._current: tuple[Selection, int, DeviceCloud] | None = None
        self._splitter, self._occlusion = BandSplitter(), OcclusionCulling()
        self._prefetch_thread: threading.Thread | None = None
        self.node_count = 0
        """number of nodes from which the last views were rendered"""

    @property
    def count(self) -> int:
        """Number of splats of the complete scene."""
        return len(self.scene)

    @property
    def memory_bytes(self) -> int:
        """Device memory of the current splats."""
        return 0 if self._current is None else self._current[-1].memory_bytes

    def bands(
        self, view: View, features: FeatureSet, quality: Quality, pipeline: Pipeline
    ) -> Iterator[BandData]:
        """Bands of a view from the top, each uploaded when it is requested; one if all splats fit."""
        full = Band.of(self.scene, view, features, self.scene.cell_sizes(quality))

        def fits(band: Band, first_id: int = 0) -> bool:
            data = self._loaded(band.selection, first_id)
            return pipeline.fits(data, band.view)

        def scene_indices_of(bands: Sequence[Band]) -> Callable[[], np.ndarray]:
            self.node_count += sum(len(band.selection) for band in bands)
            return lambda: np.concatenate([self.scene.ids(band.selection) for band in bands])

        self.node_count = 0
        backend = self._backend
        if not self._occlusion.is_worthwhile(full):
            self._occlusion.skip_view()
        elif self._can_cull(view, features):
            culling_pipeline = backend.pipeline(with_termination_depths(features))

            def render_band(band: Band, first_id: int) -> tuple[Images, TerminationDepths]:
                images = culling_pipeline.render_view(self._loaded(band.selection, first_id), band.view)
                return images, backend.termination_depths(images)

            rendered = self._occlusion.render(full, fits, render_band, backend.copy_tiles)
            if rendered is not None:
                bands, images = rendered
                yield BandData(full.rows, full.view, None, scene_indices_of(bands), images)
                return
        for band in self._splitter.split(full, fits):
            yield BandData(band.rows, band.view, self._loaded(band.selection), scene_indices_of([band]))

    def gather(
        self, views: Sequence[View], features: FeatureSet, qualities: Iterable[Quality]
    ) -> tuple[DeviceCloud, Callable[[], np.ndarray]]:
        """Load the splats that are visible in any of several views. The lowest `detail_error` applies to all.

        Returns the splats, and a function that returns their scene indices (n,) int32.
        """
        selection = select(self.scene, views, features, self.scene.cell_sizes(*qualities))
        self.node_count = len(selection)
        return self._loaded(selection), partial(self.scene.ids, selection)

    def _loaded(self, selection: Selection, first_id: int = 0) -> DeviceCloud:
        if self._current is None or self._current[:2] != (selection, first_id):
            self._current = None  # released before the upload, as both may not fit on the device
            if self._cache is None:
                data = self._backend.upload(self.scene.load(selection))
            else:
                data = self._cache.gather(self.chunks.of(selection, self._cache.applies_poses), first_id)
            self._current = selection, first_id, data
        return self._current[-1]

    def _can_cull(self, view: View, features: FeatureSet) -> bool:
        return self._backend.has("termination_depths") and occlusion_test.is_supported(view, features)

    def prefetched(self, captures: Iterator[Capture]) -> Iterator[Capture]:
        """Yield captures; while the caller renders one, the chunks of the next one are prefetched."""

        def after_start_of_prefetch() -> Iterator[Capture]:
            for number, capture in enumerate(captures):
                if number:
                    self._prefetch(capture)
                yield capture

        try:
            yield from double_buffered(after_start_of_prefetch())
        finally:
            if self._prefetch_thread is not None:  # the caller may close the device next
                self._prefetch_thread.join()

    def _prefetch(self, capture: Capture) -> None:
        """Load the chunks of a view in a thread, unless one is running. Its errors are ignored: rendering
        raises them again."""
        features, view = prepare(self.scene, capture)
        cell_sizes = self.scene.cell_sizes(capture.quality)
        if self._prefetch_thread is not None and self._prefetch_thread.is_alive():
            return
        can_cull = self._can_cull(view, features)

        def load_chunks() -> None:
            with suppress(FidsplatError, OSError, MemoryError):
                band = Band.of(self.scene, view, features, cell_sizes)
                if can_cull and self._occlusion.is_worthwhile(band, views_later=1):
                    band = self._occlusion.initial_guess(band)
                if self._cache is None:
                    self.scene.prefetch(band.selection)
                else:
                    self._cache.prefetch(self.chunks.of(band.selection, self._cache.applies_poses))

        self._prefetch_thread = threading.Thread(target=load_chunks, name="fidsplat-prefetch", daemon=True)
        self._prefetch_thread.start()
