"""Options that several commands share, and validation of their values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import tyro

from fidsplat.util.arguments import Bytes
from fidsplat.util.errors import InputError
from fidsplat.util.files import writable_file

repeatable = tyro.conf.configure(tyro.conf.UseAppendAction)
"""decorator of a command whose options with several values are repeated, with one value each"""


Device = Annotated[str | None, "D: device; see `fidsplat devices` (default: FIDSPLAT_DEVICE, or auto)"]
Devices = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    "D: device, repeat for several; see `fidsplat devices` (default: FIDSPLAT_DEVICE, or auto)",
]
Json = Annotated[bool, "print one JSON object on stdout and nothing else there"]
Overwrite = Annotated[bool, "replace existing files"]
"""Commands whose output may be a user's own file or cost hours do not replace files without this option.
Images, charts and tables replace earlier ones."""
MemoryBudget = Annotated[
    Bytes | None, "SIZE: device memory for an image and its splats, e.g. 2GiB (default: nine tenths of it)"
]
Folders = tyro.conf.Positional[tuple[str, ...]]
ReportTo = Annotated[str | None, "DIR|FILE.md: folder or file for the report (default: the first folder)"]
BlenderEnvironment = Annotated[
    Path | None, "DIR: Blender's virtual environment (default: fidsplat/blender in the user's cache)"
]


def check_request(outputs: tuple[str, ...] | None, quality: str | None) -> None:
    """Raise InputError for outputs or a quality that no scene supports, before a device is opened."""
    import fidsplat as fs
    from fidsplat.effects import select

    select(fs.SplatCloud.empty(), fs.Capture(outputs=outputs or "rgb", quality=fs.Quality.of(quality)))


def parse_numbers(option: str, text: str, form: str, amount: int | None = None) -> list[float]:
    """Finite numbers separated by commas. Raises InputError if `text` is not of this form or has not `amount`
    numbers."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or amount not in (None, len(numbers)) or not all(map(math.isfinite, numbers)):
        raise InputError(f"{option} must be {form} separated by commas, got {text!r}")
    return numbers


def log_is_complete(path: str | None, overwrite: bool, source: str) -> bool:
    """Whether an earlier run of the same source has written a log; False without a log."""
    if path is None:
        return False
    from fidsplat.logs import check_log  # here, since it needs other packages

    return check_log(path, overwrite, source)


def require_packages(
    what: str = "a report",
    packages: Sequence[str] = ("pandas", "matplotlib", "jinja2"),
    extra: str = "experiments",
) -> None:
    """Raise InputError if packages of an extra are missing."""
    missing = [name for name in packages if find_spec(name) is None]
    if missing:
        raise InputError(
            f"{' and '.join(missing)} must be installed for {what}; pip install 'fidsplat[{extra}]'"
        )


def check_compressed(outputs: tuple[str, ...]) -> None:
    """Raise InputError if --compress would have no effect on these outputs."""
    if "rgb" not in outputs:
        listed = ",".join(outputs)
        raise InputError(
            f"--compress must have rgb among the outputs, got {listed}; add rgb, or leave it out"
        )


def check_plot(name: str, *packages: str) -> None:
    """Raise InputError for a chart that cannot be written, before measuring.

    packages: required packages in addition to matplotlib.
    """
    if Path(name).suffix.lower() not in (".svg", ".png"):
        raise InputError(f"--plot must be a file that ends in .svg or .png, got {name}")
    require_packages("--plot", ("matplotlib", *packages))
    writable_file(name)
