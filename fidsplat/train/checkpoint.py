"""Training checkpoints: one file with the state of a run, from which it resumes bit-identically."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat import __version__
from fidsplat.capture.quality import whole_number
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import MAX_DEGREE
from fidsplat.train.dataset import Dataset
from fidsplat.train.parameters import NAMES, Arrays, Splats
from fidsplat.train.settings import MAX_ITERATIONS, TrainSettings
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write, from_json
from fidsplat.util.npy import load_npz
from fidsplat.util.provenance import code_hash

_FORMAT = 5
_GROUPS = ("values", "first", "second")
_VALUES = tuple(f"values.{name}" for name in NAMES)
_HISTORY = {"losses": np.float32, "psnrs": np.float32, "counts": np.int32}
_VIEWS = "views."
"""prefix of the arrays of `ViewRefinement`"""
_MAY_DIFFER = ("iterations",)
"""settings that may differ when a run resumes, so that it can be extended"""


@dataclass
class TrainingState:
    """Progress of a training run: splats and history."""

    iteration: int
    """number of completed iterations"""
    splats: Splats
    history: Arrays
    """`losses` and `psnrs` (iteration,) float32, and numbers of splats `counts` (iteration,) int32"""
    views: Arrays = field(default_factory=dict)
    """state of `ViewRefinement`; empty without refinement"""

    @staticmethod
    def initial(splats: Splats) -> TrainingState:
        """State before the first iteration."""
        return TrainingState(0, splats, {name: np.zeros(0, dtype) for name, dtype in _HISTORY.items()})


def save_checkpoint(
    file: Path, state: TrainingState, settings: TrainSettings, dataset: Dataset, device: str
) -> None:
    """Write a checkpoint.

    Args:
        dataset: the data set of the run; the checkpoint holds its digest, origin and background.
        device: title of the device that renders.

    Raises InputError if the file cannot be written, for instance on a full disk; an older checkpoint is kept.
    """
    facts = {
        "format": _FORMAT,
        "iteration": state.iteration,
        "settings": asdict(settings),
        "dataset": dataset.digest,
        "origin": dataset.origin.tolist(),
        "background": list(dataset.background),
        "by": _settings_of_run(device),
    }
    splats = state.splats
    arrays = {f"{group}.{name}": getattr(splats, group)[name] for group in _GROUPS for name in NAMES}
    arrays |= {"gradients": splats.gradient_sums, "seen": splats.visible_counts, **state.history}
    arrays |= {_VIEWS + name: array for name, array in state.views.items()}
    with atomic_write(file, durable=True) as stream:
        np.savez(stream, facts=np.frombuffer(json.dumps(facts).encode(), np.uint8), **arrays)


def splats_of(file: Path) -> tuple[SplatCloud, tuple[float, float, float]]:
    """Read the splats of a checkpoint as a cloud, and the background (display values) of its data set.

    Raises InputError for a file that is damaged or of another version.
    """
    try:
        arrays = load_npz(file, ("facts", *_VALUES))
        facts = _facts(arrays)
        origin, background = (np.array(facts[name], np.float64) for name in ("origin", "background"))
        if not (origin.shape == background.shape == (3,) and np.isfinite([origin, background]).all()):
            raise ValueError(
                f"the origin and the background must be three finite numbers each, got {facts['origin']} and "
                f"{facts['background']}"
            )
        degree = whole_number("sh_degree", facts["settings"]["sh_degree"], 0, MAX_DEGREE)
        axes = 3 if facts["settings"]["primitive"] == "3d" else 2
        splats = Splats.of(_group(arrays, "values", len(arrays["values.means"]), degree, axes))
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(
            f"cannot read {file} as a checkpoint of `fidsplat train`: {error}; remove it to start again"
        ) from error
    values, (red, green, blue) = splats.values, background.tolist()
    with np.errstate(over="ignore"):  # the cloud drops splats whose scales overflow
        shapes = values["means"], values["quats"], splats.scales, splats.opacities
    cloud = SplatCloud(*shapes, sh=values["sh"], origin=origin, source=str(file))
    return cloud, (red, green, blue)


def load_checkpoint(
    file: Path, settings: TrainSettings, digest: str, device: str
) -> tuple[TrainingState, list[str]]:
    """Read a checkpoint of the same run. Every array is checked before a device uses it.

    Args:
        digest: digest of the data set.
        device: title of the device of the resumed run.

    Returns:
        the progress of the run, and a description of a changed device or version of fidsplat, for instance
        "another device (PoCL, not H100)".

    Raises InputError for a damaged file or a checkpoint of another run; the message names the difference.
    """
    try:
        arrays = load_npz(file)
        facts = _facts(arrays)
        iteration = whole_number("iteration", facts["iteration"], 0, MAX_ITERATIONS)
        before = [str(facts["by"][name]) for name in _settings_of_run(device)]
        differ = _differences(facts, settings, digest)
        views = {name.removeprefix(_VIEWS): arrays.pop(name) for name in [*arrays] if name.startswith(_VIEWS)}
        state = None if differ else TrainingState(iteration, *_state(arrays, settings, iteration), views)
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise InputError(
            f"cannot read {file} as a checkpoint: {error}; remove it, or give --overwrite to start again"
        ) from error
    if state is None:
        raise InputError(
            f"checkpoint {file} must belong to the same run, got another {' and another '.join(differ)}; "
            "give another name with -o, or --overwrite to start again"
        )
    now = zip(_settings_of_run(device).items(), before, strict=True)
    return state, [f"another {name} ({was}, not {here})" for (name, here), was in now if was != here]


def _facts(arrays: Arrays) -> dict[str, Any]:
    facts = from_json(arrays["facts"].tobytes())
    if not isinstance(facts, dict) or facts.get("format") != _FORMAT:
        raise ValueError(f"its format must be {_FORMAT}, got that of another version of fidsplat")
    return facts


def _state(arrays: Arrays, settings: TrainSettings, iteration: int) -> tuple[Splats, Arrays]:
    """Pop the splats and the history from a checkpoint's `arrays`; raise ValueError if they contradict the
    settings."""
    count = len(arrays["values.means"])
    if count > settings.max_splats:
        raise ValueError(f"its splats must be at most max_splats, {settings.max_splats}, got {count}")
    values, first, second = (
        _group(arrays, name, count, settings.sh_degree, settings.axes) for name in _GROUPS
    )
    gradients, seen = (_checked(arrays, name, (count,)) for name in ("gradients", "seen"))
    for name, array in (second | {"gradients": gradients, "seen": seen}).items():
        if (array < 0).any():
            raise ValueError(f"{name} must be at least 0, got {array.min():g}")
    history = {name: _checked(arrays, name, (iteration,), dtype) for name, dtype in _HISTORY.items()}
    return Splats(values, first, second, gradients, seen), history


def _group(arrays: Arrays, group: str, count: int, degree: int, axes: int) -> Arrays:
    shapes = {"means": (3,), "log_scales": (axes,), "quats": (4,), "logits": (), "sh": ((degree + 1) ** 2, 3)}
    return {name: _checked(arrays, f"{group}.{name}", (count, *shape)) for name, shape in shapes.items()}


def _checked(arrays: Arrays, name: str, shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
    """Pop an array from `arrays`, check it, and return a writable copy."""
    array = arrays.pop(name)
    if array.dtype != dtype or array.shape != shape:
        expected = f"{np.dtype(dtype)} of the shape {shape}"
        raise ValueError(f"{name} must be {expected}, got {array.dtype} of the shape {array.shape}")
    if wrong := np.count_nonzero(~np.isfinite(array)):
        raise ValueError(f"{name} must be finite, got {wrong:,} other numbers")
    return np.array(array, order="C")


def _settings_of_run(device: str) -> dict[str, str]:
    """Device and version of the code; results depend on them in addition to settings and data."""
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
