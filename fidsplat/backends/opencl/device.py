"""OpenCL devices: listing, choosing, opening."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.caches import pocl_folder
from fidsplat.backends.checked_cache import check_once
from fidsplat.backends.interface import Backend, DeviceInfo, Rates
from fidsplat.backends.opencl.alignment import OpenCLAlignment
from fidsplat.backends.opencl.chunk_cache import OpenCLChunkCache
from fidsplat.backends.opencl.cloud import UploadedCloud
from fidsplat.backends.opencl.gradients import OpenCLGradients
from fidsplat.backends.opencl.images import OpenCLImages
from fidsplat.backends.opencl.kernel_config import (
    KernelConfig,
    config_for,
    cpu_config,
    gpu_config,
    other_configs,
    small_frame_config,
)
from fidsplat.backends.opencl.pipeline import OpenCLPipeline
from fidsplat.backends.opencl.pocl_workarounds import is_pocl, kernel_cache, linker, target_patch
from fidsplat.backends.opencl.probe import OpenCLProbe
from fidsplat.backends.opencl.program import BackgroundCompiler, build_options
from fidsplat.backends.opencl.roofline import measure_rates
from fidsplat.backends.opencl.training import OpenCLTraining
from fidsplat.backends.opencl.vendors import intel_registered, processor_flags
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.termination_depth import TerminationDepths
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet
from fidsplat.effects.differentiable import check_differentiable
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import DeviceError, UnknownDeviceError
from fidsplat.util.files import user_cache

_FEW_SAMPLES = 2560  # per compute unit; a compute unit of an H200 runs 2048 work-items at once
_PYOPENCL_FILES = ("binary", "info", "source.cl")
_NO_PATCH_NEEDED = (
    "a newer PoCL (Debian: pocl-opencl-icd; conda: pocl) or Intel's runtime for CPUs needs no patch "
    "(docs/backends.md)"
)
_PATCHED = (
    f"PoCL 3.0 does not recognise this processor and is patched in memory when used; {_NO_PATCH_NEEDED}"
)
_NO_PLATFORM = (
    "no OpenCL platform found; install a CPU one with: pip install 'pyopencl[pocl]' "
    "(GPUs bring theirs with the driver; its path belongs in a file under /etc/OpenCL/vendors)"
)


def devices() -> list[DeviceInfo]:
    """All OpenCL devices of this machine, usable or not. An empty list if there is no platform."""
    return [_describe(device, name) for name, device in _named_devices().items()]


def open_device(selector: str = "") -> OpenCLBackend:
    """Open the best usable device that matches a selector: GPUs before CPUs, patched PoCL last.

    selector: `cpu` or `gpu`; part of a platform's name; part of a GPU's name or vendor if no platform
    matches; or a name from `devices` without `opencl:`, such as `pocl-2`. Raises DeviceError if no device can
    be used, and UnknownDeviceError if none matches.
    """
    named = _named_devices()
    if not named:
        raise DeviceError(_NO_PLATFORM)
    requested = selector.strip().lower()
    numbered = named.get(f"opencl:{requested}") if requested[-1:].isdigit() else None
    matching = [numbered] if numbered else _matching(named.values(), requested)
    if not matching:
        available = "; ".join(f"{name}: {device.name}" for name, device in named.items())
        raise UnknownDeviceError(f"no OpenCL device matches {selector!r}; there are: {available}")
    usable = [device for device in matching if not _why_unusable(device)]
    if not usable:
        reasons = "; ".join(f"{device.name}: {_why_unusable(device)}" for device in matching)
        raise DeviceError(f"no usable OpenCL device ({reasons})")
    return OpenCLBackend(
        min(usable, key=lambda device: (not device.type & cl.device_type.GPU, _needs_patch(device)))
    )


class OpenCLBackend(Workspace, Backend):
    """An open OpenCL device, with its compiled pipelines."""

    def __init__(self, device: cl.Device) -> None:
        if is_pocl(device):
            linker.provide_linker()
            if _needs_patch(device):
                target_patch.announce_once(pocl_folder(), _PATCHED)
            check_once(pocl_folder(), kernel_cache.is_loaded, kernel_cache.is_complete)
        else:  # pyopencl caches programs for drivers without a cache of their own
            check_once(user_cache() / "pyopencl", _PYOPENCL_FILES.__contains__, lambda _: True)
        super().__init__(device, _describe(device, _name_of(device)), _config(device))
        self.compiler_options = build_options(device)
        self._pipelines: dict[tuple[FeatureSet, KernelConfig | None, KernelConfig], OpenCLPipeline] = {}
        """pipelines by the arguments of `pipeline`, and the device's config, which tests replace"""
        self._gradients: dict[OpenCLPipeline, OpenCLGradients] = {}
        self._alignment: OpenCLAlignment | None = None
        self._background = BackgroundCompiler()

    def upload(self, cloud: SplatCloud) -> UploadedCloud:
        return UploadedCloud(self, cloud)

    def chunk_cache(self, chunks: Any) -> OpenCLChunkCache:
        return OpenCLChunkCache(self, chunks)

    def termination_depths(self, images: OpenCLImages) -> TerminationDepths:
        return images.termination_depths()

    def copy_tiles(self, images: OpenCLImages, other: OpenCLImages, tiles: np.ndarray) -> None:
        images.copy_tiles(other, tiles)

    def unsupported(self, features: FeatureSet) -> str:
        if self.info.float64 or "blend_double" not in features.effects:
            return ""
        return (
            f"{self.info.title} has no float64 (cl_khr_fp64) for blend_precision='float64'; use "
            "blend_precision='float32', or another device"
        )

    def pipeline(self, features: FeatureSet, config: KernelConfig | None = None) -> OpenCLPipeline:
        key = features, config, self.config
        pipeline = self._pipelines.get(key)
        if pipeline is not None:
            return pipeline
        if why := self.unsupported(features):
            raise DeviceError(why)
        if not self.info.float64 and features.projection_precision != "float32":
            features = replace(features, projection_precision="float32")
        config = config or config_for(features, self.config)
        if config.blend_items > self.device.max_work_group_size:
            raise DeviceError(
                f"a tile must have at most {self.device.max_work_group_size} work-items on "
                f"{self.info.title}, got {config.blend_items} for {config.tile_width} x "
                f"{config.tile_height} samples; use another device"
            )
        self._pipelines[key] = pipeline = OpenCLPipeline(self, features, config, self.pipeline)
        return pipeline

    def frame_config(self, view: View, count: int = 1) -> KernelConfig | None:
        """Smaller tiles for frames with too few tiles to occupy a GPU (devlog/tuning.md), except with a small
        memory budget, as smaller tiles have more pairs."""
        if self.config.schedule != "group" or self.memory_budget < self.info.memory_bytes // 2:
            return None
        samples = count * view.width * view.height
        few = samples <= _FEW_SAMPLES * self.info.compute_units
        return small_frame_config(self.config) if few else None

    def gradient_pipeline(self, features: FeatureSet, config: KernelConfig | None = None) -> OpenCLGradients:
        check_differentiable(features)
        self._background.wait(features)
        pipeline = self.pipeline(features, config)
        if pipeline not in self._gradients:
            self._gradients[pipeline] = OpenCLGradients(pipeline)
        return self._gradients[pipeline]

    def compile_in_background(self, features: FeatureSet, refined: bool = False) -> None:
        if self._pipelines.get((features, None, self.config)) not in self._gradients:
            self._background.begin(features, lambda: self.gradient_pipeline(features).compile_step(refined))

    def training(self) -> OpenCLTraining:
        return OpenCLTraining(self)

    def alignment(self) -> OpenCLAlignment:
        """Compiled kernels of direct image alignment."""
        with self.lock:
            if self._alignment is None:
                self._alignment = OpenCLAlignment(self)
            return self._alignment

    @property
    def memory_bytes(self) -> int:
        """Bytes of the buffer pool: scratch buffers and buffers of released images."""
        return self.pool.memory_bytes

    def release_scratch(self) -> None:
        self.pool.clear()

    def rates(self) -> Rates:
        return measure_rates(self)

    def probe(self) -> OpenCLProbe:
        return OpenCLProbe(self)

    def configs(self, kind: str) -> dict[str, KernelConfig]:
        return other_configs(self.config, kind)


