"""What lies behind the splats, as its kernel wants it (kernels/warp/surroundings.py)."""

from __future__ import annotations

from typing import Any

from fidsplat.backends.view import View
from fidsplat.backends.warp.runtime import kernels, load
from fidsplat.backends.warp.workspace import Workspace
from fidsplat.errors import DeviceError
from fidsplat.surroundings import Gradient, Panorama


def surroundings_of(view: View, workspace: Workspace) -> Any:
    """The struct `Surroundings` of a view whose background is not of one colour. A panorama stays on the
    device as long as it lives.

    Raises:
        DeviceError: there is no room for the panorama.
    """
    wp, behind = load(), view.surroundings
    kind = "gradient" if isinstance(behind, Gradient) else "panorama"
    filled = kernels("surroundings").struct_of_surroundings(kind)()
    if isinstance(behind, Gradient):
        numbers = view.uniform("gradient")
        filled.top, filled.bottom, filled.up = (wp.vec3(*numbers[k : k + 3]) for k in (0, 3, 6))
    elif isinstance(behind, Panorama):
        filled.image = _uploaded(behind, workspace)
    return filled


def memory_bytes(view: View) -> int:
    """Bytes that it takes on the device."""
    return view.surroundings.image.nbytes if isinstance(view.surroundings, Panorama) else 0


def _uploaded(panorama: Panorama, workspace: Workspace) -> Any:
    wp, held = load(), workspace.panoramas
    if panorama not in held:
        image = panorama.image
        try:
            held[panorama] = wp.array(image, dtype=wp.vec3, device=workspace.device)
        except (RuntimeError, MemoryError) as error:
            raise DeviceError(
                f"the panorama needs {image.nbytes / 2**20:.0f} MiB, which {workspace.device} has not; use a "
                "smaller one"
            ) from error
    return held[panorama]
