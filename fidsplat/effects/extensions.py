"""Outputs and sensor steps of other packages (entry points `fidsplat.outputs` and `fidsplat.effects`)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fidsplat.effects.catalogue import CATALOGUE, DERIVED_OUTPUTS, IMAGES, OUTPUTS, Effect, Output
from fidsplat.util.arguments import instance
from fidsplat.util.errors import InputError
from fidsplat.util.plugins import load_plugins


@dataclass(frozen=True)
class Extension:
    """An output or a sensor step with its kernels (CONTRIBUTING.md, "Add an output")."""

    name: str
    opencl: Path
    """absolute path of its OpenCL sections, in the format of kernels/opencl/output and kernels/opencl/post"""
    output: Output | None = None
    """declaration of the image; None for a sensor step, which `Sensor.extra_steps` requests"""
    parts: tuple[str, ...] = ()
    """names of required OpenCL parts, such as "ray_depth\""""
    samples: tuple[str, ...] = ()
    """names of its float sample buffers"""
    uniforms: tuple[str, ...] = ()
    """names of a step's float arguments, whose values are in `Sensor.extra_steps`"""
    warp: Path | None = None
    """absolute path of a folder with NAME.py for Warp; None if Warp is not supported"""


EXTENSIONS: dict[str, Extension] = {}


def register(extension: Extension) -> None:
    """Add an output or a sensor step in this process. Raises InputError for a name that exists or is not an
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
    """Table of all outputs that captures can request, including installed packages', with a line for each."""
    load_extensions()
    outputs = (*OUTPUTS.values(), *DERIVED_OUTPUTS.values())
    width = max(len(output.name) for output in outputs) + 2
    return "\n".join(f"  {output.name:{width}}{output.summary}" for output in outputs)
