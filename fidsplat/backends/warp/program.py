"""The kernels of a feature set, compiled for a Warp device."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

from fidsplat.backends.view import View
from fidsplat.backends.warp.command_list import BLOCK
from fidsplat.backends.warp.kernel_config import KernelConfig
from fidsplat.backends.warp.runtime import kernels, load, quiet
from fidsplat.backends.warp.workspace import ArrayPool
from fidsplat.effects import FeatureSet
from fidsplat.effects.differentiable import GRADIENT_OUTPUTS
from fidsplat.effects.extensions import EXTENSIONS
from fidsplat.util.errors import DeviceError

EFFECTS = frozenset(
    {"camera_pinhole", "camera_orthographic", "color_rgb", "color_sh"}
    | {"camera_brown_conrady", "camera_fisheye", "camera_equirectangular"}
    | {"lowpass_none", "lowpass_screen", "lowpass_pixel", "stop_inclusive", "stop_exclusive"}
    | {"ellipsoid_exact", "ellipsoid_ewa", "ellipsoid_ewa_antialiased"}
    | {"order_centre", "order_pixel", "order_coplanar", "order_coplanar_pixel"}
    | {"footprint_gaussian", "footprint_box", "footprint_mixed"}
    | {"background_constant", "background_gradient", "background_panorama"}
    | {"arithmetic_precise", "arithmetic_fast", "arithmetic_approximate"}
    | {"motion_groups", "shutter_exposure", "external_depth"}
    | {"ellipsoids_only", "sub_frame_culling"}  # without influence on images
)
"""supported features, in addition to outputs and post-processing steps, which have a file each"""
_SETTINGS = {"blend_half": "blend_precision='float16'", "blend_double": "blend_precision='float64'"}
"""quality settings that request unsupported features"""
# effects on which each stage depends; feature sets with the same ones share its kernels
_RECORD = (
    *("lowpass_screen", "rays", "camera_orthographic", "ray_depth"),
    *("order_pixel", "order_coplanar", "footprint_box", "footprint_mixed", "ellipsoid_exact"),
)
_PROJECT = (
    *(*_RECORD, "lowpass_pixel", "motion_groups", "ellipsoid_ewa", "ellipsoid_ewa_antialiased"),
    *("camera_brown_conrady", "camera_fisheye", "camera_equirectangular"),
)
_SAMPLE = (
    *_RECORD,
    "ellipsoids_only",
    "stop_exclusive",
    "arithmetic_fast",
    "lens_ray_length",
    "external_depth",
)


def known() -> frozenset[str]:
    """All supported effects."""
    return EFFECTS | kernels("output").known() | kernels("post").known()


def unsupported(features: FeatureSet, name: str) -> str:
    """Error message naming unsupported effects; empty if there are none. name: name of the device."""
    effects = {*features.effects, *features.outputs, *features.post_steps} - known()
    for own in (EXTENSIONS[effect] for effect in effects & EXTENSIONS.keys()):
        if own.warp is not None:
            kernels("post" if own.output is None else "output").__path__.append(str(own.warp))
    effects -= known()
    lacking = ", ".join(sorted(_SETTINGS.get(name, name) for name in effects))
    return f"{name} (NVIDIA Warp) has no {lacking}; use an OpenCL device for it" if lacking else ""


@dataclass(frozen=True)
class _Requirements:
    """Requirements of a feature set."""

    effects: frozenset[str]
    """features, and effects that they or the outputs imply"""
    outputs: tuple[str, ...]
    """files of kernels/warp/output, dependencies included"""
    blending: tuple[str, ...]
    """outputs that are blended"""
    steps: tuple[str, ...]
    """files of kernels/warp/post, in the order of the steps"""

    @classmethod
    def of(cls, features: FeatureSet) -> _Requirements:
        output = kernels("output")
        post_steps, effects = set(features.post_steps), set(features.effects)
        surface = {"surface_label"} if "external_depth" in effects and "label" in features.outputs else set()
        outputs = output.with_needed((*features.outputs, *(post_steps & output.known()), *surface))
        measured = output.having(output.having(outputs, "start"), "length")
        if not effects.isdisjoint(kernels("lens").LENSES):
            effects.add("rays")
        # rays of other lenses have a length of 1
        if "camera_brown_conrady" in effects and measured:
            effects.add("lens_ray_length")
        if "arithmetic_approximate" in effects:
            effects.add("arithmetic_fast")
        if "order_coplanar_pixel" in effects:
            effects |= {"order_coplanar", "order_pixel"}
        with_depth = {"order_pixel", "order_coplanar", "external_depth"}
        if not effects.isdisjoint(with_depth) or output.having(outputs, "depth"):
            effects.add("ray_depth")
        steps = tuple(name for name in features.post_steps if name in kernels("post").known())
        blending = output.having(outputs, "attributes", "state", "samples")
        return cls(frozenset(effects), outputs, blending, steps)

    def among(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Effects among `names` that the program requires."""
        return tuple(name for name in names if name in self.effects)


