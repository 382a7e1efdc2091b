"""Warp devices: listing, choosing, opening; compiled pipelines by FeatureSet."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from fidsplat.backends.interface import Backend, DeviceInfo
from fidsplat.backends.warp import runtime
from fidsplat.backends.warp.cloud import WarpCloud
from fidsplat.backends.warp.command_list import LaunchCache
from fidsplat.backends.warp.gradients import WarpGradients
from fidsplat.backends.warp.kernel_config import KernelConfig, config_for, other_configs
from fidsplat.backends.warp.pipeline import WarpPipeline
from fidsplat.backends.warp.probe import WarpProbe
from fidsplat.backends.warp.program import Program, unsupported
from fidsplat.backends.warp.workspace import Workspace
from fidsplat.effects import FeatureSet
from fidsplat.effects.differentiable import check_differentiable
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import DeviceError, UnknownDeviceError


def devices() -> list[DeviceInfo]:
    """List Warp's devices; without Warp an unusable entry that says how to install it."""
    try:
        wp = runtime.load()
    except DeviceError as error:
        return [_describe_missing(str(error))]
    return [_describe(device) for device in wp.get_devices()]


def open_device(selector: str = "") -> WarpBackend:
    """Open a Warp device: `cpu`, `cuda` (the first), `cuda:1`, or part of a device's name; without a selector
    a CUDA device if there is one, else the CPU."""
    found = runtime.load().get_devices()
    requested = selector.strip().lower()
    matching = [
        d for d in found if requested in (d.alias, d.alias.split(":")[0]) or requested in d.name.lower()
    ]
    if not matching:
        if requested.split(":")[0] == "cuda" and not any(device.is_cuda for device in found):
            raise DeviceError(
                "Warp found no CUDA device (no NVIDIA driver, or no GPU); use device='warp:cpu'"
            )
        known = ", ".join(f"warp:{device.alias}" for device in found)
        raise UnknownDeviceError(f"no Warp device matches {selector!r}; there are: {known}")
    return WarpBackend(min(matching, key=lambda device: not device.is_cuda))


class WarpBackend(Workspace, Backend):
    """An open Warp device and its compiled pipelines."""

    def __init__(self, device: Any) -> None:
        self.info = _describe(device)
        super().__init__(device, self.info.name, self.info.memory_bytes // 10 * 9)
        self.config = config_for(device)
        # debug builds of Warp's CPU kernels share a pointer among threads, and crash (warp/native/tile.h)
        single = device.is_cuda or runtime.load().config.mode == "debug"
        self._launches = LaunchCache(device, 1 if single else self.info.compute_units)
        self._pipelines: dict[tuple[FeatureSet, KernelConfig], WarpPipeline] = {}
        self._gradients: dict[tuple[FeatureSet, KernelConfig], WarpGradients] = {}

    def limit_memory(self, budget: int) -> None:
        """Limit a frame and its cloud to `budget` bytes: longer lists are split into ranges of tiles; a
        larger cloud is an error."""
        self.memory_budget = budget

    def upload(self, cloud: SplatCloud) -> WarpCloud:
        return WarpCloud.of(cloud, self.pool)

    def wrap_arrays(self, arrays: Mapping[str, Any], origin: np.ndarray) -> WarpCloud:
        return WarpCloud.around(arrays, origin, self.pool)

    def unsupported(self, features: FeatureSet) -> str:
        return unsupported(features, self.info.name)

    def pipeline(self, features: FeatureSet, config: KernelConfig | None = None) -> WarpPipeline:
        key = (features, config or self.config)
        if key not in self._pipelines:
            program = Program(self.device, self.info.name, *key)
            self._pipelines[key] = WarpPipeline(program, self, self._launches)
        return self._pipelines[key]

    def gradient_pipeline(self, features: FeatureSet, config: KernelConfig | None = None) -> WarpGradients:
        check_differentiable(features)
        key = (features, config or self.config)
        if key not in self._gradients:
            self._gradients[key] = WarpGradients(self.pipeline(*key))
        return self._gradients[key]

    def probe(self) -> WarpProbe:
        return WarpProbe(self)

    def configs(self, kind: str) -> dict[str, KernelConfig]:
        return other_configs(self.config, kind)


def _describe(device: Any) -> DeviceInfo:
    wp = runtime.load()
    if device.is_cuda:
        title, kind, units = device.name, "gpu", device.sm_count
        memory = device.total_memory
    else:
        units = len(os.sched_getaffinity(0))
        title, kind = f"CPU, {units} thread{'s' if units > 1 else ''}", "cpu"
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return DeviceInfo(
        name=f"warp:{device.alias}",
        title=title,
        platform="NVIDIA Warp",
        version=f"Warp {wp.__version__}",
        kind=kind,
        compute_units=units,
        memory_bytes=memory,
        largest_allocation_bytes=memory,
        float64=True,
        usable=True,
        reason="",
    )


def _describe_missing(why: str) -> DeviceInfo:
    return DeviceInfo(
        name="warp",
        title="NVIDIA Warp: CPU and CUDA",
        platform="NVIDIA Warp",
        version="not installed",
        kind="other",
        compute_units=0,
        memory_bytes=0,
        largest_allocation_bytes=0,
        float64=True,
        usable=False,
        reason=why,
    )
