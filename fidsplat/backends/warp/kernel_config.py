"""Build constants of the kernels, by device."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any


@dataclass(frozen=True)
class KernelConfig:
    schedule: str
    """`tiles`: a thread renders a tile (CPU); `group`: a block of threads renders a tile (CUDA)"""
    tile_width: int
    """width and height of a tile in samples: 8, 16 or 32"""
    tile_height: int
    k_buffer_size: int = 8
    """size of the k-buffer: fragments of a pixel that are sorted by depth at once"""
    sort_blocks: int = 1
    """number of blocks into which the sorts divide their input"""


def config_for(device: Any) -> KernelConfig:
    return KernelConfig("group" if device.is_cuda else "tiles", 16, 16)


def other_configs(own: KernelConfig, kind: str) -> dict[str, KernelConfig]:
    """Alternative build constants by name, for tests (`Backend.configs`)."""
    if kind == "schedule":
        return {"groups": KernelConfig("group", 8, 8)}
    if kind == "binning":
        return {"sort_first": own}
    if kind in ("sorting", "arithmetic"):
        return {"own": own}
    if kind == "tape":
        return {}
    if kind == "k_buffer":
        return {f"own, k-buffer of {size}": replace(own, k_buffer_size=size) for size in (1, 3)}
    return {f"{side} x {side}": KernelConfig(own.schedule, side, side) for side in (8, 32)}