_MAKING = threading.RLock()
"""lock for making kernels and structs, whose caches are not thread-safe"""


class Program:
    """Compiled kernels of all stages, and their struct types."""

    def __init__(self, device: Any, name: str, features: FeatureSet, config: KernelConfig) -> None:
        """name: name of the device, for errors. Raises DeviceError for an effect that is not supported."""
        if why := unsupported(features, name):
            raise DeviceError(why)
        self.device, self.config, self.features, self._name = device, config, features, name
        self.images = tuple(each for each in features.images if each.name in {"rgb", *features.outputs})
        self.project_block = kernels("project").BLOCK
        self.tile_area = config.tile_width * config.tile_height
        """samples"""
        self.requirements = requirements = _Requirements.of(features)
        with _MAKING, quiet():
            self._make_lists(features, requirements)
            self._make_blend(requirements)
            self._make_resolve(features, requirements)
            made = (self.project, self.list_big, self.blend, self.resolve, *self.accumulate.values())
            common = (self.lists.start_lists, self.lists.list_windows, self.lists.sort_lists)
            further = (self.composite_background, self.sensor and self.sensor.kernel)
            blocks = {self.blend: self.blend_block, self.project: self.project_block}
            blocks[self.lists.start_lists] = self.lists.START_BLOCK
            for kernel in (*made, *common, *filter(None, further)):
                self.compile(kernel, blocks.get(kernel, BLOCK))

    def _make_lists(self, features: FeatureSet, requirements: _Requirements) -> None:
        self.project = kernels("project").make_project(
            requirements.among(_PROJECT),
            kernels("output").having(requirements.outputs, "record"),
            (features.sh_degree + 1) ** 2 if "color_sh" in requirements.effects else 0,
            features.projection_precision,
            self.config.schedule == "tiles",
        )
        self.lists = kernels("tile_lists")
        self.list_big = self.lists.make_list_big("lowpass_screen" in requirements.effects)

    def _make_blend(self, requirements: _Requirements) -> None:
        buffers, blending = kernels("buffers"), requirements.blending
        self.layout = kernels("records").RecordLayout(requirements.among(_RECORD), blending)
        boxes = not requirements.effects.isdisjoint(kernels("records").BOXES)
        self.has_ray_derivatives = boxes and "rays" in requirements.effects
        """whether blending reads the derivatives of a lens's rays"""
        self.has_external_depth = "external_depth" in requirements.effects
        """whether blending reads an external depth image"""
        grouped = self.config.schedule == "group"
        self.blend, self.state, self.blend_block = kernels("blend").make_blend(
            requirements.among(_SAMPLE), blending, grouped, self.tile_area, self.config.k_buffer_size
        )
        """the kernel, the struct of a sample, and the threads of a tile on a GPU"""
        self.sample_fields = buffers.sample_fields(blending)
        """element type of each sample buffer"""
        self.samples_type = buffers.make_samples(tuple(self.sample_fields.items()))
        averaged = buffers.averaged_of(blending) if "shutter_exposure" in requirements.effects else ()
        self.accumulate = {
            name: kernels("shutter").make_accumulate(self.sample_fields[name]) for name in averaged
        }
        """kernels that accumulate sample buffers of sub-frames, by the name of the buffer"""

    def _make_resolve(self, features: FeatureSet, requirements: _Requirements) -> None:
        output, behind = kernels("output"), kernels("background")
        kinds = [kind for kind in behind.KINDS if f"background_{kind}" in requirements.effects]
        self.composite_background = (
            behind.make_composite_background(kinds[0], "rays" in requirements.effects) if kinds else None
        )
        """kernel of the background; None for a constant background"""
        images = tuple((image.name, getattr(load(), image.dtype)) for image in self.images)
        self.images_type = kernels("buffers").make_images(images, requirements.outputs)
        self.cloud_arrays = output.fields(requirements.outputs, "cloud_arrays")
        self.view_arrays = output.fields(requirements.outputs, "view_arrays")
        """element type of each additional array that the resolve stage reads"""
        self.has_ray_lengths = "camera_brown_conrady" in requirements.effects and bool(
            output.having(features.outputs, "length")
        )
        """whether the resolve stage reads the lengths of a lens's rays"""
        self.resolve = kernels("resolve").make_resolve(
            images, requirements.outputs, self.has_ray_lengths, features.samples
        )
        self.sensor = SensorKernel(requirements.steps) if requirements.steps else None

    def compile(self, kernel: Any, block: int = BLOCK) -> None:
        """Compile a kernel for the device. block: its threads on a GPU."""
        # compiled here, not at the first launch, as several threads may launch it
        try:
            loaded = kernel.module.load(self.device, block if self.device.is_cuda else 1)
        except Exception as error:
            raise DeviceError(f"{self._name} cannot compile {kernel.key}: {error}") from error
        if loaded is None:
            raise DeviceError(f"{self._name} cannot compile {kernel.key}; read Warp's messages on stderr")


