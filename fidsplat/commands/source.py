"""Command `fidsplat source`: print the OpenCL program of a scene."""

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from fidsplat.commands.scenes import SceneInput
from fidsplat.util.errors import InputError

if TYPE_CHECKING:
    from fidsplat.backends.opencl.device import OpenCLBackend


@dataclass
class Source(SceneInput):
    """Print the OpenCL program of a scene, assembled from the files of kernels/opencl.

    The program contains only the features that the scene requests: compare two scenes, or two sets of
    outputs, with diff. #line directives name the file and line of each section; "kernel_interface.py: NAME"
    is a declaration of fidsplat/backends/opencl/kernel_interface.py (structs and kernel arguments) with the
    additions of effects. The compiler receives this text without comments but with the same lines, so its
    messages name these lines.

    No device is opened and no OpenCL is needed, unless --device selects a device, whose vector width and tile
    size are then used.

    Examples:
      fidsplat source scene.toml
      fidsplat source scene.toml --schedule group            the variant for GPUs
      fidsplat source scene.toml --device opencl:pocl
      fidsplat source scene.toml --outputs rgb,depth | grep -n '^#line.*depth'
      diff <(fidsplat source a.toml) <(fidsplat source b.toml)
    """

    schedule: Literal["lanes", "group"] = "lanes"
    """S: lanes: for CPUs, one work-item per tile; group: for GPUs, one work-group per tile"""
    device: str | None = None
    """D: OpenCL device, instead of a schedule"""

    def run(self) -> int:
        from fidsplat.backends.opencl.assemble import assemble
        from fidsplat.backends.opencl.kernel_config import config_for, cpu_config, gpu_config
        from fidsplat.effects import select

        scene = self.load()
        features = select(scene.splats, scene.capture.with_(outputs=self.outputs, quality=self.quality))
        if self.device is None:
            shape = cpu_config() if self.schedule == "lanes" else gpu_config()
            source = assemble(features, config_for(features, shape))
        else:
            source = self._backend().pipeline(features).source
        sys.stdout.write(source.listing)
        return 0

    def _backend(self) -> "OpenCLBackend":
        import fidsplat as fs
        from fidsplat.backends.opencl.device import OpenCLBackend

        backend = fs.Renderer(self.device).backend
        if not isinstance(backend, OpenCLBackend):
            raise InputError(f"--device must be an OpenCL device, got {self.device}; see `fidsplat devices`")
        return backend
