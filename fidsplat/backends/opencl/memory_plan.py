"""The memory plan: how a frame or batch is divided to fit the memory budget.

A frame is rendered in one piece if its buffers fit. If only its (splat, tile) pairs exceed the budget, it is
binned and blended in ranges of tiles. As the last resort the cloud is projected in slices (ranges of
consecutive splats), of which only visible splats are stored. A batch is rendered in sub-batches of as many
views as fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.opencl.assemble import KernelSource
from fidsplat.backends.opencl.buffers import RayBuffers
from fidsplat.backends.opencl.cloud import OpenCLCloud
from fidsplat.backends.opencl.kernel_config import KernelConfig
from fidsplat.backends.opencl.kernel_interface import RAW
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.ranges import even_ranges
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet
from fidsplat.util.errors import DeviceError, bytes_words

DEFAULT_SLICE = 1 << 20
"""splats of a slice; a power of two, so that the slices of every array start at aligned addresses"""
_MAX_SLICE = 1 << 23
"""splats up to which slices are enlarged if memory is ample, for fewer launches"""
_MIN_SLICE = 1 << 10
KEY_BYTES, WINDOW_BYTES, SORT_BYTES = 4, 8, 16
"""bytes per splat of sort keys, of tile windows, and of keys and indices during the sort"""
MIN_BIG = 1 << 12
"""initial capacity for big splats, which touch more tiles than a window"""
TILE_TABLES = 5
"""words per tile of bin_first and bin_local: counters, starts, cursors, order and termination depths"""
UNIFORM_BYTES = 1 << 14
"""upper bound of the bytes of uniforms, counts and moving groups"""
SUB_BATCH_BYTES = {"cpu": 1 << 28}
"""maximum bytes, without images, of the views that are rendered together, by kind of device; larger ones are
not faster"""
OTHER_SUB_BATCH_BYTES = 1 << 31
_SUB_BATCH_SAMPLES = 1 << 30
"""maximum samples of a sub-batch; kernels use 32-bit indices for several channels of samples"""
_CAMERA_UNIFORMS = {"ray", "vignette_center"}
"""groups of uniforms that differ between cameras"""


@dataclass(frozen=True)
class MemoryPlan:
    """Division of a frame or sub-batch, and the bytes of its buffers."""

    slice_size: int
    """number of splats that are projected at once; 0: all, without packing the visible splats"""
    max_visible: int
    """maximum visible splats of a band of rows, if the cloud is projected in slices"""
    total: int
    """total bytes including the cloud; exceeded only by frames with more than `MIN_BIG` big splats"""


class SubBatch(NamedTuple):
    """Views [first, end) of a batch that are rendered together."""

    first: int
    end: int
    plan: MemoryPlan


class MemoryPlanner:
    """Memory plans of the frames and batches of one pipeline."""

    def __init__(
        self, workspace: Workspace, source: KernelSource, features: FeatureSet, config: KernelConfig
    ) -> None:
        self._workspace, self._source, self._config = workspace, source, config
        self._has_ray_derivatives = "ray_derivatives" in source.arguments["blend"]
        self._has_camera_uniforms = not _CAMERA_UNIFORMS.isdisjoint(source.uniform_groups)
        self._channels = 0
        for samples in (RAW, *source.sample_buffers):
            self._channels += samples.channels if samples.name in source.arguments["blend"] else 0
        resolve_rays = "rays" in source.arguments.get("resolve", {})
        self._views_differ_beyond_struct = (
            bool(source.view_arrays) or resolve_rays or "composite_background" in source.arguments
        )
        """whether the views of a batch differ in more than the struct `View`"""
        self._image_channels = 0
        for output in features.images:
            self._image_channels += output.channels

    def tiles(self, view: View) -> int:
        return -(-view.width // self._config.tile_width) * -(-view.height // self._config.tile_height)

    def plan_frame(self, cloud: OpenCLCloud, view: View, reserved: int = 0) -> MemoryPlan:
        """Plan one view. reserved: bytes of other buffers. Raises DeviceError if it does not fit."""
        config = self._config
        cloud_bytes, upload_bytes = cloud.bytes_for(self._source.cloud_arrays)
        samples, tables = self._samples_and_tables(view)
        fixed = reserved + cloud_bytes + UNIFORM_BYTES + tables
        fixed += MIN_BIG * (4 + self._source.records["Bounds"].itemsize)
        # with sub-frames: the samples of the current one, and those accumulated
        fixed += 4 * samples * self._channels * (2 if view.sub_frames else 1)
        fixed += self._image_bytes(view)
        for name in self._source.view_arrays:
            fixed += view.array(name).nbytes
        if view.raster is not None:
            rasters = {
                view.raster,
                *(sub_frame.view.raster for sub_frame in view.sub_frames if sub_frame.view.raster),
            }
            columns = -(-view.width // config.tile_width) * config.tile_width
            fixed += RayBuffers.bytes_of(rasters, config.tile_height, columns, self._has_ray_derivatives)
        record = self._source.records["Splat"].itemsize
        budget, largest = self._workspace.memory_budget, self._workspace.largest_buffer
        return plan_of(cloud.padded_count, record, upload_bytes, fixed, config.binning, budget, largest)

    def plan_batch(self, cloud: OpenCLCloud, batch: ViewBatch) -> Iterator[SubBatch]:
        """Divide a batch into sub-batches."""
        count, other_images = len(batch), (batch.total - 1) * self._image_bytes(batch.view)
        if not count:
            return
        plan = self.plan_frame(cloud, batch.view_at(0), other_images)
        external = batch.view.external_depth
        batched = batch.same_uniforms and not (cloud.streamed or self._views_differ_beyond_struct)
        batched = batched and not (external and external.stacked)
        if plan.slice_size or not batched or (batch.camera_parameters and self._has_camera_uniforms):
            for k in range(count):
                yield SubBatch(k, k + 1, self.plan_frame(cloud, batch.view_at(k), other_images))
            return
        samples, tables = self._samples_and_tables(batch.view)
        splat_bytes = self._source.records["Splat"].itemsize + KEY_BYTES + WINDOW_BYTES
        splat_bytes += SORT_BYTES if self._config.binning == "sort_first" else 0
        view_bytes = cloud.padded_count * splat_bytes + tables + 4 * self._channels * samples
        free = min(self._workspace.memory_budget - plan.total + view_bytes, self._workspace.largest_buffer)
        max_views = (
            min(free, SUB_BATCH_BYTES.get(self._workspace.info.kind, OTHER_SUB_BATCH_BYTES)) // view_bytes
        )
        for first, end in even_ranges(count, max(1, min(max_views, _SUB_BATCH_SAMPLES // samples))):
            yield SubBatch(
                first, end, MemoryPlan(0, cloud.count, plan.total + (end - first - 1) * view_bytes)
            )

    def _image_bytes(self, view: View) -> int:
        return 4 * self._image_channels * (view.width * view.height // view.samples**2)

    def _samples_and_tables(self, view: View) -> tuple[int, int]:
        """Number of samples in complete tiles, and bytes of the tables of tile binning."""
        config, tiles = self._config, self.tiles(view)
        samples = tiles * config.tile_width * config.tile_height
        if config.binning != "sort_first":
            return samples, 4 * TILE_TABLES * tiles
        bins = 1 << config.radix_bits
        return samples, 4 * ((tiles + bins) * (config.sort_blocks + 2) + 3 * config.sort_blocks)


def plan_of(
    count: int, record_bytes: int, upload_bytes: int, fixed_bytes: int, binning: str, budget: int, limit: int
) -> MemoryPlan:
    """Plan a frame of `count` splats.

    Args:
        record_bytes: bytes of the struct `Splat`.
        upload_bytes: bytes per splat that each frame copies to the device; 0 for a resident cloud.
        fixed_bytes: bytes of sample buffers, outputs, tables, and the cloud if it is resident.
        binning: tile-binning strategy.
        budget: maximum total bytes.
        limit: maximum bytes of one buffer.
    """
    projected_bytes = record_bytes + KEY_BYTES + WINDOW_BYTES
    splat_bytes = count * (projected_bytes + (SORT_BYTES if binning == "sort_first" else 0))
    pair_bytes = budget // 8
    fits = not upload_bytes and fixed_bytes + splat_bytes + pair_bytes <= budget
    if fits and count * record_bytes <= limit:
        return MemoryPlan(0, count, fixed_bytes + splat_bytes + pair_bytes)
    free = budget - fixed_bytes - pair_bytes
    # slices are enlarged while they take less than 1/64 of the free memory, and reduced above 1/8; the rest
    # is for visible splats
    slice_size, sliced_bytes = DEFAULT_SLICE, projected_bytes + upload_bytes
    while slice_size < _MAX_SLICE and slice_size * sliced_bytes < free // 64:
        slice_size *= 2
    while slice_size > _MIN_SLICE and (slice_size * sliced_bytes > free // 8 or slice_size > 2 * count):
        slice_size //= 2
    max_visible = (free - slice_size * sliced_bytes) // (projected_bytes + SORT_BYTES)
    max_visible = min(max_visible, limit // record_bytes, count)
    if max_visible < min(_MIN_SLICE, count):
        raise DeviceError(
            f"memory_budget must exceed the {bytes_words(fixed_bytes)} of the frame and the cloud without "
            f"lists, got {bytes_words(budget)}; raise it, or render a smaller frame or fewer outputs"
        )
    total = fixed_bytes + pair_bytes + slice_size * sliced_bytes
    total += max_visible * (projected_bytes + SORT_BYTES)
    return MemoryPlan(slice_size, max_visible, total)
