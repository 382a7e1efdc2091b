"""Training kernels: loss, Adam, densification and noise on the device, without copies to the host."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from fidsplat.backends.opencl.assemble import assemble_training
from fidsplat.backends.opencl.cloud import OpenCLCloud
from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.program import Program
from fidsplat.backends.opencl.view_refinement import OpenCLViewRefinement
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.view import View
from fidsplat.util.errors import DeviceError

_GROUP = 64
_MARGIN, _MARGIN_ROWS = 16, 5
"""zero margin around an image: in floats of a row, and in rows"""
_PANEL, _STRIP = 128, 64
"""values of a row and number of rows per work-item on CPUs (kernels/opencl/train/loss_strips.cl)"""
_SUM_GROUPS, _SUM_ITEMS = 512, 128
"""work-groups of the loss sums, and their work-items (SUM_ITEMS of kernels/opencl/train/loss.cl)"""
_EXPOSURE_GROUPS, _EXPOSURE_ITEMS = 256, 96
"""work-groups of the kernels of exposures on CPUs, and their work-items (EXPOSURE_ITEMS of
kernels/opencl/train/exposure.cl)"""
_ROWS_PER_ITEM = 4
"""rows per work-item of the vertical passes (ROWS_PER_ITEM of kernels/opencl/train/loss.cl)"""
_MOMENTS = ("first_", "second_")
"""name prefixes of Adam's moments"""
SLOTS = 16
"""maximum number of unread losses"""
_STEP_NUMBERS = (
    *("beta1", "beta2", "one_minus_beta1", "one_minus_beta2", "sqrt_correction2", "epsilon"),
    *("scale_penalty", "opacity_penalty"),
    *(f"lr_{name}" for name in ("means", "scales", "quats", "logits", "sh", "rest")),
)
"""numeric arguments of a step of Adam (kernels/opencl/project_step.cl)"""
_NO_VIEW_STEP = {"view_index": 0, "next_view": 0, "pose_rate": 0.0, "exposure_rate": 0.0}
"""arguments of the kernel `refine_view` without an update"""


class _Target(NamedTuple):
    """Ground truth of a view on the device."""

    image: cl.Buffer
    mask: cl.Buffer
    masked: bool
    values: int
    """number of values inside the mask"""


Launch: TypeAlias = tuple[str, tuple[int, ...], tuple[int, ...], list[Any]]
"""kernel, size, work-group, and values of the arguments"""