def _all_devices() -> Iterator[cl.Device]:
    try:
        with intel_registered():
            platforms = cl.get_platforms()
    except cl.Error:  # the loader found no platform
        return
    for platform in platforms:
        try:
            yield from platform.get_devices()
        except cl.Error:  # a platform without devices
            continue


def _named_devices() -> dict[str, cl.Device]:
    """Devices by their `--device` names; further devices of a platform have a number, from 2."""
    named: dict[str, cl.Device] = {}
    for device in _all_devices():
        platform = device.platform.name
        short = "pocl" if is_pocl(device) else platform.split()[0].split("(")[0].lower()
        name, number = f"opencl:{short}", 1
        while name in named:
            number += 1
            name = f"opencl:{short}-{number}"
        named[name] = device
    return named


def _name_of(device: cl.Device) -> str:
    return next(name for name, other in _named_devices().items() if other == device)


def _matching(devices: Iterable[cl.Device], selector: str) -> list[cl.Device]:
    """Devices that match a selector. CPU names are not compared: `intel` would match PoCL on an Intel CPU."""
    devices = list(devices)
    if selector in ("cpu", "gpu"):
        return [device for device in devices if device.type & getattr(cl.device_type, selector.upper())]
    if selector == "pocl":
        return [device for device in devices if is_pocl(device)]
    return [device for device in devices if selector in device.platform.name.lower()] or [
        device
        for device in devices
        if not device.type & cl.device_type.CPU and selector in f"{device.name} {device.vendor}".lower()
    ]


