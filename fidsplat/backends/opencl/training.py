"""The work of a training step around the picture, in kernels: no array of splats or pixels passes through the
host."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from fidsplat.backends.interface import ResidentData, TrainingKernels
from fidsplat.backends.opencl.assemble import assemble_training
from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.loss_readback import SLOTS, LossReadback
from fidsplat.backends.opencl.program import Program
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.cameras import Camera
from fidsplat.util.errors import DeviceError

_GROUP = 64
_MARGIN, _MARGIN_ROWS = 16, 5
"""zeros around an image: floats of a row, and rows"""
_PANEL, _STRIP = 128, 64
"""values of a row, and rows, of a work-item on CPUs (kernels/opencl/train/loss_strips.cl)"""
_SUMS, _SUMMED = 512, 128
"""work-groups that add up the loss, and their work-items (SUM_ITEMS of kernels/opencl/train/loss.cl)"""
_EACH_ROWS = 4
"""that a work-item of its passes over columns takes (EACH_ROWS there)"""
_REMEMBERED = ("first_", "second_")
_STEP_NUMBERS = (
    *("beta1", "beta2", "rest1", "rest2", "root", "epsilon", "scale_penalty", "opacity_penalty"),
    *(f"size_{name}" for name in ("means", "scales", "quats", "logits", "sh", "rest")),
)
"""of a step of Adam (kernels/opencl/project_step.cl)"""


class _Truth(NamedTuple):
    """A view's picture on the device."""

    picture: cl.Buffer
    mask: cl.Buffer
    masked: bool
    counted: int
    """values that matter"""


Launch: TypeAlias = tuple[str, tuple[int, ...], tuple[int, ...], list[Any]]
"""kernel, size, work-group, and values of the arguments"""


class ResidentArrays(ResidentData):
    """Splats in arrays of the device, as pictures read them: disks without labels and planes."""

    has_coplanar_groups, footprint, ellipsoids, group_table = False, "gaussian", "none", None
    streamed = immutable = coherent = False

    def __init__(
        self, buffers: Mapping[str, cl.Buffer], count: int, sh_degree: int, origin: np.ndarray
    ) -> None:
        self._buffers, self.count, self.origin = dict(buffers), count, origin
        self.capacity, self.buffer_key = count, None
        self.sh_degree = sh_degree
        self.cached_frames: dict[Hashable, Any] = {}

    @property
    def memory_bytes(self) -> int:
        """Bytes that the arrays hold."""
        return sum(buffer.size for buffer in self._buffers.values())

    def bytes_for(self, names: Any) -> tuple[int, int]:
        """As `Resident.bytes_for`: all of them stay."""
        return self.memory_bytes, 0

    def part(self, name: str, first: int, end: int) -> cl.Buffer:
        """The array of splats [first, end)."""
        whole = self._buffers[name]
        if end - first == self.count:
            return whole
        row = whole.size // self.count
        return whole.get_sub_region(first * row, (end - first) * row)


