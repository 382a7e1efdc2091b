"""Commands `fidsplat devices` and `fidsplat warm`: list devices, and compile their kernels in advance."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from fidsplat.commands.options import Device, Json
from fidsplat.commands.output import report, show_progress
from fidsplat.util.errors import counted

if TYPE_CHECKING:
    from fidsplat.backends.interface import DeviceInfo


@dataclass
class Devices:
    """List the devices that can render on this machine, and the reasons why others cannot.

    The first column contains the values for --device.

    Examples:
      fidsplat devices
      fidsplat devices --json
    """

    json: Json = False

    def run(self) -> int:
        import fidsplat as fs

        devices = fs.devices()
        table = "Devices", ("device", "description", "memory", "usable"), map(_row, devices)
        return report(self.json, {"devices": [asdict(info) for info in devices]}, table=table)


def _row(info: DeviceInfo) -> tuple[str, ...]:
    version = info.version if info.platform in info.version else f"{info.platform}: {info.version}"
    units, float64 = counted(info.compute_units, "units"), "with" if info.float64 else "no"
    usable = "yes" if info.usable else "no"
    return (
        info.name,
        f"{info.title}\n{info.kind}, {units}, {float64} float64\n{version}",
        f"{info.memory_bytes / 2**30:.1f} GiB",
        f"{usable}: {info.reason}" if info.reason else usable,
    )


@dataclass
class Warm:
    """Compile the kernels of common scenes in advance, so that first frames are fast.

    The kernels of a scene are compiled when it is first rendered, which takes a second or more, and cached by
    pyopencl, Warp and the driver. This command fills these caches: markers, 2D splats and captures of 3D
    Gaussians, separate and combined, with the usual outputs. Run it once after an installation, an update or
    a change of the driver. Cached kernels are skipped.

    Examples:
      fidsplat warm
      fidsplat warm --device opencl:nvidia --json
    """

    device: Device = None
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments.bench.warm import recipes, warm
        from fidsplat.render.renderer import Renderer

        begun = time.perf_counter()
        renderer, sets = Renderer(self.device), recipes()
        compiled: list[tuple[str, float]] = []
        steps = warm(renderer, sets)
        try:
            for recipe, seconds in show_progress(
                "sets of kernels", steps, len(sets), label=lambda step: step[0].text
            ):
                compiled.append((recipe.text, seconds))
        finally:  # an interrupted run reports its compiled kernels
            device, took = renderer.device, time.perf_counter() - begun
            facts: dict = {"device": device.name, "title": device.title, "version": device.version}
            facts["sets"] = [{"set": name, "seconds": seconds} for name, seconds in compiled]
            line = f"{len(compiled)} of {len(sets)} sets of kernels are ready on {device.title}; {took:.1f} s"
            report(self.json, facts | {"of": len(sets), "seconds": took}, line)
        return 0
