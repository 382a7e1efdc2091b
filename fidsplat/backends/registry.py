"""Devices by name. A family of devices is a module with `devices()` and `open_device(selector)`, imported on
first use.
"""

from __future__ import annotations

import os
from importlib import import_module

from fidsplat.backends.base import Backend, DeviceInfo
from fidsplat.backends.caches import ensure_caches
from fidsplat.errors import DeviceError, UnknownDeviceError, unknown

FAMILIES = {
    "opencl": "fidsplat.backends.opencl.device",
    "warp": "fidsplat.backends.warp",
    "reference": "fidsplat.backends.reference",
}
"""family: its module; another family is one more entry; from outside, of one process"""

_STARTED_BY: dict[str, int] = {}
"""family: the process that was the first here to ask its driver for something"""


def open_backend(name: str) -> Backend:
    """Open a device by name: a family (`opencl`, `warp`, `reference`) or `family:part of a platform's or
    device's name`.

    Raises:
        UnknownDeviceError: no such family, or nothing of the family answers to the selector.
        DeviceError: the device is there and cannot be used, or a fork has made it unusable here.
    """
    family, _, selector = str(name).strip().partition(":")
    if family.lower() not in FAMILIES:
        raise UnknownDeviceError(
            f"{unknown('device', family, FAMILIES)}, and their devices, which `fidsplat devices` lists"
        )
    if (family.lower(), selector.lower()) != ("warp", "cpu"):  # which has no driver
        _check_driver(family.lower())
    if family.lower() != "reference":
        ensure_caches()
    return import_module(FAMILIES[family.lower()]).open_device(selector)


def devices() -> list[DeviceInfo]:
    """Every device that can be opened here, and why the others cannot. Raises DeviceError where a fork has
    made a driver unusable."""
    for family in FAMILIES:
        _check_driver(family)
    ensure_caches()
    return [info for module in FAMILIES.values() for info in import_module(module).devices()]


def _check_driver(family: str) -> None:
    """Raises DeviceError where the driver would wait for threads that a fork left behind."""
    started = _STARTED_BY.setdefault(family, os.getpid())
    if family != "reference" and started != os.getpid():
        raise DeviceError(
            f"{family} was started by process {started}, of which this one is a fork, and its driver "
            "does not survive that; open the first Renderer in the workers, or start them by "
            "multiprocessing.get_context('spawn')"
        )