class OpenCLTraining(TrainingKernels):
    """Training kernels of an OpenCL device."""

    late = SLOTS // 2 - 1  # a picture may be compared twice

    def __init__(self, workspace: Workspace, lanes: int = 0) -> None:
        """lanes: of vectors, in place of the device's own (tests)."""
        self._workspace = workspace
        lanes = lanes or (workspace.shape.lanes if workspace.shape.schedule == "lanes" else 1)
        self._lanes = lanes
        source = assemble_training(lanes, workspace.info.float64, workspace.shape.fast_fma)
        self._program = Program(workspace, source)
        self._commands = CommandList(self._program)
        """of kernels that are launched once"""
        self._held: dict[str, Any] = {}
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._count = 0
        self._drawn: tuple[int, ResidentArrays] | None = None
        self._truths: list[_Truth] = []
        self._loss_images: tuple[tuple[int, int], cl.Buffer] | None = None
        self._sums: dict[int, LossReadback] = {}
        """by numbers of work-groups"""
        self._version = object()
        """another one whenever splats are held in other buffers"""
        self._replayed: dict[str, CommandList] = {}
        """command lists of a step, by name"""
        self._sights: WeakKeyDictionary[Camera, tuple[np.ndarray, dict[str, float]]] = WeakKeyDictionary()
        """numbers by which kernels know what a camera sees, each with the origin that they are of"""

    def take_views(self, views: Sequence[tuple[np.ndarray, np.ndarray | None]]) -> None:
        """As `TrainingKernels`."""
        for picture, mask in views:
            kept = np.zeros(1, np.uint8) if mask is None else mask.astype(np.uint8)
            counted = picture.size if mask is None else max(1, 3 * int(kept.sum()))
            buffers = self._put("a picture", picture), self._put("a mask", kept)
            self._truths.append(_Truth(*buffers, mask is not None, counted))

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """As `TrainingKernels`."""
        for name, array in arrays.items():
            self._held[name] = self._put(f"the splats' {name}", array)
            self._shapes[name] = array.shape
        self._begin()

    def pick(self, rows: np.ndarray, kept: int) -> None:
        """As `TrainingKernels`."""
        self._held["rows"], self._count = self._put("rows", rows), len(rows)
        for name, shape in self._shapes.items():
            made = len(rows), *shape[1:]
            picked = self._workspace.pool.fresh(f"the splats' {name}", 4 * math.prod(made))
            remembered = name.startswith(_REMEMBERED)
            given = {"row": math.prod(shape[1:]), "copied": kept if remembered else len(rows)}
            self._launch(
                "gather_rows", math.prod(made), given | {"source": self._held[name], "gathered": picked}
            )
            self._held[name], self._shapes[name] = picked, made
        self._begin()

    def write(self, arrays: Mapping[str, np.ndarray], first: int) -> None:
        """As `TrainingKernels`."""
        for name, array in arrays.items():
            above = first * 4 * math.prod(self._shapes[name][1:])
            if array.nbytes:
                cl.enqueue_copy(self._queue, self._held[name], np.ascontiguousarray(array), dst_offset=above)

    def clear(self, names: Sequence[str]) -> None:
        """As `TrainingKernels`."""
        for name in names:
            if size := 4 * math.prod(self._shapes[name]):
                cl.enqueue_fill_buffer(self._queue, self._held[name], np.zeros(1, np.float32), 0, size)

    def _begin(self) -> None:
        """Other splats are there."""
        self._count, self._drawn, self._version = self._shapes["means"][0], None, object()
        if math.prod(self._shapes["sh"]) >= 2**32:  # kernels count coefficients in 32 bits
            raise DeviceError(f"{self._count:,} splats are too many to train; use fewer")

    def store(self, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """As `TrainingKernels`."""
        found = {}
        for name in self._shapes if names is None else names:
            found[name] = np.empty(self._shapes[name], np.float32)
            cl.enqueue_copy(self._queue, found[name], self._held[name])
        return found

    def resident(self, degree: int, origin: np.ndarray) -> ResidentArrays:
        """As `TrainingKernels`."""
        if self._drawn is None or self._drawn[0] != degree:
            count, drawn, every = self._count, (degree + 1) ** 2, self._shapes["sh"][1]
            itself = degree > 0 and drawn == every  # what is drawn is the values themselves
            sizes = {"quats": 4, "scales": 2, "opacities": 1} | ({} if itself else {"sh": 3 * drawn})
            for name, floats in sizes.items():
                size = 4 * count * floats
                self._held[f"activated_{name}"] = self._workspace.pool.fresh(f"the splats' {name}", size)
            self._held |= {"rendered": drawn, "all": every, "plain": int(degree == 0)}
            self._launch("activate", count)
            if itself:
                self._held["activated_sh"] = self._held["sh"]
            else:
                self._launch("activate_sh", 3 * count * drawn)
            buffers = {name: self._held[f"activated_{name}"] for name in ("quats", "scales", "opacities")}
            buffers["means"] = self._held["means"]
            buffers["colors" if degree == 0 else "sh"] = self._held["activated_sh"]
            self._drawn, self._version = (degree, ResidentArrays(buffers, count, degree, origin)), object()
        return self._drawn[1]

    def loss(
        self, images: Any, view: int, dssim_weight: float
    ) -> tuple[Callable[[], tuple[float, float]], Any]:
        """As `TrainingKernels`."""
        rgb, (height, columns, _) = images.device_buffer("rgb")
        truth, size, strided = self._truths[view], 3 * height * columns, self._lanes > 1
        number, stride = truth.counted, self._stride(columns)
        grid = (-(-3 * columns // _PANEL), -(-height // _STRIP)) if strided else (_SUMS,)
        sums = self._sums_of(math.prod(grid))
        slot, room = sums.take()
        slope = self._array("by_rgb", (height, columns, 3))
        given = {
            **{"rgb": rgb, "target": truth.picture, "mask": truth.mask, "masked": int(truth.masked)},
            **{"l1_share": (1 - dssim_weight) / number, "sums": room, "by_rgb": slope.data},
        }

        def launches() -> list[Launch]:
            every = given | {
                "ssim_share": dssim_weight / size,
                **{"width": 3 * columns, "height": height, "stride": stride},
                **{"images": self._room_for_images(height, columns)},
                "image_stride": stride * (height + 2 * _MARGIN_ROWS),
            }
            if strided:
                kernels = "loss_strips", "loss_strips_backward"
                return [self._one(kernel, grid, (1, 1), every) for kernel in kernels]
            row = [self._of_rows("loss_take", 3 * columns, height, every)]
            for kernel in ("loss_rows", "loss_columns", "loss_rows_backward", "loss_columns_backward"):
                each = _EACH_ROWS if "columns" in kernel else 1
                row.append(self._of_rows(kernel, 3 * columns, -(-height // each), every))
            return [*row, self._one("loss_sums", (_SUMS * _SUMMED,), (_SUMMED,), every)]

        events = self._replay("loss", (height, columns, dssim_weight), given, launches)
        sums.submitted(slot, events[0 if strided else -1])

        def value() -> tuple[float, float]:
            self._queue.flush()
            with self._workspace.failing("training"):
                absolute, squared, similar = sums.read(slot)
            loss = (1 - dssim_weight) * absolute / number + dssim_weight * (1 - similar / size)
            return float(loss), float(squared / number)

        return value, slope

    def surface(self, images: Any, view: int, camera: Camera, weight: float) -> dict[str, Any]:
        """As `TrainingKernels`."""
        depth, truth = images.device_array("depth"), self._truths[view]
        height, width = depth.shape
        shapes = {"depth": (height, width), "normal": (height, width, 3)}
        found = {name: self._array(f"by {name}", shape) for name, shape in shapes.items()}
        given = {
            **{"width": width, "height": height, "mask": truth.mask, "masked": int(truth.masked)},
            **{"inverse_x": 1 / camera.fx, "inverse_y": 1 / camera.fy},
            **{"middle_x": camera.cx, "middle_y": camera.cy},
            **{name: images.device_array(name).data for name in ("depth", "normal", "alpha")},
            **{f"by_{name}": array.data for name, array in found.items()},
            "normal_share": weight / (width * height),
            "differences": self._scratch("differences", 24 * width * height),
        }
        self._launch_rows("surface_normals", width, height, given)
        self._launch_rows("surface_depths", width, height, given)
        return found

    def count(self, taken: Any, camera: Camera, origin: np.ndarray) -> None:
        """As `TrainingKernels`."""
        self._step(taken, dict.fromkeys(_STEP_NUMBERS, 0.0) | {"move": 0, "sparse": 0}, camera, origin)

    def step(
        self,
        taken: Any,
        sizes: Mapping[str, float],
        numbers: Mapping[str, float],
        camera: Camera | None,
        origin: np.ndarray,
    ) -> None:
        """As `TrainingKernels`."""
        given = {f"size_{name}": size for name, size in sizes.items()} | dict(numbers)
        given |= {"rest1": 1 - numbers["beta1"], "rest2": 1 - numbers["beta2"]}
        self._step(taken, given | {"move": 1, "sparse": int(numbers["sparse"])}, camera, origin)

    def _step(self, taken: Any, given: Mapping[str, Any], camera: Camera | None, origin: np.ndarray) -> None:
        taken.compile_step()  # takes seconds once: an interrupt there finds nobody counted
        if camera is not None:
            self._seen(camera, origin)
        taken.step({**self._held, **given, "counted": int(camera is not None)})

    def _seen(self, camera: Camera, origin: np.ndarray) -> None:
        """Counts who is seen, as splats are before the step."""
        if (known := self._sights.get(camera)) is None or known[0] is not origin:
            known = self._sights[camera] = origin, _sight(camera, origin)
        given = known[1]
        self._replay("count", (), given, lambda: [self._items("count_visible", self._count, given)])

    def shake(self, size: float, steep: float, clear: float, words: Sequence[int]) -> None:
        """As `TrainingKernels`."""
        names = ("seed_low", "seed_high", "iteration", "purpose")
        given = {"size": size, "slope": steep, "threshold": clear, **dict(zip(names, words, strict=True))}
        self._launch("add_position_noise", self._count, given)

    @property
    def _queue(self) -> cl.CommandQueue:
        """The queue on which pictures with derivatives are drawn, after all that is on others."""
        return self._workspace.switch_to(self._workspace.queue)

    def _launch(self, kernel: str, items: int, given: Mapping[str, Any] | None = None) -> None:
        self._enqueue(self._items(kernel, items, given or {}))

    def _launch_rows(self, kernel: str, items: int, rows: int, given: Mapping[str, Any]) -> None:
        self._enqueue(self._of_rows(kernel, items, rows, given))

    def _items(self, kernel: str, items: int, given: Mapping[str, Any]) -> Launch:
        return self._one(kernel, (max(_GROUP, -(-items // _GROUP) * _GROUP),), (_GROUP,), given)

    def _of_rows(self, kernel: str, items: int, rows: int, given: Mapping[str, Any]) -> Launch:
        return self._one(kernel, (max(_GROUP, -(-items // _GROUP) * _GROUP), rows), (_GROUP, 1), given)

    def _one(
        self, kernel: str, size: tuple[int, ...], group: tuple[int, ...], given: Mapping[str, Any]
    ) -> Launch:
        """A launch: arguments are given here, or held."""
        every = {**self._held, "count": self._count, **given}
        return kernel, size, group, [every[one.name] for one in self._program.source.arguments[kernel]]

    def _enqueue(self, launch: Launch) -> None:
        with self._workspace.failing("training"):
            self._commands.clear()
            self._commands.launch(self._queue, *launch)

    def _replay(
        self,
        name: str,
        key: tuple[Any, ...],
        given: Mapping[str, Any],
        launches: Callable[[], list[Launch]],
    ) -> list[cl.Event]:
        """Submit a part of a step: replayed, if it differs from that of the last step in `given` only.

        launches: called to record them, if the key, the splats or the buffers have changed.
        """
        commands = self._replayed.setdefault(name, CommandList(self._program))
        key = (*key, self._version, self._workspace.pool.state)
        with self._workspace.failing("training"):
            if commands.key != key:
                commands.clear()
                for launch in launches():
                    commands.record(*launch)
                commands.key = key
            commands.set(given)
            return commands.submit(self._queue)

    def _put(self, what: str, array: np.ndarray) -> cl.Buffer:
        array = np.ascontiguousarray(array)
        buffer = self._workspace.pool.fresh(what, array.nbytes)
        if array.nbytes:
            cl.enqueue_copy(self._queue, buffer, array)
        return buffer

    def _scratch(self, name: str, size: int) -> cl.Buffer:
        return self._workspace.pool.scratch(f"training: {name}", size)

    def _array(self, name: str, shape: tuple[int, ...]) -> Array:
        return self._workspace.pool.array(self._queue, f"training: {name}", shape)

    def _sums_of(self, groups: int) -> LossReadback:
        if groups not in self._sums:
            self._sums[groups] = LossReadback(self._workspace, groups)
        return self._sums[groups]

    def _stride(self, columns: int) -> int:
        return -(-3 * columns // self._lanes) * self._lanes + 2 * _MARGIN

    def _room_for_images(self, height: int, columns: int) -> cl.Buffer:
        """Images for pictures of this size, all zeros at first: kernels leave the margins so."""
        if self._loss_images is not None and self._loss_images[0] == (height, columns):
            return self._loss_images[1]
        size = 4 * (11 if self._lanes == 1 else 3) * self._stride(columns) * (height + 2 * _MARGIN_ROWS)
        self._loss_images = None  # the old ones go first
        buffer = self._workspace.pool.fresh("the loss's images", size)
        cl.enqueue_fill_buffer(self._queue, buffer, np.zeros(1, np.float32), 0, size)
        self._loss_images = (height, columns), buffer
        return buffer


def _sight(camera: Camera, origin: np.ndarray) -> dict[str, float]:
    """Arguments of the kernel `count_visible`."""
    turn = camera.world_to_camera[:3, :3]
    names = [f"rotation_{i}{j}" for i in range(3) for j in range(3)]
    given = dict(zip(names, turn.ravel().tolist(), strict=True))
    move = turn @ (origin - camera.position)
    given |= dict(zip(("translation_x", "translation_y", "translation_z"), move.tolist(), strict=True))
    given |= {"focal_x": camera.fx, "focal_y": camera.fy, "center_x": camera.cx, "center_y": camera.cy}
    return given | {"near": camera.near, "width": camera.width, "height": camera.height}
