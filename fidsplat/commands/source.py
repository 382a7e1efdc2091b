"""`fidsplat source`."""

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from fidsplat.commands.output import SceneOutputs, SceneQuality, console, late_progress, names_of, option
from fidsplat.commands.render import load_source
from fidsplat.util.errors import InputError

if TYPE_CHECKING:
    from fidsplat.backends.opencl.device import OpenCLBackend
    from fidsplat.effects import FeatureSet


@dataclass
class Source:
    """Print the OpenCL program that a scene calls for, put together of the files of kernels/opencl.

    Comments are kept, and #line directives say from which file and line each piece comes; "layout.py: NAME"
    is what layout.py of fidsplat/backends/opencl declares, with what effects add to it: structs, and the
    arguments of kernels. What is compiled is this text without its comments, line for line, so a compiler's
    messages name the same places.
    Only what the scene asks for is there: compare two scenes, or two sets of outputs, with diff.

    No device is opened and no OpenCL is needed, unless --device asks for the program of one device, with its
    vectors and tiles.

    Examples:
      fidsplat source scene.toml
      fidsplat source scene.toml --schedule group            as a GPU has it
      fidsplat source scene.toml --device opencl:pocl
      fidsplat source scene.toml --outputs rgb,depth | grep -n '^#line.*depth'
      diff <(fidsplat source a.toml) <(fidsplat source b.toml)
    """

    source: Annotated[tyro.conf.Positional[str], option("SCENE.toml|FILE.ply", "what would be drawn")]
    outputs: SceneOutputs = None
    quality: SceneQuality = None
    schedule: Annotated[
        Literal["lanes", "group"],
        option("S", "lanes: for CPUs, a tile per work-item; group: for GPUs, a work-group per tile"),
    ] = "lanes"
    device: Annotated[str | None, option("D", "an OpenCL device, instead of a schedule")] = None

    def run(self) -> int:
        from fidsplat.backends.opencl.assemble import assemble
        from fidsplat.backends.opencl.shapes import cpu_shape, gpu_shape, shape_for

        features = self._features()
        if self.device is None:
            shape = cpu_shape() if self.schedule == "lanes" else gpu_shape()
            source = assemble(features, shape_for(features, shape))
        else:
            source = self._backend().source(features)
        sys.stdout.write(source.listing)
        return 0

    def _features(self) -> "FeatureSet":
        """What the scene calls for."""
        from fidsplat.effects import select

        with late_progress(console(True)) as progress:
            scene = load_source(self.source, self.quality, progress)
        names = names_of(self.outputs)
        return select(scene.splats, scene.capture.with_(outputs=names, quality=self.quality))

    def _backend(self) -> "OpenCLBackend":
        import fidsplat as fs
        from fidsplat.backends.opencl.device import OpenCLBackend

        backend = fs.Renderer(self.device).backend
        if not isinstance(backend, OpenCLBackend):
            raise InputError(f"{self.device} is no OpenCL device; see `fidsplat devices` for those that are")
        return backend
