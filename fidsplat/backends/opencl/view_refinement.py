"""Refined cameras and exposures of training views in device memory.

A frame copies the record View of its camera from device memory (`DeviceRecord`), and kernels update the
record after the backward pass. The host reads the state only for reports and checkpoints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.opencl.buffers import DeviceRecord
from fidsplat.backends.opencl.uniforms import view_records
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.view import View

_REALS = ("pose_moments", "intrinsics", "intrinsics_sums", "intrinsics_moments", "exposure_moments")
"""arrays in the precision of the projection"""


class OpenCLViewRefinement:
    """The arrays of `ViewRefinement` (fidsplat/train/view_refinement.py) in device memory."""

    def __init__(
        self,
        workspace: Workspace,
        arrays: Mapping[str, np.ndarray],
        views: Sequence[View],
        rows: Sequence[int],
        bound: dict[str, Any],
    ) -> None:
        """arrays: the state. views: uniforms of the training views. rows: row of
        `intrinsics` of each view. bound: kernel arguments by name, to which the buffers are added."""
        self._workspace, self._arrays, self._views = workspace, dict(arrays), views
        self._rows, self._bound = np.array(rows, np.uint32), bound
        self._types: dict[str, np.dtype] = {}
        """types of the buffers"""
        self._records: np.ndarray | None = None
        """initial records View; None before the first frame"""
        self.device_records: list[DeviceRecord] = []
        """record of each view on the device, from the first frame on"""
        self._refined: dict[int, tuple[View, View]] = {}
        """last view of each number, without and with its record on the device"""
        self._upload("exposures", self._arrays["exposures"].astype(np.float32))
        self._upload("lenses", self._arrays["intrinsics"][self._rows].astype(np.float32))

    def refined(self, view: View, number: int, record: np.dtype) -> View:
        """The view with the refined camera of training view `number`. record: the struct View."""
        if self._records is None:
            self._upload_all(record)
        known = self._refined.get(number)
        if known is None or known[0] is not view:
            known = self._refined[number] = view, replace(view, device_record=self.device_records[number])
        return known[1]

    def _upload_all(self, record: np.dtype) -> None:
        """Copy the state to the device, in the precision of the projection: it is the same in all frames of
        a run."""
        real, poses = record[0].base, self._arrays["poses"].astype(record[0].base)
        rows = [view_records(ViewBatch.single(v), 0, v.height, record) for v in self._views]
        self._records = records = np.concatenate(rows).view(record)
        rotation, translation = poses[:, :3, :3], poses[:, :3, 3]
        records["rotation"], records["translation"] = rotation.reshape(-1, 9), translation
        # with the rounding of the kernels (rigid_motion.cl), so that a resumed run is bit-identical
        products = rotation * translation[:, :, None]
        records["eye"] = -(products[:, 0] + products[:, 1] + products[:, 2])
        intrinsics = self._arrays["intrinsics"][self._rows]
        for name, values in zip(("focal_x", "focal_y", "center_x", "center_y"), intrinsics.T, strict=True):
            records[name] = values
        self._upload("views", records)
        self.device_records = [
            DeviceRecord(self._bound["views"], number * record.itemsize, record.itemsize)
            for number in range(len(records))
        ]
        self._upload("intrinsics_rows", self._rows)
        for name in _REALS:
            self._upload(name, self._arrays[name].astype(real))

    def read(self) -> dict[str, np.ndarray]:
        """Copy the state to the host, in float64; waits for the device."""
        arrays = self._arrays
        if (records := self._records) is None:
            return arrays
        for name in ("exposures", *_REALS):
            values = np.empty(arrays[name].shape, self._types[name])
            cl.enqueue_copy(self._queue, values, self._bound[name])
            arrays[name] = values.astype(np.float64)
        cl.enqueue_copy(self._queue, records, self._bound["views"])
        arrays["poses"][:, :3, :3] = records["rotation"].reshape(-1, 3, 3)
        arrays["poses"][:, :3, 3] = records["translation"]
        return arrays

    def _upload(self, name: str, array: np.ndarray) -> None:
        array = np.ascontiguousarray(array)
        buffer = self._workspace.pool.allocate(f"the views' {name}", array.nbytes)
        cl.enqueue_copy(self._queue, buffer, array)
        self._bound[name], self._types[name] = buffer, array.dtype

    @property
    def _queue(self) -> cl.CommandQueue:
        return self._workspace.switch_to(self._workspace.queue)
