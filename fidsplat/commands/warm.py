"""`fidsplat warm`."""

import time
from dataclasses import dataclass

from fidsplat.commands.output import Device, Json, console, tell


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
        from rich.progress import Progress, TextColumn

        from fidsplat.experiments.bench.warm import recipes, warm
        from fidsplat.render import Renderer

        where = console(self.json)
        begun = time.perf_counter()
        renderer = Renderer(self.device)
        wanted = recipes()
        done: list[tuple[str, float]] = []
        columns = (*Progress.get_default_columns(), TextColumn("{task.fields[now]}"))
        try:
            with Progress(*columns, console=where, transient=True) as progress:
                task = progress.add_task("sets of kernels", total=len(wanted), now=wanted[0].words)
                for recipe, seconds in warm(renderer, wanted):
                    done.append((recipe.words, seconds))
                    following = wanted[len(done)].words if len(done) < len(wanted) else ""
                    progress.update(task, advance=1, now=following)
        finally:  # what a run that is stopped has compiled stays compiled
            device, took = renderer.device, time.perf_counter() - begun
            record: dict = {"device": device.name, "title": device.title, "version": device.version}
            record["sets"] = [{"set": words, "seconds": seconds} for words, seconds in done]
            words = f"{len(done)} of {len(wanted)} sets of kernels are ready on {device.title}; {took:.1f} s"
            tell(self.json, record | {"of": len(wanted), "seconds": took}, words)
        return 0
