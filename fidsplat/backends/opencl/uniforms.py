"""Uniforms of views for the kernels: the records `View`, other arrays, and scalar arguments."""

from __future__ import annotations

from typing import Any

import numpy as np

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.opencl.assemble import KernelSource
from fidsplat.backends.opencl.buffers import DeviceRecord
from fidsplat.backends.view import View


def scalar_arguments(view: View, source: KernelSource) -> dict[str, Any]:
    """Scalar kernel arguments of a view, by name."""
    red, green, blue = view.background
    scalars: dict[str, Any] = {
        "log_alpha_cutoff": view.log_alpha_cutoff,
        "opacity_ceiling": view.opacity_ceiling,
        "transmittance_stop": view.transmittance_stop,
        "sample_area": 1.0 / view.samples**2,
        "background_r": red,
        "background_g": green,
        "background_b": blue,
    }
    for group, names in source.uniform_groups.items():
        values = view.uniforms_of(group)
        for index, name in names.items():
            scalars[name] = values[index]
    return scalars


def array_arguments(
    batch: ViewBatch, source: KernelSource, row: int, end: int
) -> dict[str, np.ndarray | DeviceRecord]:
    """Array arguments of views by name, without those of effects, for rows of samples [row, end). Host arrays
    are read-only, so that `BufferPool.upload` copies each once."""
    view = batch.view
    if view.sample_rows is not None:
        row, end = max(row, view.sample_rows[0]), min(end, view.sample_rows[1])
    arrays = {"batch_indices": batch.batch_indices}
    if view.groups:
        arrays["moving"] = np.array([len(view.groups), *dict(view.groups)], np.int32)
    if view.device_record is None:
        arrays["view"] = view_records(batch, row, end, source.records["View"])
    for array in arrays.values():
        array.flags.writeable = False
    return {**arrays} if view.device_record is None else {**arrays, "view": view.device_record}


def view_records(batch: ViewBatch, row: int, end: int, record: np.dtype) -> np.ndarray:
    """Structs `View` (kernel_interface.py), (moving groups + 1, views), for rows of samples [row, end)."""
    # all members have one type
    values, real = _record_values(batch.view, row, end, record), record[0].base
    if len(batch) == 1:
        for _, moved in batch.view.groups:
            values += _record_values(moved, row, end, record)
        return np.array(values, real)
    records = np.empty(batch.translation.shape[:2], record)
    records[:] = np.array(values, real).view(record)
    records["rotation"] = batch.rotation.reshape(*records.shape, 9)
    records["translation"], records["eye"] = batch.translation, batch.eye
    for name in batch.camera_parameters.keys() & (record.names or ()):
        records[name] = batch.camera_parameters[name]
    return records


def view_arguments(
    view: View, source: KernelSource, rows: int
) -> tuple[dict[str, Any], dict[str, np.ndarray | DeviceRecord]]:
    """Scalar and array arguments of a view that is rendered alone, cached on the view. rows: of samples, in
    complete tiles."""
    cached = view.kernel_arguments.get(source)
    if cached is None:
        arrays = array_arguments(ViewBatch.single(view), source, 0, rows)
        arrays |= {name: view.array(name) for name in source.view_arrays}
        cached = view.kernel_arguments[source] = scalar_arguments(view, source), arrays
    return cached


def _record_values(view: View, row: int, end: int, record: np.dtype) -> list[float]:
    """The numbers of a record `View`, for rows of samples [row, end)."""
    values: dict[str, Any] = {
        "rotation": view.rotation.ravel().tolist(),
        "translation": view.translation.tolist(),
        "eye": view.eye.tolist(),
        "focal_x": view.focal_x,
        "focal_y": view.focal_y,
        "center_x": view.center_x,
        "center_y": view.center_y,
        "near": view.near,
        "far": view.far,
        "log_alpha_cutoff": view.log_alpha_cutoff,
        "width": view.width,
        "height": view.height,
        "sample_area": 1.0 / view.samples**2,
        "first_row": row,
        "end_row": end,
        "ewa_clamp": view.ewa_clamp,
    }
    # then the members of a lens and its inverse lookup table
    lens = iter(() if view.raster is None else view.raster.uniforms)
    flat: list[float] = []
    for name in record.names or ():
        if name in values:
            value = values[name]
            flat += value if isinstance(value, (list, tuple)) else (value,)
        else:
            flat += (next(lens) for _ in range(record[name].shape[0] if record[name].shape else 1))
    return flat
