"""Finds the kernels: `kernels/` beside the package in a checkout, `fidsplat/_kernels` in a wheel."""

from pathlib import Path

from fidsplat.util.errors import DeviceError


def kernels_folder() -> Path:
    """The folder that holds `opencl/`.

    Raises:
        DeviceError: neither place has it.
    """
    here = Path(__file__).resolve().parents[1]
    places = (here / "_kernels", here.parent / "kernels")
    for place in places:
        if (place / "opencl").is_dir():
            return place
    raise DeviceError(
        f"the kernels are missing: neither {places[0]} nor {places[1]} is there; reinstall fidsplat"
    )
