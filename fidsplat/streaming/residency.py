"""Parts of stores on a device: what views were drawn of stays there, and what the next one needs is brought
while this one is drawn."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial

import numpy as np

from fidsplat.backends.chunk_cache import KeepsChunks, KnowsRoom
from fidsplat.backends.interface import Backend, Images, Pipeline, ResidentData
from fidsplat.backends.prepare import prepare
from fidsplat.backends.termination_depth import GivesTileEnds, TerminationDepths
from fidsplat.backends.view import View
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.effects import FeatureSet
from fidsplat.effects.select import with_termination_depths
from fidsplat.streaming.bands import Band, Bands, PartOfView
from fidsplat.streaming.occlusion_culling import Hidden
from fidsplat.streaming.occlusion_test import is_supported
from fidsplat.streaming.selection import Selection, Streamed
from fidsplat.util.errors import FidsplatError


class Residency:
    """What of a scene that is on disk lies on a device. Used by one thread at a time."""

    def __init__(self, scene: Streamed, backend: Backend) -> None:
        self.scene, self._backend = scene, backend
        self._cache = (
            backend.chunk_cache(scene, scene.largest_chunk) if isinstance(backend, KeepsChunks) else None
        )
        self._there: tuple[Selection, int, ResidentData] | None = None
        self._bands, self._hidden = Bands(), Hidden()
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
        return 0 if self._there is None else self._there[-1].memory_bytes

    def parts(
        self, view: View, features: FeatureSet, quality: Quality, pipeline: Pipeline
    ) -> Iterator[PartOfView]:
        """What a view is drawn of: all that it sees, or, where the device cannot draw that at once, bands of
        its rows from the top, each with what it sees. Each is asked for when the last is being drawn.

        Raises:
            InputError: the quality allows an error that was not measured.
        """
        whole = Band.of(self.scene, view, features, self.scene.pixels_of(quality))

        def fits(band: Band, first_id: int = 0) -> bool:
            data = self._data(band.selection, first_id)
            return not isinstance(pipeline, KnowsRoom) or pipeline.fits(data, band.view)

        def numbered(bands: Sequence[Band]) -> Callable[[], np.ndarray]:
            self.nodes += sum(len(band.selection) for band in bands)
            return lambda: np.concatenate([self.scene.ids(band.selection) for band in bands])

        self.nodes = 0
        backend = self._backend
        if not self._hidden.expects(whole):
            self._hidden.passed()
        elif self._asks(view, features) and isinstance(backend, GivesTileEnds):
            asking = backend.pipeline(with_termination_depths(features))

            def draw(band: Band, first_id: int) -> tuple[Images, TerminationDepths]:
                images = asking.render(self._data(band.selection, first_id), band.view)
                return images, backend.tile_ends_of(images)

            shown = self._hidden.drawn(whole, fits, draw, backend.take_tiles)
            if shown is not None:
                bands, images = shown
                yield PartOfView(whole.rows, whole.view, None, numbered(bands), images)
                return
        for band in self._bands.cut(whole, fits):
            yield PartOfView(band.rows, band.view, self._data(band.selection), numbered([band]))

    def of(
        self, views: Sequence[View], features: FeatureSet, qualities: Iterable[Quality]
    ) -> tuple[ResidentData, Callable[[], np.ndarray]]:
        """The splats that these views see, on the device, and what gives their indices in the whole (n,)
        int32; the quality that needs most decides for all views.

        Raises:
            InputError: a quality allows an error that was not measured.
        """
        pixels = self.scene.pixels_of(*qualities)
        selection = self.scene.select(views, features, pixels)
        self.nodes = len(selection)
        return self._data(selection), partial(self.scene.ids, selection)

    def _data(self, selection: Selection, first_id: int = 0) -> ResidentData:
        if self._there is None or self._there[:2] != (selection, first_id):
            self._there = None  # before the next is there, so that both need not fit
            self._there = selection, first_id, self._brought(selection, first_id)
        return self._there[-1]

    def _brought(self, selection: Selection, first_id: int) -> ResidentData:
        if self._cache is None:
            return self._backend.upload(self.scene.part(selection))
        return self._cache.gather(self.scene.chunks(selection, self._cache.places), first_id)

    def _asks(self, view: View, features: FeatureSet) -> bool:
        """Whether it can be told what is hidden."""
        tells = isinstance(self._backend, GivesTileEnds) and isinstance(self._backend, KeepsChunks)
        return tells and is_supported(view, features)

    def read_ahead(self, captures: Iterator[Capture]) -> Iterator[Capture]:
        """The captures, each when what the next needs is being brought."""
        waiting: Capture | None = None
        try:
            while True:
                try:
                    following = next(captures, None)
                    if following is not None and waiting is not None:
                        self._fetch(following)
                except Exception:
                    if waiting is not None:
                        yield waiting
                    raise
                if waiting is not None:
                    yield waiting
                if following is None:
                    return
                waiting = following
        finally:
            if self._fetching is not None:  # it uses the device, which may be gone when the process ends
                self._fetching.join()

    def _fetch(self, capture: Capture) -> None:
        """Bring what a view will need, beside what goes on; nothing, while the last such work goes on.

        What fails here fails again when that view is drawn, where it can be told.
        """
        features, view = prepare(self.scene, capture)
        pixels = self.scene.pixels_of(capture.quality)
        if self._fetching is not None and self._fetching.is_alive():
            return

        asks = self._asks(view, features)

        def work() -> None:
            with suppress(FidsplatError, OSError, MemoryError):
                whole = Band.of(self.scene, view, features, pixels)
                if asks and self._hidden.expects(whole, later=1):
                    whole = self._hidden.begun(whole)
                selection = whole.selection
                if self._cache is None:
                    self.scene.fetch(selection)
                else:
                    self._cache.bring(self.scene.chunks(selection, self._cache.places))

        self._fetching = threading.Thread(target=work, name="fidsplat-fetch", daemon=True)
        self._fetching.start()