class ResidentArrays(OpenCLCloud):
    """Device arrays of splats in training as a resident cloud, without labels and coplanar groups."""

    has_coplanar_groups, footprint, immutable = False, "gaussian", False

    def __init__(
        self, buffers: Mapping[str, cl.Buffer], count: int, sh_degree: int, origin: np.ndarray
    ) -> None:
        super().__init__(count)
        self._buffers, self.origin, self.sh_degree = dict(buffers), origin, sh_degree
        self.ellipsoids = "all" if "thickness" in buffers else "none"

    def bytes_for(self, names: Any) -> tuple[int, int]:
        return self.memory_bytes, 0

    def array_in_cloud_order(self, name: str, first: int, end: int) -> cl.Buffer:
        complete = self._buffers[name]
        return self._region(complete, first, end, complete.size // max(self.count, 1))


class LossReadback:
    """Ring buffer for the sums of the last losses, which the host reads several at a time."""

    def __init__(self, workspace: Workspace, groups: int) -> None:
        """groups: number of work-groups, each with three sums."""
        self._workspace, self._groups = workspace, groups
        align = max(1, workspace.device.mem_base_addr_align // 8)
        size = -(-12 * groups // align) * align
        self._buffer = workspace.pool.allocate("losses", SLOTS * size)
        self._slots = [self._buffer.get_sub_region(k * size, 12 * groups) for k in range(SLOTS)]
        self._words = np.empty((SLOTS, size // 4), np.float32)
        self._next = 0
        self._last: cl.Event | None = None
        """event of the last loss's sums; the queue is in order, so earlier losses are complete too"""
        self._unread: set[int] = set()

    def next_slot(self) -> tuple[int, cl.Buffer]:
        """The next slot and its buffer; slots are reused after `SLOTS` losses."""
        self._next = (self._next + 1) % SLOTS
        return self._next, self._slots[self._next]

    def submitted(self, slot: int, event: cl.Event) -> None:
        """Mark a slot as unread. event: of the kernel that writes its sums."""
        self._last = event
        self._unread.add(slot)

    def read(self, slot: int) -> np.ndarray:
        """Read the three sums (3,) float64 of a slot; all unread slots are copied together."""
        if slot in self._unread:
            after = None if self._last is None else [self._last]
            cl.enqueue_copy(self._workspace.side_queue, self._words, self._buffer, wait_for=after)
            self._unread.clear()
        sums = self._words[slot, : 3 * self._groups].reshape(self._groups, 3)
        return sums.sum(axis=0, dtype=np.float64)


class OpenCLTraining:
    """Device kernels of a training step except rendering: loss, optimiser, densification, noise.

    The state is n splats before their activation functions, float32: `means` (n, 3), `log_scales` (n, 2) of
    disks or (n, 3) of 3D Gaussians, `quats` (n, 4), `logits` (n,), `sh` (n, k, 3); Adam's moments of each,
    `first_NAME` and `second_NAME`; and the statistics of densification, `gradient_sums` and `visible_counts`
    (n,).
    """

    max_pending_losses = SLOTS // 2 - 1  # a frame that exceeds its capacity uses two slots
    """maximum number of frames that are submitted before a loss is read"""

    def __init__(self, workspace: Workspace, lanes: int = 0) -> None:
        """lanes: vector width; 0 for the device's own."""
        self._workspace = workspace
        lanes = lanes or (workspace.config.lanes if workspace.config.schedule == "lanes" else 1)
        self._lanes = lanes
        source = assemble_training(lanes, workspace.info.float64, workspace.config.fast_fma)
        self._program = Program(workspace, source)
        self._commands = CommandList(self._program)
        """command list of kernels that are not replayed"""
        self._bound: dict[str, Any] = {}
        """buffers and numbers of the splats by kernel argument"""
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._count = 0
        self._resident: tuple[int, ResidentArrays] | None = None
        """SH degree of the last rendered cloud, and the cloud"""
        self._targets: list[_Target] = []
        self._loss_images: tuple[tuple[int, int], cl.Buffer] | None = None
        self._readbacks: dict[int, LossReadback] = {}
        self._version = object()
        """a new object whenever the buffers of the splats change"""
        self._replayed: dict[str, CommandList] = {}
        self._refinement: OpenCLViewRefinement | None = None

    def load_views(
        self, views: Sequence[tuple[np.ndarray, np.ndarray | None]], intrinsics: np.ndarray
    ) -> None:
        """Copy the images to the device: (h, w, 3) uint8 each, with a mask (h, w) bool or None. intrinsics:
        (views, 4) fx, fy, cx, cy."""
        self._bound["lenses"] = self._upload("intrinsics", intrinsics.astype(np.float32))
        # used only if there are exposures
        self._bound["exposures"] = self._bound["exposure_sums"] = self._bound["lenses"]
        for image, mask in views:
            weights = np.zeros(1, np.uint8) if mask is None else mask.astype(np.uint8)
            values = image.size if mask is None else max(1, 3 * int(weights.sum()))
            buffers = self._upload("an image", image), self._upload("a mask", weights)
            self._targets.append(_Target(*buffers, mask is not None, values))

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Set arrays of the state by their names; others are unchanged."""
        for name, array in arrays.items():
            self._bound[name] = self._upload(f"the splats' {name}", array)
            self._shapes[name] = array.shape
        self._splats_changed()

    def gather_rows(self, rows: np.ndarray, remaining: int) -> None:
        """Keep or duplicate splats: row i of the new state is row `rows[i]` of the old one, (m,) uint32.
        Moments are zero from row `remaining` on."""
        self._bound["rows"], self._count = self._upload("rows", rows), len(rows)
        for name, shape in self._shapes.items():
            new_shape = len(rows), *shape[1:]
            gathered = self._workspace.pool.allocate(f"the splats' {name}", 4 * math.prod(new_shape))
            moments = name.startswith(_MOMENTS)
            args = {"row": math.prod(shape[1:]), "copied": remaining if moments else len(rows)}
            args |= {"source": self._bound[name], "gathered": gathered}
            self._launch("gather_rows", math.prod(new_shape), args)
            self._bound[name], self._shapes[name] = gathered, new_shape
        self._splats_changed()

    def write(self, arrays: Mapping[str, np.ndarray], first: int) -> None:
        """Overwrite arrays of the state from row `first` to their end."""
        for name, array in arrays.items():
            array, offset = np.ascontiguousarray(array), first * 4 * math.prod(self._shapes[name][1:])
            if array.nbytes:
                cl.enqueue_copy(self._queue, self._bound[name], array, dst_offset=offset)

    def clear(self, names: Sequence[str]) -> None:
        """Fill arrays of the state with zeros."""
        for name in names:
            if size := 4 * math.prod(self._shapes[name]):
                cl.enqueue_fill_buffer(self._queue, self._bound[name], np.zeros(1, np.float32), 0, size)

    def _splats_changed(self) -> None:
        """Discard the command lists that depend on the buffers of the splats."""
        self._count, self._resident, self._version = self._shapes["means"][0], None, object()
        self._bound["axes"] = self._shapes["log_scales"][1]
        if math.prod(self._shapes["sh"]) >= 2**32:  # kernels count coefficients in 32 bits
            raise DeviceError(
                f"splats in training must have less than 2^32 SH coefficients, got {self._count:,} splats; "
                "use fewer"
            )

    def read(self, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Copy arrays of the state to the host; all by default."""
        arrays = {}
        for name in self._shapes if names is None else names:
            arrays[name] = np.empty(self._shapes[name], np.float32)
            cl.enqueue_copy(self._queue, arrays[name], self._bound[name])
        return arrays

    def resident(self, degree: int, origin: np.ndarray) -> ResidentArrays:
        """The splats in training as a cloud, with SH up to `degree`; it shares the buffers of the
        state and changes with them."""
        if self._resident is None or self._resident[0] != degree:
            count, rendered, stored = self._count, (degree + 1) ** 2, self._shapes["sh"][1]
            shared = degree > 0 and rendered == stored  # the coefficients are rendered as they are
            shapes = {"quats": 4, "scales": 2, "opacities": 1} | (
                {"thickness": 1} if self._bound["axes"] == 3 else {}
            )
            sizes = shapes | ({} if shared else {"sh": 3 * rendered})
            for name, floats in sizes.items():
                size = 4 * count * floats
                self._bound[f"activated_{name}"] = self._workspace.pool.allocate(f"the splats' {name}", size)
            if "thickness" not in shapes:  # not used
                self._bound["activated_thickness"] = self._bound["activated_scales"]
            self._bound |= {
                "rendered_coefficients": rendered,
                "stored_coefficients": stored,
                "as_rgb": int(degree == 0),
            }
            self._launch("activate", count)
            if shared:
                self._bound["activated_sh"] = self._bound["sh"]
            else:
                self._launch("activate_sh", 3 * count * rendered)
            buffers = {name: self._bound[f"activated_{name}"] for name in shapes}
            buffers["means"] = self._bound["means"]
            buffers["colors" if degree == 0 else "sh"] = self._bound["activated_sh"]
            self._resident, self._version = (degree, ResidentArrays(buffers, count, degree, origin)), object()
        return self._resident[1]

    def loss(
        self, images: Any, view: int, dssim_weight: float, exposed: bool = False
    ) -> tuple[Callable[[], tuple[float, float]], Any]:
        """Compare a frame with the ground truth of view number `view`. exposed: whether the view's refined
        exposure is applied to the frame first.

        Returns a function that waits for the loss and the mean squared difference, to be called before
        `max_pending_losses` more frames; and the gradient of the loss (h, w, 3), a device array that is valid
        until the next call.
        """
        rgb, (height, columns, _) = images.device_buffer("rgb")
        target, size, in_strips = self._targets[view], 3 * height * columns, self._lanes > 1
        exposure = {"exposed": int(exposed), "view_index": view, "rendered": rgb, "pixels": height * columns}
        if exposed and in_strips:
            rgb = self._scratch("exposed", 12 * height * columns)
        value_count, stride = target.values, self._stride(columns)
        grid = (-(-3 * columns // _PANEL), -(-height // _STRIP)) if in_strips else (_SUM_GROUPS,)
        if (groups := math.prod(grid)) not in self._readbacks:
            self._readbacks[groups] = LossReadback(self._workspace, groups)
        readback = self._readbacks[groups]
        slot, buffer = readback.next_slot()
        gradient = self._array("grad_rgb", (height, columns, 3))
        args = {
            **{"rgb": rgb, "target": target.image, "mask": target.mask, "masked": int(target.masked)},
            **{"l1_weight": (1 - dssim_weight) / value_count, "sums": buffer, "grad_rgb": gradient.data},
            **exposure,
        }

        def loss_launches() -> list[Launch]:
            values = args | {
                "ssim_weight": dssim_weight / size,
                **{"width": 3 * columns, "height": height, "stride": stride},
                **{"images": self._allocate_images(height, columns)},
                "image_stride": stride * (height + 2 * _MARGIN_ROWS),
            }
            if in_strips:
                kernels = "loss_strips", "loss_strips_backward"
                launches = [self._launch_of(kernel, grid, (1, 1), values) for kernel in kernels]
                if exposed:
                    sizes = (_EXPOSURE_GROUPS * _EXPOSURE_ITEMS,), (_EXPOSURE_ITEMS,), values
                    launches.insert(0, self._launch_of("apply_exposure", *sizes))
                    launches.append(self._launch_of("exposure_backward", *sizes))
                return launches
            launches = [self._row_launch("loss_load", 3 * columns, values, height)]
            for kernel in ("loss_rows", "loss_columns", "loss_rows_backward", "loss_columns_backward"):
                rows = -(-height // _ROWS_PER_ITEM) if "columns" in kernel else height
                launches.append(self._row_launch(kernel, 3 * columns, values, rows))
            items = (_SUM_GROUPS * _SUM_ITEMS,)
            return [*launches, self._launch_of("loss_sums", items, (_SUM_ITEMS,), values)]

        events = self._replay("loss", (height, columns, dssim_weight, exposed), args, loss_launches)
        readback.submitted(slot, events[int(exposed) if in_strips else -1])

        def value() -> tuple[float, float]:
            self._queue.flush()
            with self._workspace.device_errors("training"):
                absolute, squared, ssim = readback.read(slot)
            loss = (1 - dssim_weight) * absolute / value_count + dssim_weight * (1 - ssim / size)
            return float(loss), float(squared / value_count)

        return value, gradient

    def normal_loss_gradients(self, images: Any, view: int, weight: float) -> dict[str, Any]:
        """Gradients of `train.losses.normal_loss` with respect to `depth` and `normal`, times the weight;
        device arrays that are valid until the next call."""
        depth, target = images.device_array("depth"), self._targets[view]
        height, width = depth.shape
        shapes = {"depth": (height, width), "normal": (height, width, 3)}
        results = {name: self._array(f"grad {name}", shape) for name, shape in shapes.items()}
        args = {
            **{"width": width, "height": height, "mask": target.mask, "masked": int(target.masked)},
            "view_index": view,
            **{name: images.device_array(name).data for name in ("depth", "normal", "alpha")},
            **{f"grad_{name}": array.data for name, array in results.items()},
            "normal_weight": weight / (width * height),
            "differences": self._scratch("differences", 24 * width * height),
        }
        for kernel in ("surface_normals", "surface_depths"):
            self._enqueue(self._row_launch(kernel, width, args, height))
        return results

    def accumulate_statistics(self, gradients: Any) -> None:
        """Add a frame's `grad2d` and visibility to the statistics. gradients: result of
        `backward_per_tile`."""
        args = dict.fromkeys(_STEP_NUMBERS, 0.0) | {"update": 0, "sparse": 0, "add_statistics": 1}
        self._step(gradients, args, None if self._refinement is None else _NO_VIEW_STEP)

    def step(
        self,
        gradients: Any,
        learning_rates: Mapping[str, float],
        hyperparameters: Mapping[str, float],
        statistics: bool,
        view_step: Mapping[str, Any] | None = None,
    ) -> None:
        """Apply a step of Adam.

        Args:
            gradients: the result of `GradientPipeline.backward_per_tile`.
            learning_rates: of `means`, `scales`, `quats`, `logits`, `sh` (degree 0), `rest` (higher degrees).
            hyperparameters: `beta1`, `beta2`, `epsilon`, `sqrt_correction2` (square root of 1 - beta2^step);
                `scale_penalty` and `opacity_penalty`, added to the gradients; `sparse`: 1 to update only
                splats that contribute to the frame.
            statistics: whether statistics are accumulated first.
            view_step: numbers of the kernel `refine_view`; None: the view is not refined.
        """
        args = {f"lr_{name}": rate for name, rate in learning_rates.items()} | dict(hyperparameters)
        args |= {
            "one_minus_beta1": 1 - hyperparameters["beta1"],
            "one_minus_beta2": 1 - hyperparameters["beta2"],
        }
        args |= {"update": 1, "sparse": int(hyperparameters["sparse"]), "add_statistics": int(statistics)}
        self._step(gradients, args, view_step)

    def _step(self, gradients: Any, args: Mapping[str, Any], view_step: Mapping[str, Any] | None) -> None:
        # compiling takes seconds: it is first, so that an interrupt leaves the statistics unchanged
        gradients.pipeline.compile_step(view_step is not None)
        if view_step is None or self._refinement is None:
            gradients.step(args, self._bound, self._version)
            return
        next_record = self._refinement.device_records[view_step["next_view"]]
        gradients.step({**args, **view_step}, self._bound, self._version, next_record)

    def load_refinement(
        self,
        arrays: Mapping[str, np.ndarray],
        views: Sequence[View],
        rows: Sequence[int],
        depths: Sequence[float],
        settings: Mapping[str, Any],
    ) -> None:
        """Copy the state of `ViewRefinement` to the device.

        Args:
            views: uniforms of the training views.
            rows: row of `intrinsics` of each view.
            depths: depth of the point about which each camera rotates.
            settings: arguments of the kernel `refine_view` that are equal in all steps.
        """
        self._refinement = OpenCLViewRefinement(self._workspace, arrays, views, rows, self._bound)
        groups = _EXPOSURE_GROUPS if self._lanes > 1 else _SUM_GROUPS
        sums = self._workspace.pool.allocate("the exposures' sums", 24 * groups)
        depth_buffer = self._upload("the views' depths", np.array(depths, np.float32))
        self._bound |= {"exposure_groups": groups, "exposure_sums": sums, "depths": depth_buffer, **settings}
        self._version = object()

    def read_refinement(self) -> dict[str, np.ndarray]:
        """Copy the state of `ViewRefinement` to the host; waits for the device."""
        assert self._refinement is not None
        with self._workspace.device_errors("training"):
            return self._refinement.read()

    def refined_view(self, pipeline: Any, view: View, number: int) -> View:
        """The view with the refined camera of training view `number`."""
        assert self._refinement is not None
        return self._refinement.refined(view, number, pipeline.source.records["View"])

    def refine_intrinsics(self, gradients: Any, args: Mapping[str, Any], views: int) -> None:
        """Apply a step of Adam to a row of the intrinsics, between two steps."""
        program, size = gradients.pipeline.step_commands[True].program, (_GROUP,)
        kernel, args = "refine_intrinsics", {**args, "count": views}
        self._replay(kernel, (), args, lambda: [self._launch_of(kernel, size, size, args, program)], program)

    def centre_exposures(self, views: int) -> None:
        """Set the means of the exposures over the views to 0."""
        kernel, args = "centre_exposures", {"count": views}
        self._replay(kernel, (), args, lambda: [self._launch_of(kernel, (6,), (6,), args)])

    def add_noise(self, size: float, slope: float, threshold: float, words: Sequence[int]) -> None:
        """Add MCMC noise to the means: steps size * sigmoid(slope (threshold - opacity)) * covariance *
        standard normal sample, in the plane of a disk. words: seed (low, high), iteration, random stream."""
        names = ("seed_low", "seed_high", "iteration", "random_stream")
        args = {"size": size, "slope": slope, "threshold": threshold, **dict(zip(names, words, strict=True))}
        self._launch("add_position_noise", self._count, args)

    @property
    def _queue(self) -> cl.CommandQueue:
        """The queue of differentiable frames, ordered after all work on other queues."""
        return self._workspace.switch_to(self._workspace.queue)

    def _launch(self, kernel: str, items: int, args: Mapping[str, Any] | None = None) -> None:
        self._enqueue(self._row_launch(kernel, items, args or {}))

    def _row_launch(self, kernel: str, items: int, args: Mapping[str, Any], rows: int = 0) -> Launch:
        """A launch with at least `items` work-items, for each of `rows` rows if given."""
        width = max(_GROUP, -(-items // _GROUP) * _GROUP)
        return self._launch_of(
            kernel, (width, rows) if rows else (width,), (_GROUP, 1) if rows else (_GROUP,), args
        )

    def _launch_of(
        self,
        kernel: str,
        size: tuple[int, ...],
        group: tuple[int, ...],
        args: Mapping[str, Any],
        program: Program | None = None,
    ) -> Launch:
        """A launch with the values of its arguments, which is not submitted."""
        values = {**self._bound, "count": self._count, **args}
        names = (program or self._program).source.arguments[kernel]
        return kernel, size, group, [values[name] for name in names]

    def _enqueue(self, launch: Launch) -> None:
        with self._workspace.device_errors("training"):
            self._commands.clear()
            self._commands.launch(self._queue, *launch)

    def _replay(
        self,
        name: str,
        key: tuple[Any, ...],
        args: Mapping[str, Any],
        launches: Callable[[], list[Launch]],
        program: Program | None = None,
    ) -> list[cl.Event]:
        """Replay a command list of a training step with the arguments `args`. launches: returns the
        launches; called to record again if the key, the splats, the buffers or the program have changed.
        program: of the kernels; None: the program of the training kernels."""
        program = program or self._program
        commands = self._replayed.get(name)
        if commands is None or commands.program is not program:
            commands = self._replayed[name] = CommandList(program)
        key = (*key, self._version, self._workspace.pool.generation)
        with self._workspace.device_errors("training"):
            if commands.key != key:
                commands.clear()
                for launch in launches():
                    commands.record(*launch)
                commands.key = key
            commands.set(args)
            return commands.submit(self._queue)

    def _upload(self, what: str, array: np.ndarray) -> cl.Buffer:
        array = np.ascontiguousarray(array)
        buffer = self._workspace.pool.allocate(what, array.nbytes)
        if array.nbytes:
            cl.enqueue_copy(self._queue, buffer, array)
        return buffer

    def _scratch(self, name: str, size: int) -> cl.Buffer:
        return self._workspace.pool.scratch(f"training: {name}", size)

    def _array(self, name: str, shape: tuple[int, ...]) -> Array:
        return self._workspace.pool.array(self._queue, f"training: {name}", shape)

    def _stride(self, columns: int) -> int:
        return -(-3 * columns // self._lanes) * self._lanes + 2 * _MARGIN

    def _allocate_images(self, height: int, columns: int) -> cl.Buffer:
        """Zero-filled images of the loss for frames of this size; kernels leave the margins zero."""
        if self._loss_images is not None and self._loss_images[0] == (height, columns):
            return self._loss_images[1]
        size = 4 * (11 if self._lanes == 1 else 3) * self._stride(columns) * (height + 2 * _MARGIN_ROWS)
        self._loss_images = None  # release the old images first
        buffer = self._workspace.pool.allocate("the loss's images", size)
        cl.enqueue_fill_buffer(self._queue, buffer, np.zeros(1, np.float32), 0, size)
        self._loss_images = (height, columns), buffer
        return buffer
