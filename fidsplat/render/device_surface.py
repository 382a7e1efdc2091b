"""External depth images of simulators that render with Warp."""

from __future__ import annotations

from typing import Any

from fidsplat.backends.warp.runtime import kernels, load, quiet
from fidsplat.capture.environment import DeviceExternalDepth, ExternalDepth
from fidsplat.render.renderer import Renderer

MESH = -2
"""label of surface 0 of a simulator; surface i has MESH - i"""
MESH_OFFSET = 2e-3
"""metres by which surfaces of simulators are offset away from the camera"""


def device_surface(
    renderer: Renderer, packed: Any, depths: Any, ids: Any, size: tuple[int, int], red: int
) -> ExternalDepth:
    """External depth images of all views from wp.arrays (views, pixels): colours packed in uint32 with red at
    the bit `red`, depths along z, and int32 ids of surfaces, negative for none. They stay on the renderer's
    device."""
    wp, device = load(), packed.device
    made = [wp.empty(packed.shape, dtype=dtype, device=device) for dtype in (wp.vec3, wp.float32, wp.int32)]
    given = [packed, depths, ids, red, MESH, MESH_OFFSET]
    with quiet():
        kernel = kernels("surfaces").unpack_surfaces
        wp.launch(kernel, packed.shape, given, made, device=device, record_tape=False)
    shaped = [each.reshape((len(packed), *size)) for each in made]
    if device == getattr(renderer.backend, "device", None):
        return DeviceExternalDepth(*shaped)
    return ExternalDepth(*(each.numpy() for each in shaped))
