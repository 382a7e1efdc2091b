"""Gathers the samples of a picture's shots: light is averaged, other planes are those of one pose."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fidsplat.backends.view import Shot
from fidsplat.backends.warp import runtime
from fidsplat.backends.warp.launch import Launcher

if TYPE_CHECKING:
    from fidsplat.backends.warp.pipeline import WarpPipeline


def kernels_of(planes: dict[str, Any]) -> dict[str, Any]:
    """The kernels that gather those of these planes of samples that are light, by the plane's name."""
    light = runtime.kernels("planes").LIGHT
    made = runtime.kernels("shutter").make_expose
    return {name: made(dtype) for name, dtype in planes.items() if name in light}


def gather(
    pipeline: WarpPipeline, launcher: Launcher, shot: Shot, samples: Any, whole: Any, stride: int
) -> None:
    """Adds a shot's samples to the picture's; stride: samples of a row of both, their padding included."""
    import warp as wp

    start, count = shot.top * stride, shot.view.height * stride
    for name in pipeline.sample_planes:
        mine, every = getattr(samples, name), getattr(whole, name)
        if name in pipeline.expose:
            args = shot.weight, int(shot.first), start, mine, every
            launcher.launch(pipeline.expose[name], count, *args)
        elif shot.middle:
            wp.copy(every, mine, dest_offset=start, count=count)