class GradientKernels:
    """The kernels of the backward pass, compiled on first use."""

    def __init__(self, program: Program) -> None:
        features, requirements, config = program.features, program.requirements, program.config
        rendered = {"rgb", *features.outputs}
        self.gradient_outputs = tuple(name for name in GRADIENT_OUTPUTS if name in rendered)
        self.sh_coefficients = (features.sh_degree + 1) ** 2 if "color_sh" in requirements.effects else 0
        effects, outputs = requirements.among(_SAMPLE), requirements.blending
        backward, names = (
            kernels("blend_backward"),
            kernels("fragment_backward").gradient_sum_names(effects, outputs),
        )
        grouped, block = config.schedule == "group", program.tile_area
        with _MAKING, quiet():
            self.blend = backward.make_blend_backward(effects, outputs, self.gradient_outputs, grouped, block)
            self.gradient_offsets = backward.make_gradient_offsets("lowpass_screen" in effects)
            made = kernels("project_backward").make_project_backward
            self.project = made(requirements.among(_PROJECT), outputs, names, self.sh_coefficients)
            self.sums = kernels("column_sums")
            program.compile(self.blend.kernel, block)
            for kernel in (self.gradient_offsets, self.project, self.sums.add_rows):
                program.compile(kernel)


class SensorKernel:
    """The kernel of the sensor's steps, after resolving, and its settings."""

    def __init__(self, steps: tuple[str, ...]) -> None:
        self._steps = [kernels("post").declared(name) for name in steps]
        self.kernel, self._settings = kernels("sensor").make_sensor(steps)

    def settings(self, view: View, pool: ArrayPool) -> Any:
        filled = self._settings()
        for step in self._steps:
            numbers = [number for name in step.uniforms for number in view.uniforms_of(name)]
            for field, number in zip(step.numbers, numbers, strict=True):
                setattr(filled, field, number)
            for name, dtype in step.arrays.items():
                setattr(filled, name, pool.filled(name, view.array(name), dtype))
        return filled
