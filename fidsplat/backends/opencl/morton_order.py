"""Morton order of large clouds on GPUs, and bounding spheres of groups of splats in this order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.assemble import kernel_text
from fidsplat.backends.opencl.program import build
from fidsplat.backends.opencl.workspace import Workspace

CULLING_GROUP = 32
"""splats of a group that is culled as a whole: CULLING_GROUP of part/unculled_splats.cl"""
_SIDE = 128
"""cells of the grid along an axis (kernels/opencl/morton_order.cl)"""
_SAMPLE = 10_000
"""number of splats that determine the extent of the grid"""


class MortonOrder:
    """Order of a cloud's splats by position, and bounding spheres of groups of consecutive splats."""

    def __init__(self, workspace: Workspace, means: np.ndarray, buffer: cl.Buffer) -> None:
        """means, buffer: the positions (n, 3) on the host and on the device."""
        self._workspace, self._count, self.groups = workspace, len(means), -(-len(means) // CULLING_GROUP)
        program = build(workspace, kernel_text("morton_order.cl"))
        self._kernels = {kernel.function_name: kernel for kernel in program.all_kernels()}
        queue, allocate = workspace.queue, workspace.pool.allocate
        self.arrays = {"splat_ids": allocate("the cloud's order", 4 * self._count)}
        """`splat_ids` (n,) int32, indices of the sorted splats in the cloud; `spheres` and `max_scales`"""
        low, high = np.nanquantile(means[:: self._count // _SAMPLE + 1], (0.01, 0.99), axis=0)
        grid = *low.astype(np.float32), np.float32(_SIDE / max(*(high - low), 1e-9))
        cells, starts = allocate("cells", 4 * _SIDE**3), np.zeros(_SIDE**3, np.uint32)
        for scatter in (0, 1):
            cl.enqueue_copy(queue, cells, starts)
            arguments = (
                buffer,
                np.uint32(self._count),
                *grid,
                cells,
                np.int32(scatter),
                self.arrays["splat_ids"],
            )
            self._launch("sort_by_cells", self._count, arguments)
            cl.enqueue_copy(queue, starts, cells)
            starts = np.cumsum(starts, dtype=np.uint32) - starts  # exclusive

    def gather(self, name: str, source: cl.Buffer, row_bytes: int) -> cl.Buffer:
        """Copy an array in this order; rows of zeros complete the last group."""
        words = row_bytes // 4
        gathered = self._workspace.pool.allocate(
            f"the cloud's {name}", self.groups * CULLING_GROUP * row_bytes
        )
        size, order = np.uint64(self._count * words), self.arrays["splat_ids"]
        self._launch(
            "gather_splats",
            self.groups * CULLING_GROUP * words,
            (source, order, size, np.uint32(words), gathered),
        )
        return gathered

    def compute_bounding_spheres(self, arrays: Mapping[str, cl.Buffer]) -> None:
        """Compute the bounding spheres of all groups, `spheres` (groups, 4), and `max_scales` (groups,)."""
        optional = ("thickness", "boxes")
        inputs = [arrays.get(name, arrays["scales"]) for name in ("means", "scales", "opacities", *optional)]
        sizes = (
            *(np.int32(name in arrays) for name in optional),
            np.uint32(CULLING_GROUP),
            np.uint32(self.groups),
        )
        for name, row_bytes in {"spheres": 16, "max_scales": 4}.items():
            self.arrays[name] = self._workspace.pool.allocate(name, row_bytes * self.groups)
        outputs = self.arrays["spheres"], self.arrays["max_scales"]
        self._launch("bound_groups", self.groups, (*inputs, *sizes, *outputs))

    def _launch(self, kernel: str, items: int, arguments: tuple[Any, ...]) -> None:
        items = -(-items // CULLING_GROUP) * CULLING_GROUP
        self._kernels[kernel](self._workspace.queue, (items,), (CULLING_GROUP,), *arguments).wait()
