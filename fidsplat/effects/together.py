"""Effects that do not go together, and what to do instead: better no picture than a wrong one."""

from __future__ import annotations

from fidsplat.cameras import Camera
from fidsplat.errors import InputError


def refuse_strangers(foggy: bool, camera: Camera | None, blend_precision: str) -> None:
    """Refuse what one effect cannot do under another.

    Raises:
        InputError: it names both effects and what would do.
    """
    lens = camera.lens.kind if camera is not None and camera.lens else None
    if blend_precision == "float64" and (lens not in (None, "orthographic") or foggy):
        what = "the fog's" if foggy else f"a {lens} lens's"
        raise InputError(
            f"blend_precision='float64' would promise too much: {what} rays are held in float32; take "
            "blend_precision='float32', or a pinhole without fog"
        )
