"""`fidsplat warm`."""

import time
from dataclasses import dataclass

from fidsplat.commands.output import Device, Json, counted, tell


@dataclass
class Warm:
    """Compile what scenes commonly call for, so that first pictures come at once.

    The kernels of a scene are compiled when it is first drawn, which takes a second or more, and kept in the
    caches of pyopencl, of Warp and of the driver. This fills them: markers, 2D splats and captures of 3D
    Gaussians, alone and together, the usual outputs. Worth it once after an installation, an update or a
    change of the driver. What is there already takes no time.

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
        renderer = Renderer(self.device)
        wanted = recipes()
        done: list[tuple[str, float]] = []
        made = warm(renderer, wanted)
        try:
            for recipe, seconds in counted(
                "sets of kernels", made, len(wanted), words=lambda one: one[0].words
            ):
                done.append((recipe.words, seconds))
        finally:  # what a run that is stopped has compiled stays compiled
            device, took = renderer.device, time.perf_counter() - begun
            record: dict = {"device": device.name, "title": device.title, "version": device.version}
            record["sets"] = [{"set": words, "seconds": seconds} for words, seconds in done]
            words = f"{len(done)} of {len(wanted)} sets of kernels are ready on {device.title}; {took:.1f} s"
            tell(self.json, record | {"of": len(wanted), "seconds": took}, words)
        return 0
