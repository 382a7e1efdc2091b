"""Outputs and sensor steps of other packages (entry points `fidsplat.outputs` and `fidsplat.effects`)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fidsplat.effects.catalogue import CATALOGUE, COMPOSED, IMAGES, OUTPUTS, Effect, Output
from fidsplat.util.arguments import instance
from fidsplat.util.errors import InputError
from fidsplat.util.plugins import load_plugins


@dataclass(frozen=True)
class Extension:
    """An output or a sensor step, with its kernels (CONTRIBUTING.md, "Add an output")."""

    name: str
    opencl: Path
    """absolute path of its OpenCL sections, in the format of the files in kernels/opencl/output and post"""
    output: Output | None = None
    """declaration of the image; None: a step of a sensor, requested by `Sensor.extra_steps`"""
    parts: tuple[str, ...] = ()
    """OpenCL parts that it requires, such as "ray_depth\""""
    samples: tuple[str, ...] = ()
    """its sample buffers of floats"""
    uniforms: tuple[str, ...] = ()
    """names of a step's float arguments; `Sensor.extra_steps` has their values"""
    warp: Path | None = None
    """absolute path of a folder with NAME.py for Warp; None: not supported"""


EXTENSIONS: dict[str, Extension] = {}


def register(extension: Extension) -> None:
    """Add an output or a step in this process. Raises InputError for a name that exists, or is not an
    identifier."""
    name = instance("an extension", extension, Extension).name
    if not name.isidentifier() or name in CATALOGUE or name in IMAGES:
        raise InputError(f"the name of an extension must be a new identifier, got {name!r}; use another name")
    EXTENSIONS[name] = extension
    CATALOGUE[name] = Effect(name, extension.output)
    if extension.output is not None:
        IMAGES[name] = OUTPUTS[name] = extension.output


def load_extensions() -> None:
    """Register the extensions of all installed packages."""
    for group in ("fidsplat.outputs", "fidsplat.effects"):
        load_plugins(group, register)


def outputs_help() -> str:
    """Table of all outputs that captures can request, a line each, with those of installed packages."""
    load_extensions()
    outputs = (*OUTPUTS.values(), *COMPOSED.values())
    width = max(len(output.name) for output in outputs) + 2
    return "\n".join(f"  {output.name:{width}}{output.summary}" for output in outputs)
