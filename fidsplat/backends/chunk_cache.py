"""Scenes of which views see parts: chunks of splats that a device keeps from view to view, and puts together
for each."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from fidsplat.backends.coplanar_groups import PlaneTable
from fidsplat.backends.interface import ResidentData
from fidsplat.backends.view import View
from fidsplat.effects.select import Traits


@dataclass(frozen=True, eq=False)
class Chunk:
    """Splats that stand together in the order of a scene."""

    key: Hashable
    """the same for the same splats, wherever they are placed"""
    count: int
    load: Callable[[], Mapping[str, np.ndarray]]
    """their arrays by the names of a cloud's, float32 or int32; `coplanar_groups` by the index
    of a `PlaneTable`"""
    pose: np.ndarray | None = None
    """(16,) float64: where they are placed, the rotation by rows, where it puts the means' zero [m], and its
    quaternion; None: where they are"""
    first: int = 0
    """the row of those arrays from which on it has `count`"""


class WholeScene(Traits, Protocol):
    """What chunks are parts of."""

    @property
    def origin(self) -> np.ndarray:
        """(3,) float64 metres: the world's position of the means' zero."""
        ...

    @property
    def group_table(self) -> PlaneTable | None:
        """Coplanar groups of its splats."""
        ...

    def distinct(self, applies_poses: bool) -> int:
        """How many keys its chunks have. applies_poses: whether the device applies `Chunk.pose`."""
        ...


class ChunkCache(Protocol):
    """Chunks of one scene on a device: those that were used last stay, within the memory budget."""

    applies_poses: bool
    """whether it applies `Chunk.pose`, which must be None otherwise"""

    @property
    def memory_bytes(self) -> int:
        """Device memory that it takes."""
        ...

    def gather(self, chunks: Sequence[Chunk], first_id: int = 0) -> ResidentData:
        """These, in this order, to be drawn; what is not on the device is brought there. first_id: of the
        first splat, in `splat_id`."""
        ...

    def bring(self, chunks: Sequence[Chunk]) -> None:
        """What the next picture needs, beside the one that is drawn, as far as there is room. To be called
        from another thread."""
        ...


@runtime_checkable
class KeepsChunks(Protocol):
    """A backend that keeps chunks."""

    def chunk_cache(self, whole: WholeScene, rows: int) -> ChunkCache:
        """A cache of chunks of a scene, each of at most so many splats."""
        ...


@runtime_checkable
class KnowsRoom(Protocol):
    """A pipeline that says what it can draw at once."""

    def fits(self, resident: ResidentData, view: View) -> bool:
        """Whether the picture of these splats is drawn at once; else in parts, for each of which all of them
        are projected."""
        ...
