"""The memory plan: how many pairs a frame lists at once, and how many views are rendered together."""

from __future__ import annotations

from collections.abc import Iterator

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.ranges import even_ranges
from fidsplat.backends.view import View
from fidsplat.backends.warp.cloud import WarpCloud
from fidsplat.backends.warp.program import Program
from fidsplat.backends.warp.runtime import load
from fidsplat.backends.warp.uniforms import memory_bytes
from fidsplat.backends.warp.workspace import Workspace
from fidsplat.util.errors import DeviceError, bytes_words

_BOUNDS = 44
_PROJECTED = 20
"""bytes per splat of window of tiles, sort key, number of tiles, and index as a big splat"""
_PAIR = 12
"""bytes of a (splat, tile) pair, before and after the sort"""
_MAX_SUB_BATCH_BYTES = {True: 1 << 31, False: 1 << 28}
"""maximum bytes of a part of a batch on CUDA and on the CPU; larger parts are not faster"""
_MAX_NUMBERED = 1 << 30
"""maximum number of samples and of records of a part; kernels use 32-bit indices"""


class MemoryPlanner:
    def __init__(self, program: Program, workspace: Workspace) -> None:
        self.workspace, config = workspace, program.config
        self._tile_width, self._tile_height = config.tile_width, config.tile_height
        sizes = map(load().types.type_size_in_bytes, program.sample_fields.values())
        self._sample_bytes = sum(sizes)
        self._vec4s = program.layout.vec4s
        self._splat_bytes = 16 * self._vec4s + _BOUNDS + _PROJECTED
        self._same_settings = program.sensor is not None
        """whether the views of a part must have equal camera parameters"""

    def sample_bytes(self, view: View) -> int:
        """Bytes of the sample buffers of a view, padded to complete tiles."""
        return self._samples(view) * self._sample_bytes

    def _samples(self, view: View) -> int:
        columns, rows = -(-view.width // self._tile_width), -(-view.height // self._tile_height)
        return rows * columns * self._tile_width * self._tile_height

    def max_pairs(self, cloud: WarpCloud, batch: ViewBatch, reserved: int) -> int:
        """Maximum number of (splat, tile) pairs in the lists at once. reserved: bytes of other arrays. Raises
        DeviceError if the rest of the frame exceeds the memory budget."""
        workspace = self.workspace
        fixed = cloud.memory_bytes + self._splat_bytes * len(batch) * cloud.count
        fixed += len(batch) * self.sample_bytes(batch.view) + reserved + memory_bytes(batch.view, workspace)
        pairs = (workspace.memory_budget - fixed) // _PAIR
        if pairs < 1:
            raise DeviceError(
                f"memory_budget must exceed the {bytes_words(fixed)} of the frame and its {cloud.count:,} "
                f"splats without lists, got {bytes_words(workspace.memory_budget)}; raise it, or use an "
                "OpenCL device, which projects a cloud in slices"
            )
        return min(workspace.pair_budget, pairs)

    def plan_batch(self, cloud: WarpCloud, batch: ViewBatch, reserved: int) -> Iterator[tuple[int, int]]:
        """Ranges [first, end) of views that are rendered together. reserved: bytes of all their images."""
        count, workspace = len(batch), self.workspace
        if not count or not batch.same_uniforms or (self._same_settings and batch.camera_parameters):
            return even_ranges(count, 1)
        each = cloud.count * self._splat_bytes + self.sample_bytes(batch.view)
        external = batch.view.external_depth
        each += external.nbytes // count if external and external.stacked else 0
        free = workspace.memory_budget - cloud.memory_bytes - reserved
        # half of the budget is for the lists
        fitting = min(free // 2, _MAX_SUB_BATCH_BYTES[workspace.device.is_cuda]) // each
        numbered = _MAX_NUMBERED // max(self._samples(batch.view), cloud.count * self._vec4s)
        return even_ranges(count, max(1, min(fitting, numbered)))
