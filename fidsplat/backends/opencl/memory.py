"""Device buffers: clouds that stay, and a pool of scratch buffers that frames share."""

from __future__ import annotations

import weakref
from collections.abc import Hashable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.planes import PlaneTable
from fidsplat.errors import DeviceError
from fidsplat.harmonics import C0
from fidsplat.splats import SplatCloud

if TYPE_CHECKING:
    from fidsplat.backends.opencl.backend import OpenCLBackend


_LEAST = 16  # bytes; OpenCL has no empty buffers


class DeviceBuffer(cl.Buffer):
    """A buffer with a token of its own: to remember that is not to keep the buffer."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.token = object()


class BufferPool:
    """Scratch buffers by name, kept from frame to frame and replaced only when one is too small."""

    def __init__(self, context: cl.Context, device: cl.Device) -> None:
        self._context = context
        self._device = device
        self._buffers: dict[str, cl.Buffer] = {}
        self._contents: dict[str, weakref.ref[np.ndarray]] = {}
        self._spare: dict[str, list[cl.Buffer]] = {}
        self._kind: Hashable = None

    def size(self, name: str) -> int:
        """Bytes of the scratch buffer of that name; 0 if there is none yet."""
        return self._buffers[name].size if name in self._buffers else 0

    def lease(self, name: str, size: int) -> cl.Buffer:
        """A buffer for somebody who gives it back (`give_back`) when it is not needed any more."""
        # taken before it is looked at: planes that die meanwhile may give back others
        spare = self._spare.get(name, [])
        while spare:
            buffer = spare.pop()
            if buffer.size == max(size, _LEAST):
                return buffer  # else it was of a picture of another size
        return self.fresh(name, size)

    def give_back(self, buffers: list[tuple[str, cl.Buffer]]) -> None:
        """Keeps one or two leased buffers of a name for the next picture of the same size."""
        for name, buffer in buffers:
            spare = self._spare.setdefault(name, [])
            if not spare or (len(spare) == 1 and spare[0].size == buffer.size):
                spare.append(buffer)

    @property
    def memory_bytes(self) -> int:
        """What the scratch buffers hold, and leased ones that were given back."""
        spare = (buffer for buffers in self._spare.values() for buffer in buffers)
        return sum(buffer.size for buffer in (*self._buffers.values(), *spare))

    def make_way(self, kind: Hashable, size: int) -> None:
        """Before a picture: lets go of what pictures of another kind have left, if that is more than `size`
        bytes. Pictures of one kind take buffers of the same sizes."""
        if kind != self._kind and self.memory_bytes > size:
            self.clear()
        self._kind = kind

    def clear(self) -> None:
        """Lets go of all that it holds."""
        self._spare.clear()
        self._buffers.clear()
        self._contents.clear()

    def holding(self, name: str, array: np.ndarray) -> cl.Buffer | None:
        """The scratch buffer of that name, if what it has still is this array (`now_holds`)."""
        content = self._contents.get(name)
        return self._buffers[name] if content is not None and content() is array else None

    def now_holds(self, name: str, array: np.ndarray) -> None:
        """Remembers that the scratch buffer of that name has this array, if the array stays as it is."""
        if not array.flags.writeable and array.flags.owndata:
            self._contents[name] = weakref.ref(array)

    def scratch(self, name: str, size: int) -> cl.Buffer:
        """A buffer of at least `size` bytes whose content is undefined."""
        self._contents.pop(name, None)
        held = self._buffers.get(name)
        if held is None or held.size < size:
            self._buffers.pop(name, None)
            held = self._buffers[name] = self.fresh(name, size)
        return held

    def fresh(self, name: str, size: int) -> cl.Buffer:
        """A buffer that nobody else holds.

        Raises:
            DeviceError: the device cannot give that much at once.
        """
        limit = self._device.max_mem_alloc_size
        if size > limit:
            raise DeviceError(
                f"{name} needs {size / 2**20:.0f} MiB in one piece, but {self._device.name.strip()} gives at "
                f"most {limit / 2**20:.0f} MiB; use fewer splats or a smaller picture"
            )
        try:
            return DeviceBuffer(self._context, cl.mem_flags.READ_WRITE, max(size, _LEAST))
        except cl.Error as error:
            raise DeviceError(f"no memory for {name} ({size / 2**20:.0f} MiB): {error}") from error


class Resident:
    """A SplatCloud on the device. SH of degree 0 does not depend on the view and becomes plain colours.

    A CPU reads the cloud's own arrays, without a copy. On other devices they are copied, labels and colours
    when a picture first asks for them, or, where they would take more than half of the memory budget, a chunk
    at a time for every picture (`streamed`).
    """

    def __init__(self, backend: OpenCLBackend, cloud: SplatCloud) -> None:
        self._backend = backend
        self.count = len(cloud)
        self.origin = cloud.origin
        self.sh_degree = cloud.sh_degree if cloud.sh_degree > 0 else -1
        self.has_planes = cloud.planes is not None
        self.footprint = cloud.footprint
        self.planes = PlaneTable(cloud) if self.has_planes else None
        self._arrays = {
            "means": cloud.means,
            "quats": cloud.quats,
            "scales": cloud.scales,
            "opacities": cloud.opacities,
            "labels": cloud.labels,
        }
        if self.planes is not None:
            self._arrays["planes"] = self.planes.index
        if cloud.boxes is not None:
            self._arrays["boxes"] = cloud.boxes.astype(np.int32)
        if cloud.colors is not None:
            self._arrays["colors"] = cloud.colors
        elif cloud.sh is not None:  # always: a cloud has one of the two
            degree_0 = np.maximum(np.float32(C0) * cloud.sh[:, 0, :] + np.float32(0.5), 0)
            self._arrays |= {"sh": cloud.sh} if self.sh_degree > 0 else {"colors": degree_0}
        self._buffers: dict[str, cl.Buffer] = {}
        total = self.count * self._bytes_of(self._arrays)
        widest = max(array.nbytes for array in self._arrays.values())
        device = backend.device
        self._shared = backend.info.kind == "cpu" and bool(device.host_unified_memory)
        self.streamed = not self._shared and (
            total > backend.memory_budget // 2 or widest > device.max_mem_alloc_size
        )
        if not self._shared and not self.streamed:
            try:
                for name in self._arrays.keys() - {"labels", "colors", "sh"}:
                    self._whole(name)
                backend.queue.finish()
            except cl.Error as error:
                raise DeviceError(f"{backend.info.title} failed while taking the cloud: {error}") from error

    def _bytes_of(self, names: Iterable[str]) -> int:
        """Bytes of a splat in these arrays."""
        return sum(self._array(name).nbytes // max(self.count, 1) for name in names)

    def bytes_for(self, names: Iterable[str]) -> tuple[int, int]:
        """What a picture that asks for these arrays makes of the cloud: bytes that stay on the device, and
        bytes per splat that each picture copies there."""
        if self._shared:
            return 0, 0
        if self.streamed:
            return 0, self._bytes_of(names)
        return self.count * self._bytes_of({*names, *self._buffers}), 0

    @property
    def memory_bytes(self) -> int:
        """Bytes that the cloud holds on the device; a CPU's are the host's."""
        return 0 if self._shared else sum(buffer.size for buffer in self._buffers.values())

    def part(self, name: str, first: int, end: int) -> cl.Buffer:
        """The array of splats [first, end)."""
        if self.streamed:
            piece = np.ascontiguousarray(self._array(name)[first:end])
            buffer = self._backend.pool.scratch(f"chunk of {name}", piece.nbytes)
            cl.enqueue_copy(self._backend.queue, buffer, piece)
            return buffer
        whole = self._whole(name)
        if end - first == self.count:
            return whole
        row = self._array(name).nbytes // self.count
        return whole.get_sub_region(first * row, (end - first) * row)

    def _array(self, name: str) -> np.ndarray:
        """The array on the host; ids are made when a picture first asks for them."""
        if name == "splat_ids" and name not in self._arrays:
            self._arrays[name] = np.arange(self.count, dtype=np.int32)
        return self._arrays[name]

    def _whole(self, name: str) -> cl.Buffer:
        if name not in self._buffers:
            array = np.ascontiguousarray(self._array(name))
            flags = cl.mem_flags
            if array.size == 0:
                buffer = self._backend.pool.fresh(f"the cloud's {name}", 16)
            elif self._shared:
                flags = flags.READ_ONLY | flags.USE_HOST_PTR
                buffer = DeviceBuffer(self._backend.context, flags, hostbuf=array)
            else:
                buffer = self._backend.pool.fresh(f"the cloud's {name}", array.nbytes)
                cl.enqueue_copy(self._backend.queue, buffer, array)
            self._buffers[name] = buffer
        return self._buffers[name]
