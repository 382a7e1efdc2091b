"""Build constants of the kernels, by device and by the features of a frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

from fidsplat.effects import FeatureSet


@dataclass(frozen=True)
class KernelConfig:
    """Build constants of the kernels: of the device, then adapted to features, frame size and cloud."""

    schedule: str
    """`lanes` (CPU: a work-item renders a tile) or `group` (GPU: a work-group renders a tile)"""
    binning: str
    """tile-binning strategy (tiling.py): `sort_first`, `bin_first` or `bin_local`"""
    lanes: int
    """SIMD width of the vectors of floats; 1: scalars"""
    tile_width: int
    tile_height: int
    """size of a tile [samples]"""
    sort_blocks: int
    """number of blocks into which the counting sorts divide their input (`sort_first`)"""
    radix_bits: int
    """bits per pass of the depth sort (`sort_first`)"""
    scan_items: int
    """work-group size of prefix sums and of `bin_local`"""
    fast_fma: bool
    """whether a fused multiply-add is one instruction of the device"""
    k_buffer_size: int
    """fragments of a pixel that the k-buffer sorts by depth at once; at most 254, or 31 in `group`"""
    rows: int = 2
    """pixels in a column that a work-item blends (`group`)"""
    tape: int = 1024
    """minimum number of splats in a segment of a tile's list, whose fragments are stored for the backward
    pass (`lanes`), 8 bytes per pixel and splat. Segments have up to 8 times as many splats if they overlap
    few pixels. Fragments of all segments but the last are computed twice"""
    splats_per_item: int = 1
    """splats that a work-item of the project stage projects, vectorised if more than 1 (`lanes`)"""
    culls_first: bool = False
    """whether splats outside the frustum are culled before projection (part/unculled_splats.cl)"""
    dialect: str = ""
    """file of kernels/opencl/dialect/ with a vendor's instructions; empty: portable, bit-identical kernels"""

    @property
    def pair_bytes(self) -> int:
        """Bytes of a pair of a splat and a tile while it is listed."""
        return 4 if self.binning == "sort_first" else 12

    @property
    def blend_items(self) -> int:
        """Work-items of a work-group of the blend stage."""
        return 1 if self.schedule == "lanes" else self.tile_width * self.tile_height // self.rows


def cpu_config(lanes: int = 16, cores: int = 8, fast_fma: bool = True) -> KernelConfig:
    """The config for CPUs: a tile per work-item, in the widest vectors."""
    return KernelConfig(
        schedule="lanes",
        binning="sort_first",
        lanes=lanes,
        tile_width=lanes,
        tile_height=16,
        sort_blocks=min(max(4 * cores, 8), 256),
        radix_bits=11,
        scan_items=1,
        fast_fma=fast_fma,
        k_buffer_size=32,
        splats_per_item=64,
    )


def gpu_config(scan_items: int = 1024, fast_fma: bool = True, dialect: str = "") -> KernelConfig:
    """The config for GPUs: a work-group per tile of 16 x 16 pixels."""
    return KernelConfig(
        schedule="group",
        binning="bin_first",
        lanes=1,
        tile_width=16,
        tile_height=16,
        sort_blocks=1024,
        radix_bits=8,
        scan_items=scan_items,
        fast_fma=fast_fma,
        k_buffer_size=8,
        dialect=dialect,
    )


@cache
def small_frame_config(own: KernelConfig) -> KernelConfig:
    """The config of a GPU for frames with too few tiles to occupy it: more work-groups and work-items."""
    return replace(own, tile_width=8, tile_height=8, rows=1)


def config_for(features: FeatureSet, config: KernelConfig) -> KernelConfig:
    """`config` with the tiles and the schedule that these features require."""
    if "blend_double" in features.effects and config.schedule == "lanes":
        # float64 kernels are not vectorised
        config = replace(config, schedule="group", lanes=1, tile_width=16, tile_height=16, k_buffer_size=8)
    if config.schedule == "group" or "camera_pinhole" not in features.effects:
        # the projection through lenses has loops and branches that compilers do not vectorise
        config = replace(config, splats_per_item=1)
    if not {"order_pixel", "order_coplanar_pixel"}.isdisjoint(features.effects):
        # the k-buffer needs the registers of a second pixel
        config = replace(config, rows=1)
    return config


def other_configs(own: KernelConfig, kind: str) -> dict[str, KernelConfig]:
    """Alternative build constants by name, for tests (`Backend.configs`)."""
    if kind == "schedule":
        return {"groups": _groups(own, 16 if own.schedule == "lanes" else 8)}
    if kind == "k_buffer":
        # one fragment, and one more than the three that the kernel keeps in registers (k_buffer_group.cl)
        few = replace(_groups(own, 8), k_buffer_size=1), replace(_groups(own, 8), k_buffer_size=4)
        return {
            **{f"own, k-buffer of {size}": replace(own, k_buffer_size=size) for size in (1, 3)},
            **{f"groups, k-buffer of {config.k_buffer_size}": config for config in few},
        }
    if kind == "tape":
        return {"a short tape": replace(own, tape=40)} if own.schedule == "lanes" else {}
    if kind == "binning":
        return {binning: replace(_groups(own, 8), binning=binning) for binning in ("sort_first", "bin_first")}
    if kind == "arithmetic":
        plain = replace(own, fast_fma=False)
        scalar = {"one by one": replace(own, lanes=1), "not fused, one by one": replace(plain, lanes=1)}
        return {"own": own, "not fused": plain, **scalar}
    if kind == "sorting":
        return {"own": own, "7 blocks": replace(own, sort_blocks=7, radix_bits=5), "groups": _groups(own, 16)}
    if own.schedule == "group":
        return {
            "small frames": small_frame_config(own),
            "32 x 32": replace(own, tile_width=32, tile_height=32),
        }
    # a tile is as wide as the vector
    return {
        f"{width} x {height}": replace(own, lanes=width, tile_width=width, tile_height=height)
        for width, height in ((8, 8), (own.lanes, 32), (4, 16))
    }


def _groups(own: KernelConfig, side: int) -> KernelConfig:
    """Constants with the schedule of a GPU and tiles of side x side pixels; side 8 as for small frames."""
    groups = replace(
        own, schedule="group", binning="bin_first", lanes=1, scan_items=64, k_buffer_size=8, splats_per_item=1
    )
    if side == 8:
        return small_frame_config(groups)
    return replace(groups, tile_width=side, tile_height=side)
