"""Images of other renderers as external depth images."""

import warp as wp

from .common import STRICT


@wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
def unpack_mesh_images(
    packed: wp.array2d(dtype=wp.uint32),  # (views, pixels) 8 bits per colour
    depths: wp.array2d(dtype=wp.float32),  # [m] along z
    ids: wp.array2d(dtype=wp.int32),  # negative where there is no surface
    red: wp.uint32,  # bit of red: 0 or 16; green is at bit 8
    label: int,  # label of id 0; id i has label - i
    offset: float,  # [m] added to depths
    rgb: wp.array2d(dtype=wp.vec3),  # out
    depth: wp.array2d(dtype=wp.float32),  # out
    labels: wp.array2d(dtype=wp.int32),  # out
):
    view, pixel = wp.tid()
    word, byte = packed[view, pixel], wp.uint32(255)
    blue = wp.uint32(16) - red
    color = wp.vec3(float(word >> red & byte), float(word >> wp.uint32(8) & byte), float(word >> blue & byte))
    rgb[view, pixel] = color / 255.0
    found = ids[view, pixel] >= 0 and depths[view, pixel] > 0.0
    depth[view, pixel] = wp.where(found, depths[view, pixel] + offset, wp.inf)
    labels[view, pixel] = label - wp.max(ids[view, pixel], 0)
