"""External depth images of simulators that render with Warp."""

from __future__ import annotations

from typing import Any

from fidsplat.backends.warp.runtime import kernels, load, quiet
from fidsplat.capture.environment import DeviceExternalDepth, ExternalDepth
from fidsplat.render.renderer import Renderer


def device_surface(
    renderer: Renderer,
    packed: Any,
    depths: Any,
    ids: Any,
    size: tuple[int, int],
    *,
    red: int,
    label: int,
    offset: float,
) -> ExternalDepth:
    """External depth images of all views, from arrays of a Warp device; on a Warp renderer of this device
    without a copy to the host.

    Args:
        packed: wp.array (views, pixels) uint32, colours of 8 bits.
        depths: wp.array (views, pixels) float32, metres along z.
        ids: wp.array (views, pixels) int32, id of the surface, negative for none.
        size: rows and columns of pixels.
        red: shift of red in `packed`, 0 or 16.
        label: label of id 0; id i has label - i.
        offset: metres by which surfaces are moved away from the camera.
    """
    wp, device = load(), packed.device
    made = [wp.empty(packed.shape, dtype=dtype, device=device) for dtype in (wp.vec3, wp.float32, wp.int32)]
    given = [packed, depths, ids, red, label, offset]
    with quiet():
        kernel = kernels("surfaces").unpack_surfaces
        wp.launch(kernel, packed.shape, given, made, device=device, record_tape=False)
    shaped = [each.reshape((len(packed), *size)) for each in made]
    if device == getattr(renderer.backend, "device", None):
        return DeviceExternalDepth(*shaped)
    return ExternalDepth(*(each.numpy() for each in shaped))
