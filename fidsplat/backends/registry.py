"""Registry of devices: opens and lists them by name. A family is a module or package with `devices` and
`open_device`."""

from __future__ import annotations

import os
import warnings
from importlib import import_module

from fidsplat.backends.caches import ensure_caches
from fidsplat.backends.interface import Backend, DeviceInfo
from fidsplat.util.errors import DeviceError, UnknownDeviceError, unknown
from fidsplat.util.limits import check_driver_limits
from fidsplat.util.markup import html_table

FAMILIES = {
    "opencl": "fidsplat.backends.opencl.device",
    "warp": "fidsplat.backends.warp",
    "reference": "fidsplat.backends.reference",
}
"""module of each family; further entries add families"""

AUTO = "auto"
"""name that opens the best device of the first family in `ORDER` that has a usable device"""
ORDER = ("opencl", "warp")

_STARTED_BY: dict[str, int] = {}
"""id of the process in which the driver of each family was first used"""


def open_backend(name: str) -> Backend:
    """Open a device by name: `auto`, a family (`opencl`, `warp`, `reference`) or `family:selector`. Raises
    UnknownDeviceError if no device matches, and DeviceError if it cannot be used."""
    family, _, selector = str(name).strip().partition(":")
    family = family.lower()
    if (family, selector) == (AUTO, ""):
        return _open_first()
    if family not in FAMILIES:
        raise UnknownDeviceError(
            f"{unknown('device', family, FAMILIES)}, and their devices, which `fidsplat devices` lists"
        )
    _prepare(family, selector)
    return import_module(FAMILIES[family]).open_device(selector)


class Devices(list[DeviceInfo]):
    """Devices, which notebooks show as a table."""

    def _repr_html_(self) -> str:
        rows = ((one.name, one.title, "yes" if one.usable else "no", one.reason) for one in self)
        return html_table(("device", "title", "usable", "remark"), rows)


def devices() -> Devices:
    """List all devices, and why some are unusable. Raises DeviceError in a fork of a process that used a
    driver."""
    for family in FAMILIES:
        _prepare(family)
    return Devices(info for module in FAMILIES.values() for info in import_module(module).devices())


def _open_first() -> Backend:
    """Open the best device of the first family in `ORDER` with a usable device; warn of skipped families."""
    reasons = []
    for family in ORDER:
        _prepare(family)
        try:
            backend = import_module(FAMILIES[family]).open_device("")
        except DeviceError as error:
            reasons.append(str(error))
            continue
        if reasons:
            warnings.warn(f"{'; '.join(reasons)}; {backend.info.name} is used instead", stacklevel=4)
        return backend
    raise DeviceError("; ".join(reasons))


def _prepare(family: str, selector: str = "") -> None:
    """Refuse a family whose driver cannot be used in this process, and provide folders for its caches."""
    if family == "reference":
        return
    if (family, selector.lower()) != ("warp", "cpu"):  # warp:cpu has no driver
        _refuse_fork(family)
    check_driver_limits(family)
    ensure_caches()


def _refuse_fork(family: str) -> None:
    """Raise DeviceError in a fork, where the driver would wait for threads of the parent."""
    started = _STARTED_BY.setdefault(family, os.getpid())
    if started != os.getpid():
        raise DeviceError(
            f"the driver of {family} must be first used in the process that renders, got a fork of process "
            f"{started}, which used it before; open the first Renderer in the workers, or start them with "
            "multiprocessing.get_context('spawn')"
        )
