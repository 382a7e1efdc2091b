"""Uniforms of views for the kernels: the records `View`, other arrays, and scalar arguments."""

from __future__ import annotations

from typing import Any

import numpy as np

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.opencl.assemble import KernelSource
from fidsplat.backends.opencl.buffers import DeviceRecord
from fidsplat.backends.view import View


def scalars_of(view: View) -> dict[str, float]:
    """Scalar kernel arguments that every program has, by name."""
    red, green, blue = view.background
    names = ("log_alpha_cutoff", "opacity_ceiling", "transmittance_stop")
    return {
        **{name: getattr(view, name) for name in names},
        "sample_area": 1.0 / view.samples**2,
        **{"background_r": red, "background_g": green, "background_b": blue},
    }


def scalar_arguments(view: View, source: KernelSource) -> dict[str, Any]:
    """All scalar kernel arguments of a view, by name."""
    scalars: dict[str, Any] = scalars_of(view)
    for group, names in source.uniform_groups.items():
        values = view.uniforms_of(group)
        for index, name in names.items():
            scalars[name] = values[index]
    return scalars


def projection_arrays(
    views: ViewBatch, source: KernelSource, row: int, end: int
) -> dict[str, np.ndarray | DeviceRecord]:
    """Array arguments of the projection by name, for rows of samples [row, end); host arrays are read-only,
    so that `BufferPool.upload` copies each once."""
    view = views.view
    if view.device_record is not None:
        return {"view": view.device_record}
    if view.sample_rows is not None:
        row, end = max(row, view.sample_rows[0]), min(end, view.sample_rows[1])
    arrays = {"view": view_records(views, row, end, source.records["View"])}
    if view.groups:
        arrays["moving"] = np.array([len(view.groups), *(label for label, _ in view.groups)], np.int32)
    for array in arrays.values():
        array.flags.writeable = False
    return {**arrays}


def view_records(views: ViewBatch, row: int, end: int, record: np.dtype) -> np.ndarray:
    """Structs `View` (kernel_interface.py), (moving groups + 1, views), for rows of samples [row, end)."""
    real = record[0].base  # all members have one type
    if len(views) == 1:
        values = _record_values(views.view, row, end, record)
        for _, moved in views.view.groups:
            values += _record_values(moved, row, end, record)
        return np.array(values, real)
    made = np.empty(views.translation.shape[:2], record)
    made[:] = np.array(_record_values(views.view, row, end, record), real).view(record)
    made["rotation"] = views.rotation.reshape(*made.shape, 9)
    made["translation"], made["eye"] = views.translation, views.eye
    for name, values in views.camera_parameters.items():
        if name in (record.names or ()):
            made[name] = values
    return made


def _record_values(view: View, row: int, end: int, record: np.dtype) -> list[float]:
    values: dict[str, Any] = {
        **{"rotation": view.rotation.ravel().tolist(), "translation": view.translation.tolist()},
        **{"eye": view.eye.tolist(), "focal_x": view.focal_x, "focal_y": view.focal_y},
        **{"center_x": view.center_x, "center_y": view.center_y, "near": view.near, "far": view.far},
        **{"log_alpha_cutoff": view.log_alpha_cutoff, "width": view.width, "height": view.height},
        **{
            "sample_area": 1.0 / view.samples**2,
            "first_row": row,
            "end_row": end,
            "ewa_clamp": view.ewa_clamp,
        },
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
