"""Frame times of scenes and devices as bars."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from fidsplat.experiments.bench.measure import Result
from fidsplat.experiments.charts import bars, chart, legend_above, plain_ticks


def write_plot(results: Sequence[Result], file: Path) -> None:
    """A group of bars for each scene, one for each device: median milliseconds of a frame, on a logarithmic
    axis, with the quartiles; below each the device's roofline, where it is known.

    Raises InputError when the file cannot be written.
    """
    drawn = {(result.scene, result.device.name): result for result in results if result.timer.ms}
    scenes = list(dict.fromkeys(scene for scene, _ in drawn))
    devices = list(dict.fromkeys(device for _, device in drawn))
    of = [[drawn.get((scene, device)) for scene in scenes] for device in devices]
    series = {
        device: [math.nan if result is None else result.timer.median for result in row]
        for device, row in zip(devices, of, strict=True)
    }
    with chart(file, size=(max(5.0, 1.6 + 0.9 * len(scenes) * max(1, len(devices))), 4.2)) as (
        figure,
        (axes,),
    ):
        bars(axes, scenes, series, logarithmic=True)
        places = [(bar.get_x() + bar.get_width() / 2) for held in axes.containers for bar in held]
        each = [result for row in of for result in row]
        for place, result in zip(places, each, strict=True):
            if result is None:
                continue
            low, middle, high = result.timer.quartiles
            axes.errorbar(place, middle, [[middle - low], [high - middle]], color="black", capsize=3)
            if least := sum(result.rooflines.values()):
                axes.plot(place, least, marker="_", markersize=18, color="black")
        axes.set_ylabel("ms a frame (_: roofline)")
        plain_ticks(axes.yaxis)
        axes.tick_params(axis="x", labelrotation=15 if len(scenes) > 3 else 0)
        if len(devices) > 1:
            legend_above(figure, axes)
        else:
            axes.set_title(next(iter(drawn.values())).device.title, fontsize=10)
