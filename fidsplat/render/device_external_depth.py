"""External depth images of simulators that render with Warp: colours and depths of meshes, which are
composited with the splats."""

from __future__ import annotations

from typing import Any

from fidsplat.backends.warp import runtime
from fidsplat.capture.environment import DeviceExternalDepth, ExternalDepth
from fidsplat.render.renderer import Renderer

MESH_LABEL = -2
"""label of mesh 0 (geom or body) of a simulator; mesh i has MESH_LABEL - i"""
MESH_OFFSET = 2e-3
"""metres by which meshes are offset away from the camera, so that markers on them are visible"""


def device_external_depth(
    renderer: Renderer, packed: Any, depths: Any, ids: Any, size: tuple[int, int], red_bit: int
) -> ExternalDepth:
    """External depth images of all views: on the renderer's device if the arrays are there, else on the host.

    Args:
        packed, depths, ids: wp.arrays (views, pixels): RGB in uint32, 8 bits each, red starts at bit
            `red_bit`; depths along z [m]; int32 ids of meshes, negative where there is none.
        size: height and width of the images.
    """
    wp, device = runtime.load(), packed.device
    images = [wp.empty(packed.shape, dtype=dtype, device=device) for dtype in (wp.vec3, wp.float32, wp.int32)]
    arguments = [packed, depths, ids, red_bit, MESH_LABEL, MESH_OFFSET]
    with runtime.quiet():
        kernel = runtime.kernels("mesh_images").unpack_mesh_images
        wp.launch(kernel, packed.shape, arguments, images, device=device, record_tape=False)
    images = [image.reshape((len(packed), *size)) for image in images]
    if device == getattr(renderer.backend, "device", None):
        return DeviceExternalDepth(*images)
    return ExternalDepth(*(image.numpy() for image in images))