def _why_unusable(device: cl.Device) -> str:
    if not device.available:
        return "the driver reports it as unavailable"
    if not device.compiler_available:
        return "it has no OpenCL C compiler"
    if not device.endian_little:
        return "it is big-endian"
    if is_pocl(device) and (why := linker.why_no_linker()):
        return why
    if _needs_patch(device) and (why := target_patch.why_unpatchable(device.int_ptr, device.version)):
        return f"this PoCL's compiler does not know the processor, and {why}; {_NO_PATCH_NEEDED}"
    return ""


def _needs_patch(device: cl.Device) -> bool:
    return target_patch.needs_patch(device.version)


def _describe(device: cl.Device, name: str) -> DeviceInfo:
    why = _why_unusable(device)
    kind = (
        "gpu" if device.type & cl.device_type.GPU else "cpu" if device.type & cl.device_type.CPU else "other"
    )
    float64 = "cl_khr_fp64" in device.extensions
    remarks = ["no float64: per-splat projection in float32"] * (not float64) + [_PATCHED] * _needs_patch(
        device
    )
    return DeviceInfo(
        name=name,
        title=device.name.strip(),
        platform=device.platform.name.strip(),
        version=device.version.strip(),
        kind=kind,
        compute_units=device.max_compute_units,
        memory_bytes=device.global_mem_size,
        largest_allocation_bytes=device.max_mem_alloc_size,
        float64=float64,
        usable=not why,
        reason=why or "; ".join(remarks),
    )


def _config(device: cl.Device) -> KernelConfig:
    fast_fma = bool(device.single_fp_config & cl.device_fp_config.FMA)
    if device.type & cl.device_type.CPU:
        fast_fma |= "fma" in processor_flags()  # Intel's runtime does not report it
        lanes = 16 if device.native_vector_width_float >= 16 else 8
        return cpu_config(lanes, device.max_compute_units, fast_fma)
    dialect = "ptx" if device.platform.name == "NVIDIA CUDA" else ""
    return gpu_config(min(1024, device.max_work_group_size), fast_fma, dialect)
