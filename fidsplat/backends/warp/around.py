"""What lies behind the splats, as the kernels want it (kernels/warp/surroundings.py)."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

from fidsplat.backends.view import View
from fidsplat.backends.warp import runtime
from fidsplat.errors import DeviceError
from fidsplat.surroundings import Gradient, Panorama

if TYPE_CHECKING:
    from fidsplat.backends.warp.backend import WarpBackend


class Surroundings:
    """The kernel of one kind of background, and its struct. A panorama stays on the device as long as it
    lives."""

    def __init__(self, backend: WarpBackend, kind: str, bent: bool) -> None:
        kernels = runtime.kernels("surroundings")
        self._backend = backend
        self._type = kernels.make_around(kind)
        self.kernel = kernels.make_backdrop(kind, bent)

    @classmethod
    def among(cls, names: Collection[str], backend: WarpBackend) -> Surroundings | None:
        """That of the effects with these names; None if what lies behind everything is of one colour."""
        for kind in runtime.kernels("surroundings").KINDS:
            if f"background_{kind}" in names:
                return cls(backend, kind, "rays" in names)
        return None

    def of(self, view: View) -> Any:
        """The struct for this view.

        Raises:
            DeviceError: there is no room for the panorama.
        """
        wp = runtime.load()
        around, behind = self._type(), view.surroundings
        if isinstance(behind, Gradient):
            numbers = view.uniform("gradient")
            around.top, around.bottom, around.up = (wp.vec3(*numbers[k : k + 3]) for k in (0, 3, 6))
        elif isinstance(behind, Panorama):
            around.image = self._uploaded(behind)
        return around

    def nbytes(self, view: View) -> int:
        """Bytes that it takes on the device."""
        return view.surroundings.image.nbytes if isinstance(view.surroundings, Panorama) else 0

    def _uploaded(self, panorama: Panorama) -> Any:
        wp, held = runtime.load(), self._backend.panoramas
        if panorama not in held:
            image = panorama.image
            try:
                held[panorama] = wp.array(image, dtype=wp.vec3, device=self._backend.device)
            except (RuntimeError, MemoryError) as error:
                raise DeviceError(
                    f"the panorama needs {image.nbytes / 2**20:.0f} MiB, which {self._backend.info.name} has "
                    "not; use a smaller one"
                ) from error
        return held[panorama]
