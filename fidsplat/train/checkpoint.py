"""Checkpoints: all that a run needs to go on to the same bits, in one file that is whole or not there."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from fidsplat import __version__
from fidsplat.errors import InputError
from fidsplat.files import atomic_write, from_json, open_input
from fidsplat.provenance import code_hash
from fidsplat.splats import SplatCloud
from fidsplat.train.dataset import Dataset
from fidsplat.train.parameters import NAMES, Splats
from fidsplat.train.settings import TrainSettings

_FORMAT = 2
_GROUPS = ("values", "first", "second")
_HISTORY = ("losses", "psnrs", "counts")
_DAMAGED = (OSError, ValueError, KeyError, EOFError, BadZipFile, TypeError, AttributeError, RuntimeError)
"""what NumPy and zipfile raise for files that are not theirs any more"""
_MAY_DIFFER = ("iterations",)
"""settings that do not change what an iteration does: a run may be made longer"""


@dataclass
class Progressed:
    """How far a run has come."""

    iteration: int
    """iterations that are done"""
    adam_step: int
    """steps of the optimiser, which are fewer: an iteration that makes splats has none"""
    splats: Splats
    history: dict[str, np.ndarray]
    """`losses` and `psnrs` (iteration,) float32, `counts` (iteration,) int32 of splats"""


def save_checkpoint(
    file: Path, made: Progressed, settings: TrainSettings, dataset: Dataset, device: str
) -> None:
    """Write a checkpoint.

    Args:
        dataset: that is trained on; its digest, origin and background are kept.
        device: title of what draws.

    Raises InputError when the file cannot be written, as when the disk is full; an older one then stays.
    """
    facts = {
        "format": _FORMAT,
        "iteration": made.iteration,
        "adam_step": made.adam_step,
        "settings": asdict(settings),
        "dataset": dataset.digest,
        "origin": dataset.origin.tolist(),
        "background": list(dataset.background),
        "by": _made_by(device),
    }
    arrays = {f"{group}.{name}": getattr(made.splats, group)[name] for group in _GROUPS for name in NAMES}
    arrays |= {"gradients": made.splats.gradients, "seen": made.splats.seen, **made.history}
    with atomic_write(file, durable=True) as stream:
        np.savez(stream, facts=np.frombuffer(json.dumps(facts).encode(), np.uint8), **arrays)


def splats_of(file: Path) -> tuple[SplatCloud, tuple[float, float, float]]:
    """The splats of a checkpoint as they are drawn, and the background before which they are trained.

    Raises InputError for a file that is damaged or of another version.
    """
    try:
        with open_input(file) as stream, np.load(stream, allow_pickle=False) as arrays:
            facts = from_json(bytes(arrays["facts"]))
            red, green, blue = map(float, facts["background"])
            splats = Splats.of({name: arrays[f"values.{name}"] for name in NAMES})
        cloud = splats.cloud(int(facts["settings"]["sh_degree"]), np.array(facts["origin"], np.float64))
    except InputError:
        raise
    except _DAMAGED as error:
        raise InputError(f"{file} is no checkpoint of `fidsplat train` that can be read: {error}") from error
    return cloud, (red, green, blue)


def load_checkpoint(
    file: Path, settings: TrainSettings, digest: str, device: str
) -> tuple[Progressed, list[str]]:
    """Read a checkpoint of the same run.

    Args:
        digest: of the data set.
        device: title of what draws from now on.

    Returns:
        how far it came; and by what else it was made, if not by this device and these sources: "another
        device (PoCL, not H100)".

    Raises InputError for a file that is damaged or of another run, which it names the difference of.
    """
    try:
        with open_input(file) as stream, np.load(stream, allow_pickle=False) as arrays:
            facts = from_json(bytes(arrays["facts"]))
            if facts.get("format") != _FORMAT:
                raise ValueError("it is of another version of fidsplat")
            values, first, second = ({name: arrays[f"{group}.{name}"] for name in NAMES} for group in _GROUPS)
            splats = Splats(values, first, second, arrays["gradients"], arrays["seen"])
            history = {name: arrays[name] for name in _HISTORY}
            before = [str(facts["by"][name]) for name in _made_by(device)]
    except InputError:
        raise
    except _DAMAGED as error:
        raise InputError(
            f"{file} is no checkpoint that can be read: {error}; remove it, or give --overwrite to begin "
            "again"
        ) from error
    if differ := _differences(facts, settings, digest):
        raise InputError(
            f"{file} is of a run with another {' and another '.join(differ)}; give another name with -o, or "
            "--overwrite to begin again"
        )
    now = zip(_made_by(device).items(), before, strict=True)
    others = [f"another {name} ({was}, not {here})" for (name, here), was in now if was != here]
    return Progressed(facts["iteration"], facts["adam_step"], splats, history), others


def _made_by(device: str) -> dict[str, str]:
    """On what the bits of a run depend beside its settings and its data."""
    return {"device": device, "fidsplat": f"{__version__}, sources {code_hash()}"}


def _differences(facts: dict[str, Any], settings: TrainSettings, digest: str) -> list[str]:
    now = asdict(settings)
    names = [
        f"{name} ({facts['settings'].get(name)!r}, not {value!r})"
        for name, value in now.items()
        if name not in _MAY_DIFFER and facts["settings"].get(name) != value
    ]
    if facts["iteration"] > settings.iterations:
        names.append(f"number of iterations (at least {facts['iteration']}, not {settings.iterations})")
    return names + (["data set"] if facts["dataset"] != digest else [])
