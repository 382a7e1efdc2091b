"""The sums of losses, which the host reads several at a time."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.workspace import Workspace

LATE = 16
"""losses whose sums are kept until they are asked for"""


class LossSums:
    """Room for the sums of the last losses, so that the host need not read each before the next."""

    def __init__(self, workspace: Workspace, groups: int) -> None:
        """groups: work-groups, of each of which there are three sums."""
        self._workspace, self._groups = workspace, groups
        align = max(1, workspace.device.mem_base_addr_align // 8)
        each = -(-12 * groups // align) * align
        self._buffer = workspace.pool.fresh("losses", LATE * each)
        self._slots = [self._buffer.get_sub_region(k * each, 12 * groups) for k in range(LATE)]
        self._words = np.empty((LATE, each // 4), np.float32)
        self._next = 0
        self._last: cl.Event | None = None
        """when the sums of the last loss are there, and so those before it"""
        self._unread: set[int] = set()

    def take(self) -> tuple[int, cl.Buffer]:
        """The number of a slot that is written next, and its room; that was another's `LATE` times ago."""
        self._next = (self._next + 1) % LATE
        return self._next, self._slots[self._next]

    def added(self, slot: int, event: cl.Event) -> None:
        """Its sums are there when this has come to pass."""
        self._last = event
        self._unread.add(slot)

    def read(self, slot: int) -> np.ndarray:
        """Three sums (3,) float64; those of all others that have not been read are read with it."""
        if slot in self._unread:
            after = None if self._last is None else [self._last]
            cl.enqueue_copy(self._workspace.side_queue, self._words, self._buffer, wait_for=after)
            self._unread.clear()
        sums = self._words[slot, : 3 * self._groups].reshape(self._groups, 3)
        return sums.sum(axis=0, dtype=np.float64)
