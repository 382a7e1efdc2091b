"""Gradients of a frame, by the backward kernels (kernels/warp/*_backward.py)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from fidsplat.backends.gradients import NOT_LATEST_FRAME, DifferentiableImages, check_shape, gradient_shape
from fidsplat.backends.interface import GradientPipeline
from fidsplat.backends.view import View
from fidsplat.backends.warp.cloud import WarpCloud
from fidsplat.backends.warp.command_list import Launcher
from fidsplat.backends.warp.frame import DeviceFrame
from fidsplat.backends.warp.images import WarpImages
from fidsplat.backends.warp.pipeline import WarpPipeline
from fidsplat.backends.warp.program import GradientKernels
from fidsplat.backends.warp.runtime import kernels, load, quiet
from fidsplat.effects.differentiable import check_gradients
from fidsplat.util.errors import DeviceError, InputError

_SHARES = 2048
"""threads of a sum over all pixels or splats; the number determines the order of additions"""


class WarpDifferentiable(DifferentiableImages):
    frame: DeviceFrame
    images: WarpImages

    def device_array(self, name: str) -> Any:
        """The image as a wp.array; no copy."""
        return self.images.device_array(name, 0)

    def wait(self) -> None:
        """Wait until the device has rendered the frame."""
        self.images.wait()


class WarpGradients(GradientPipeline):
    """Compiled stages and their derivatives."""

    def __init__(self, pipeline: WarpPipeline) -> None:
        self._pipeline, self._kernels = pipeline, GradientKernels(pipeline.program)

    def forward(self, cloud: WarpCloud, view: View, waits: bool = True) -> WarpDifferentiable:
        """Render one view; always waits."""
        frame, images = self._pipeline.render_counted(cloud, view)
        if frame.tile_ranges > 1:
            raise DeviceError(
                "frames with derivatives must fit the memory budget without ranges of tiles, got "
                f"{cloud.count:,} splats; raise memory_budget, or use fewer splats or smaller images"
            )
        return WarpDifferentiable(frame, images)

    def backward(self, images: WarpDifferentiable, gradients: Mapping[str, Any]) -> dict[str, Any]:
        frame = images.frame
        check_gradients(frame.program.features, gradients)
        if not images.is_latest:
            raise InputError(NOT_LATEST_FRAME)
        with frame.workspace.working("in the backward pass"):
            return _Backward(frame, self._kernels, gradients).results()


class _Backward:
    """The backward pass of a frame, with a method for each stage."""

    def __init__(self, frame: DeviceFrame, made: GradientKernels, gradients: Mapping[str, Any]) -> None:
        self._frame, self._made, self._wp = frame, made, load()
        self._launcher: Launcher = frame.launcher
        self._count, self._pairs = frame.cloud.count, frame.stats["pairs"]
        # a placeholder, which kernels do not read if all splats are disks
        self._arguments = {**frame.named, "thickness": frame.cloud.arrays["opacities"]}
        self._arguments |= frame.cloud.arrays | {"image_gradients": self._image_gradients(gradients)}
        self._arguments |= {
            "samples": frame.samples,
            "color": frame.samples.color,
            "background": self._wp.vec3(*frame.view.background),
            "log_ceiling": math.log(frame.view.opacity_ceiling),
            "grad_rgb": self._arguments["image_gradients"].rgb,
        }

    def results(self) -> dict[str, Any]:
        """Run all stages; returns gradients as `GradientPipeline.backward` does."""
        found = self._allocate_results()
        self._launcher.stage("blend backward")
        self._blend()
        self._launcher.stage("project backward")
        if self._pairs:
            self._launcher.launch(self._made.project, self._count, self._arguments)
        else:  # no splat is visible, so there are no sums
            for array in (*found.values(), self._arguments["grad_cameras"]):
                array.zero_()
        view = self._frame.view
        pixels = view.width * view.height
        parts = self._exact("background parts", 3 * _SHARES, self._wp.float64)
        sizes = {"pixels": pixels, "width": view.width, "stride": self._frame.grid[1], "threads": _SHARES}
        arguments = self._arguments | sizes | {"parts": parts}
        self._launcher.launch(self._made.sums.background_parts, _SHARES, arguments)
        self._sum_rows(parts, _SHARES, 3, found["background"])
        self._sum_rows(
            flat_of(self._arguments["grad_cameras"]), self._count, 10, self._arguments["grad_camera"]
        )
        self._launcher.stage(None)
        return found

    def _blend(self) -> None:
        """Sum gradients over the samples of each (splat, tile) pair."""
        wp, frame, made, pairs = self._wp, self._frame, self._made, self._pairs
        if not pairs:
            return
        self._exact("gradient_offsets", pairs, wp.int32)
        ends = self._exact("ends_by_index", self._count, wp.int32)
        wp.utils.array_scan(self._arguments["counts"], ends, inclusive=True)
        self._arguments["tiles"] = frame.tiles
        self._launcher.launch(made.gradient_offsets, pairs, self._arguments)
        self._arguments["gradient_sums"] = gradient_sums = frame.pool.exact(
            "gradient_sums", pairs, made.blend.GradientSums
        )
        gradient_sums.zero_()
        config = frame.program.config
        area = config.tile_width * config.tile_height
        segment_size = kernels("blend_backward").SEGMENT
        checkpoints = area * (pairs // segment_size + frame.tiles + 1)
        self._arguments["checkpoints"] = self._exact("checkpoints", checkpoints, wp.float32)
        kernel, tiles = made.blend.kernel, frame.tiles
        if config.schedule == "group":
            arguments = self._arguments | {"first_tile": 0}
            self._launcher.launch_undivided(kernel, tiles * area, arguments, area)
            return
        states = self._launcher.parts * area
        self._arguments["transmittances"] = self._exact("transmittances", states, wp.float32)
        self._arguments["pixel_gradients"] = self._exact("pixel_gradients", states, made.blend.PixelGradient)
        self._arguments["fragments"] = self._exact("fragments", states * segment_size, wp.vec2)
        self._launcher.launch_blocks(kernel, 0, tiles, self._arguments, area=area)

    def _sum_rows(self, parts: Any, rows: int, columns: int, result: Any) -> None:
        """Sum all rows in a fixed order."""
        sums = self._exact("sums", columns * _SHARES, self._wp.float64)
        total = self._exact("total", columns, self._wp.float64)
        made = self._made.sums
        for given, length, stride, out in ((parts, rows, _SHARES, sums), (sums, _SHARES, 1, total)):
            sizes = {"rows": length, "columns": columns, "stride": stride, "parts": given, "sums": out}
            self._launcher.launch(made.add_rows, stride * columns, sizes)
        self._launcher.launch(made.as_single, columns, {"sums": total, "singles": result})

    def _image_gradients(self, gradients: Mapping[str, Any]) -> Any:
        """Struct of the gradients with respect to the images for the kernels; missing gradients are 0."""
        struct = self._made.blend.ImageGradients()
        for name in self._made.gradient_outputs:
            view, given = self._frame.view, gradients.get(name)
            size = math.prod(gradient_shape(name, view))
            if given is None:
                array = self._frame.pool.exact(f"gradient of {name}", size, self._wp.float32)
                array.zero_()
            else:
                check_shape(name, _shape_of(given), view)
                array = self._device_gradient(name, given)
            setattr(struct, name, array)
        return struct

    def _device_gradient(self, name: str, given: Any) -> Any:
        """A gradient as a flat device array; no copy if it is on the device."""
        wp, pool = self._wp, self._frame.pool
        if hasattr(given, "__dlpack__") and not isinstance(given, (np.ndarray, wp.array)):
            try:
                given = wp.from_dlpack(given)
            except Exception as error:  # raised by the library of the array, for example torch's BufferError
                raise InputError(
                    f"the gradient of {name} must be detached, got {error}; detach it first"
                ) from None
        if not isinstance(given, wp.array):
            return pool.filled(
                f"gradient of {name}", np.ascontiguousarray(given, np.float32).ravel(), wp.float32
            )
        scalar = getattr(given.dtype, "_wp_scalar_type_", given.dtype)
        if scalar is not wp.float32 or not given.is_contiguous or given.device != pool.device:
            raise InputError(
                f"the gradient of {name} must be a contiguous float32 array on {pool.device}, got "
                f"{wp.types.type_repr(given.dtype)} on {given.device}; copy it first"
            )
        return flat_of(given)

    def _allocate_results(self) -> dict[str, Any]:
        """Allocate the results; each call overwrites them."""
        wp, count, terms = self._wp, self._count, max(self._made.sh_coefficients, 1)
        kinds = {
            "grad_means": wp.vec3,
            "grad_quats": wp.vec4,
            "grad_scales": wp.vec2,
            "grad_opacities": wp.float32,
            "grad2d": wp.float32,
        } | ({"grad_thickness": wp.float32} if self._frame.cloud.ellipsoids != "none" else {})
        found = {name.removeprefix("grad_"): self._exact(name, count, dtype) for name, dtype in kinds.items()}
        self._arguments.setdefault(
            "grad_thickness", self._arguments["grad_opacities"]
        )  # not written for disks
        colors = self._exact("grad_colors", count * terms, wp.vec3)
        if self._made.sh_coefficients:
            found["sh"] = colors.reshape((count, terms))
        else:
            found["colors"] = colors
        self._exact("grad_cameras", count, kernels("project_backward").TEN)
        found["background"] = self._exact("grad_background", 3, wp.float32)
        grad_camera = self._exact("grad_camera", 10, wp.float32)
        found["pose"], found["intrinsics"] = grad_camera[:6], grad_camera[6:]
        return found

    def _exact(self, name: str, size: int, dtype: Any) -> Any:
        self._arguments[name] = array = self._frame.pool.exact(name, size, dtype)
        return array


def flat_of(array: Any) -> Any:
    """View a contiguous array of numbers or vectors as flat numbers."""
    wp = load()
    scalar = getattr(array.dtype, "_wp_scalar_type_", array.dtype)
    size = math.prod(_shape_of(array))
    flat = wp.array(ptr=array.ptr, dtype=scalar, shape=(size,), device=array.device)
    flat._ref = array  # a reference to the memory
    return flat


def add_to(sums: Any, values: Any) -> None:
    """Add float32 numbers or vectors to sums of equal size on the device."""
    arrays = _components_of(sums), _components_of(values)
    given = {"device": sums.device, "record_tape": False}
    with quiet():
        load().launch(kernels("column_sums").add_to, arrays[0].shape, [*arrays], **given)


def _components_of(array: Any) -> Any:
    """View a strided array of float32 numbers or vectors as (elements, components)."""
    wp = load()
    shape, strides = (array.size, wp.types.type_size(array.dtype)), (array.strides[-1], 4)
    view = wp.array(ptr=array.ptr, dtype=wp.float32, shape=shape, strides=strides, device=array.device)
    view._ref = array  # a reference to the memory
    return view


def _shape_of(array: Any) -> tuple[int, ...]:
    """Shape of an array of numbers or vectors; vectors add an axis."""
    wp = load()
    shape = tuple(array.shape)
    if isinstance(array, wp.array) and wp.types.type_is_vector(array.dtype):
        return (*shape, wp.types.type_size(array.dtype))
    return shape
