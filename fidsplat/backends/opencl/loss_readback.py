"""Deferred readback of losses: sums stay on the device until the host reads several at a time."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.workspace import Workspace

SLOTS = 16
"""maximum number of unread losses"""


class LossReadback:
    """Ring buffer for the sums of the last losses, so that the host need not read each before the next."""

    def __init__(self, workspace: Workspace, groups: int) -> None:
        """groups: number of work-groups, each with three sums."""
        self._workspace, self._groups = workspace, groups
        align = max(1, workspace.device.mem_base_addr_align // 8)
        size = -(-12 * groups // align) * align
        self._buffer = workspace.pool.fresh("losses", SLOTS * size)
        self._slots = [self._buffer.get_sub_region(k * size, 12 * groups) for k in range(SLOTS)]
        self._words = np.empty((SLOTS, size // 4), np.float32)
        self._next = 0
        self._last: cl.Event | None = None
        """event of the last loss's sums; the queue is in order, so earlier losses are complete too"""
        self._unread: set[int] = set()

    def take(self) -> tuple[int, cl.Buffer]:
        """The next slot and its buffer; slots are reused after `SLOTS` losses."""
        self._next = (self._next + 1) % SLOTS
        return self._next, self._slots[self._next]

    def submitted(self, slot: int, event: cl.Event) -> None:
        """Mark a slot as unread. event: of the kernel that writes its sums."""
        self._last = event
        self._unread.add(slot)

    def read(self, slot: int) -> np.ndarray:
        """Read the three sums (3,) float64 of a slot; all unread slots are copied together."""
        if slot in self._unread:
            after = None if self._last is None else [self._last]
            cl.enqueue_copy(self._workspace.side_queue, self._words, self._buffer, wait_for=after)
            self._unread.clear()
        sums = self._words[slot, : 3 * self._groups].reshape(self._groups, 3)
        return sums.sum(axis=0, dtype=np.float64)
