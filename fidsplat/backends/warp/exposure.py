"""Gathers the samples of a picture's shots: light is averaged, other sample buffers are those of one pose."""

from __future__ import annotations

from typing import Any

from fidsplat.backends.view import Shot
from fidsplat.backends.warp.launch import Launcher
from fidsplat.backends.warp.program import Program
from fidsplat.backends.warp.runtime import load


def gather(program: Program, launcher: Launcher, shot: Shot, samples: Any, whole: Any, stride: int) -> None:
    """Adds a shot's samples to the picture's; stride: samples of a row of both, their padding included."""
    start, count = shot.top * stride, shot.view.height * stride
    for name in program.sample_fields:
        mine, every = getattr(samples, name), getattr(whole, name)
        if name in program.expose:
            given = {"weight": shot.weight, "fresh": int(shot.first), "start": start}
            launcher.launch(program.expose[name], count, {**given, "raw": mine, "exposed": every})
        elif shot.middle:
            load().copy(every, mine, dest_offset=start, count=count)
