"""Device buffers: clouds that stay, and a pool of scratch buffers that frames share."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from fidsplat.backends.planes import PlaneTable
from fidsplat.errors import DeviceError
from fidsplat.harmonics import C0
from fidsplat.splats import SplatCloud


class BufferPool:
    """Scratch buffers by name, kept from frame to frame and replaced only when one is too small."""

    def __init__(self, context: cl.Context, device: cl.Device) -> None:
        self._context = context
        self._device = device
        self._buffers: dict[str, cl.Buffer] = {}

    def scratch(self, name: str, size: int) -> cl.Buffer:
        """A buffer of at least `size` bytes whose content is undefined."""
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
            return cl.Buffer(self._context, cl.mem_flags.READ_WRITE, max(size, 16))
        except cl.Error as error:
            raise DeviceError(f"no memory for {name} ({size / 2**20:.0f} MiB): {error}") from error


class Resident:
    """A SplatCloud on the device. SH of degree 0 does not depend on the view and becomes plain colours."""

    def __init__(
        self, context: cl.Context, queue: cl.CommandQueue, pool: BufferPool, cloud: SplatCloud
    ) -> None:
        self.count = len(cloud)
        self.origin = cloud.origin
        self.sh_degree = cloud.sh_degree if cloud.sh_degree > 0 else -1
        self.has_planes = cloud.planes is not None
        self.planes = PlaneTable(cloud) if self.has_planes else None
        arrays = {
            "means": cloud.means,
            "quats": cloud.quats,
            "scales": cloud.scales,
            "opacities": cloud.opacities,
            "labels": cloud.labels,
        }
        if self.planes is not None:
            arrays["planes"] = self.planes.index
        if cloud.colors is not None:
            arrays["colors"] = cloud.colors
        elif cloud.sh is not None:  # always: a cloud has one of the two
            degree_0 = np.maximum(np.float32(C0) * cloud.sh[:, 0, :] + np.float32(0.5), 0)
            arrays |= {"sh": cloud.sh} if self.sh_degree > 0 else {"colors": degree_0}
        self.buffers: dict[str, cl.Buffer] = {}
        for name, array in arrays.items():
            self.buffers[name] = buffer = pool.fresh(f"the cloud's {name}", array.nbytes)
            if array.nbytes:
                cl.enqueue_copy(queue, buffer, np.ascontiguousarray(array))
        queue.finish()
