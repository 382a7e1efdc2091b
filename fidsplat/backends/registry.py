"""Devices by name. A family of devices is a module with `devices()` and `open_device(selector)`, imported on
first use.
"""

from __future__ import annotations

from importlib import import_module

from fidsplat.backends.base import Backend, DeviceInfo
from fidsplat.errors import UnknownDeviceError, unknown

_FAMILIES = {
    "opencl": "fidsplat.backends.opencl.device",
    "warp": "fidsplat.backends.warp",
    "reference": "fidsplat.backends.reference",
}


def open_backend(name: str) -> Backend:
    """Open a device by name: a family (`opencl`, `warp`, `reference`) or `family:part of a platform's or
    device's
    name`.

    Raises:
        UnknownDeviceError: no such family, or nothing of the family answers to the selector.
        DeviceError: the device is there and cannot be used.
    """
    family, _, selector = str(name).strip().partition(":")
    if family.lower() not in _FAMILIES:
        raise UnknownDeviceError(
            f"{unknown('device', family, _FAMILIES)}, and their devices, which `fidsplat devices` lists"
        )
    return import_module(_FAMILIES[family.lower()]).open_device(selector)


def devices() -> list[DeviceInfo]:
    """Every device that can be opened here, and why the others cannot."""
    return [info for module in _FAMILIES.values() for info in import_module(module).devices()]
