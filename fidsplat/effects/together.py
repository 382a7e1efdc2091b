"""Effects that do not go together, and what to do instead: better no picture than a wrong one."""

from __future__ import annotations

from collections.abc import Collection

from fidsplat.cameras import Camera
from fidsplat.errors import InputError

_PINHOLE_RAYS = ("distance", "distance_median", "distance_first")


def refuse_strangers(
    footprint: str,
    lowpass: str,
    outputs: Collection[str],
    foggy: bool,
    background: str,
    camera: Camera | None,
    turning: bool,
    blend_precision: str,
) -> None:
    """Refuse what one effect cannot do under another. Names are those of select.py's slots and outputs.

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
    if lens is not None:
        pinhole = f"draw with a pinhole (Camera.pinhole without a lens) instead of the {lens} lens"
        if footprint != "gaussian":
            raise InputError(
                f"boxes (markers of the mixture 'exact') cannot be drawn through a {lens} lens: their edges "
                f"are straight lines only for a pinhole; take the mixture 'fitted', or {pinhole}"
            )
        if lowpass == "pixel":
            raise InputError(
                f"the low-pass 'pixel' knows no {lens} lens: take the low-pass 'screen' or 'none', or "
                f"{pinhole}"
            )
        if background != "constant":
            raise InputError(
                f"a background {background} cannot be seen through a {lens} lens: give one colour, or "
                f"{pinhole}"
            )
    if lens == "brown_conrady":
        asked = ["fog"] if foggy else sorted(set(outputs) & set(_PINHOLE_RAYS))
        if asked:
            raise InputError(
                f"{asked[0]} needs distances along the rays, which a {lens} lens does not give: take a "
                "fisheye lens, or draw with a pinhole (Camera.pinhole without a lens)"
            )
    if turning:
        still = "a shutter and motion under which the camera does not turn, or a picture taken at once"
        if "normal_world" in outputs:
            raise InputError(
                "normal_world cannot be had from a picture whose camera turns while it is taken: ask for "
                f"normal (in the camera's axes), or take {still}"
            )
        if background != "constant":
            raise InputError(
                f"a background {background} cannot be seen by a camera that turns while the picture is "
                f"taken: give one colour, or take {still}"
            )
