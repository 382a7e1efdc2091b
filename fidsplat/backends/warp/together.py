"""Effects that the Warp kernels each have, but not together yet."""

from __future__ import annotations

from collections.abc import Collection

from fidsplat.errors import DeviceError

_LENSES = ("camera_brown_conrady", "camera_fisheye", "camera_equirectangular", "camera_orthographic")
_SKIES = ("background_gradient", "background_panorama")
# boxes before a lens with rays of its own, and a distortion's distances, have names of their own (rays_box,
# ...)
_APART = (
    (_LENSES, _SKIES),
    (("camera_orthographic",), ("footprint_box", "footprint_mixed")),
)


def refuse_strangers(names: Collection[str], turns: bool = False) -> None:
    """Refuse effects that the kernels would draw wrongly together; turns: the camera turns during an
    exposure.

    Raises:
        DeviceError: it names both.
    """
    for one, other in _APART:
        both = [name for group in (one, other) for name in group if name in names]
        if any(name in names for name in one) and any(name in names for name in other):
            raise DeviceError(f"warp does not draw {' with '.join(both)} yet; use an OpenCL device for it")
    asked = [name for name in ("normal_world", *_SKIES) if name in names]
    if turns and asked:
        raise DeviceError(
            f"warp does not draw {', '.join(asked)} for a camera that turns while the picture is taken yet; "
            "use an OpenCL device for it"
        )
