"""Effects that the Warp kernels each have, but not together yet."""

from __future__ import annotations

from collections.abc import Collection

from fidsplat.errors import DeviceError

# boxes before a lens with rays of its own have a name of their own (rays_box)
_APART = ((("camera_orthographic",), ("footprint_box", "footprint_mixed")),)


def refuse_strangers(names: Collection[str]) -> None:
    """Refuse effects that the kernels would draw wrongly together.

    Raises:
        DeviceError: it names both.
    """
    for one, other in _APART:
        both = [name for group in (one, other) for name in group if name in names]
        if any(name in names for name in one) and any(name in names for name in other):
            raise DeviceError(f"warp does not draw {' with '.join(both)} yet; use an OpenCL device for it")
