"""Bar chart of frame times of scenes and devices."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from fidsplat.experiments.bench.measure import Result
from fidsplat.experiments.charts import bars, chart, legend_above, plain_ticks


def write_plot(results: Sequence[Result], file: Path) -> None:
    """Write a chart with a bar per scene and device: median milliseconds of a frame, with quartiles.

    The axis is logarithmic; a line marks the roofline of the device if it is known.

    Raises InputError if the file cannot be written.
    """
    measured = {(result.scene, result.device.name): result for result in results if result.timer.ms}
    scenes = list(dict.fromkeys(scene for scene, _ in measured))
    devices = list(dict.fromkeys(device for _, device in measured))
    series = {
        device: [
            measured[scene, device].timer.median if (scene, device) in measured else math.nan
            for scene in scenes
        ]
        for device in devices
    }
    width = max(5.0, 1.6 + 0.9 * len(scenes) * len(devices))
    with chart(file, size=(width, 4.2)) as (figure, (axes,)):
        bars(axes, scenes, series, logarithmic=True)
        named = {"roofline": "roofline: minimum time of the device's arithmetic and memory"}
        named["quartiles"] = "quartiles"
        for device, container in zip(devices, list(axes.containers), strict=True):
            for scene, bar in zip(scenes, container, strict=True):
                if (scene, device) not in measured:
                    continue
                x, result = bar.get_x() + bar.get_width() / 2, measured[scene, device]
                low, middle, high = result.timer.quartiles
                axes.errorbar(
                    x,
                    middle,
                    [[middle - low], [high - middle]],
                    color="black",
                    capsize=3,
                    label=named.pop("quartiles", None),
                )
                if roofline := sum(result.rooflines.values()):
                    axes.plot(
                        x, roofline, "_", markersize=18, color="black", label=named.pop("roofline", None)
                    )
        axes.set_ylabel("ms per frame")
        plain_ticks(axes.yaxis)
        axes.tick_params(axis="x", labelrotation=15 if len(scenes) > 3 else 0)
        legend_above(figure, axes)
        if len(devices) == 1:
            axes.set_title(next(iter(measured.values())).device.title, fontsize=10)
