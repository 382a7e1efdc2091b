"""The stages of one FeatureSet, compiled for one Warp device."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fidsplat.backends.base import View
from fidsplat.backends.warp import exposure, lens, runtime, sensor
from fidsplat.backends.warp.around import Surroundings
from fidsplat.backends.warp.finished import WarpPlanes
from fidsplat.backends.warp.launch import BLOCK, Launcher
from fidsplat.backends.warp.memory import Resident
from fidsplat.backends.warp.run import Run
from fidsplat.effects import FeatureSet
from fidsplat.errors import DeviceError

if TYPE_CHECKING:
    from fidsplat.backends.warp.backend import WarpBackend, WarpShape

KNOWN = frozenset(
    {"camera_pinhole", "color_rgb", "color_sh", "lowpass_none", "lowpass_screen", "lowpass_pixel"}
    | {"stop_inclusive", "stop_exclusive", "compose_ordered", "compose_planes", "ray_depth"}
    | {"arithmetic_precise", "arithmetic_fast", "shown"}
    | {"perspective", "footprint_gaussian", "footprint_box", "footprint_mixed", "box_edges", "box_cover"}
    | {"background_constant", "background_gradient", "background_panorama", "fog"}
    | {"ray", "ray_length", "sample_length", "turn", "world_ray"}
    | {"alpha", "depth", "depth_median", "depth_first", "distance", "distance_median", "distance_first"}
    | {"normal", "normal_world", "label", "splat_id", "blended"}
    | sensor.STEPS
    | lens.EFFECTS
    # shutter_rows changes no picture, and nothing here
    | {"motion_groups", "shutter_exposure", "shutter_rows", "camera_orthographic"}
)
"""effects that kernels/warp has"""
# of these depend on an effect: a stage is compiled once for all feature sets that mean the same to it
_RECORD = (
    *("lowpass_screen", "rays", "camera_orthographic", "ray_depth", "normal", "compose_planes"),
    *("footprint_box", "footprint_mixed"),
)
_PROJECT = (
    *(*_RECORD, "lowpass_pixel", "motion_groups"),
    *("camera_brown_conrady", "camera_fisheye", "camera_equirectangular"),
)
_SAMPLE = (
    *(*_RECORD, "stop_exclusive", "arithmetic_fast"),
    *("depth", "depth_median", "depth_first", "heaviest", "blended", "fog", "rays_length"),
)


class WarpPipeline:
    """Compiled stages."""

    def __init__(self, backend: WarpBackend, features: FeatureSet, shape: WarpShape) -> None:
        names = {effect.name for effect in features.effects}
        lacking = sorted(names - KNOWN)
        if lacking:
            raise DeviceError(
                f"{backend.info.name} ({backend.info.platform}) has no {', '.join(lacking)}; "
                "use an OpenCL device for it"
            )
        self.backend, self.features, self.shape = backend, features, shape
        if names & {"label", "splat_id"}:
            names |= {"heaviest"}  # both are the same splat's
        record = tuple(name for name in _RECORD if name in names)
        sample = tuple(name for name in _SAMPLE if name in names)
        terms = (features.sh_degree + 1) ** 2 if "color_sh" in names else 0
        screen = "lowpass_screen" in names
        with runtime.quiet():
            self.layout = runtime.kernels("records").Layout(record)
            self.project = runtime.kernels("project").make_project(
                tuple(name for name in _PROJECT if name in names),
                terms,
                features.setup_precision,
                shape.schedule == "tiles",
            )
            self.project_block = runtime.kernels("project").BLOCK
            self.lists = runtime.kernels("lists").make_lists(screen)
            self.sort = runtime.kernels("lists")
            self.block_dim = shape.tile_width * shape.tile_height
            """threads that draw a tile on a GPU"""
            self.blend, self.state = runtime.kernels("blend").make_blend(
                sample, shape.schedule == "group", self.block_dim
            )
            planes = runtime.kernels("planes")
            self.sample_planes = planes.of_samples(sample)
            """type of an element of each"""
            finished = tuple(output.name for output in features.outputs)
            integers = tuple(output.name for output in features.outputs if output.dtype == "int32")
            self.samples_type = planes.make_samples(tuple(self.sample_planes.items()))
            self.outputs_type = planes.make_outputs(finished, integers)
            self.surroundings = Surroundings.among(names, backend)
            self.sloped = "rays_box" in names
            """whether blending needs the derivatives of a lens's rays"""
            self.stretched = "rays_sample_length" in names
            """whether a lens gives rays the lengths that resolving needs"""
            self.resolve = runtime.kernels("resolve").make_resolve(
                finished, integers, tuple(self.sample_planes.items()), self.stretched, features.samples
            )
            common = [self.sort.compact, self.sort.gather, self.sort.find_starts, self.sort.sum_up]
            self.sensor = sensor.Development.of(features.posts)
            if self.surroundings:
                common.append(self.surroundings.kernel)
            if self.sensor:
                common.append(self.sensor.kernel)
            self.expose = exposure.kernels_of(self.sample_planes) if "shutter_exposure" in names else {}
            """by the name of a plane of samples"""
            common += self.expose.values()
            for kernel in (self.project, self.lists.emit, self.blend, self.resolve, *common):
                self._compile(kernel)

    def _compile(self, kernel: Any) -> None:
        # here rather than at the first launch: several threads launch it
        block = {self.blend: self.block_dim, self.project: self.project_block}.get(kernel, BLOCK)
        if not self.backend.device.is_cuda:
            block = 1
        try:
            loaded = kernel.module.load(self.backend.device, block)
        except Exception as error:
            raise DeviceError(f"{self.backend.info.name} cannot compile {kernel.key}: {error}") from error
        if loaded is None:
            raise DeviceError(
                f"{self.backend.info.name} cannot compile {kernel.key}; Warp says more on stderr"
            )

    def load_banding(self) -> None:
        """Compile what only a picture with more pairs than the budget needs."""
        with runtime.quiet():
            self._compile(self.lists.histogram)
            self._compile(self.lists.count)

    def render(self, resident: Resident, view: View) -> WarpPlanes:
        """Draw one picture.

        Raises:
            DeviceError: the device runs out of memory or fails.
        """
        return self._drawn(resident, view).planes

    def trace(self, resident: Resident, view: View) -> dict[str, np.ndarray]:
        """Draw one picture and return what passes between the stages.

        keys (n,) uint32; order (visible,), splat indices by depth; starts (tiles + 1,); lists (pairs,), of
        the last band;
        records (n, words) float32 (undefined for culled splats); raw (4, rows, columns) float32: r, g, b,
        transmittance of the
        padded sample grid; and the finished outputs by name.
        """
        run = self._drawn(resident, view)
        stats = run.planes.stats
        rows, stride = run.grid
        raw = run.held["raw color"].numpy()[: rows * stride]
        return {
            "keys": run.held["keys"].numpy()[: resident.count].copy(),
            "order": run.held["order"].numpy()[: stats["visible"]].astype(np.uint32),
            "starts": run.held["starts"].numpy()[: run.tiles + 1].astype(np.uint32),
            "lists": run.held["lists"].numpy()[: stats["pairs"]].astype(np.uint32),
            "records": run.held["lines"]
            .numpy()[: resident.count * self.layout.lines]
            .reshape(resident.count, -1)
            .copy(),
            "raw": raw.reshape(rows, stride, 4).transpose(2, 0, 1).copy(),
            **{output.name: run.planes.read(output.name) for output in self.features.outputs},
        }

    def _drawn(self, resident: Resident, view: View) -> Run:
        wp = runtime.load()
        try:
            with wp.ScopedDevice(self.backend.device):
                run = Run(self, resident, view, Launcher(self.backend))
                run.draw()
                return run
        except RuntimeError as error:
            if isinstance(error, DeviceError):
                raise
            raise DeviceError(f"{self.backend.info.name} failed while drawing: {error}") from error
