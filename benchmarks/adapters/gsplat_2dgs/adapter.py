"""Adapter of gsplat's `rasterization_2dgs`: disks, one view per call.

gsplat 1.6 fails for several cameras per call: unpacked, it expands opacities to a tensor that is not
contiguous; packed, it indexes colours by visible pairs, beyond the number of splats.
"""

import gsplat
from torch_gpu import TorchAdapter


class Adapter(TorchAdapter):
    settings = {"default": {"disks": {"order": "centre"}}}

    def __init__(self):
        super().__init__("gsplat 2DGS", gsplat.__version__)

    def draw(self, setting, views):
        splats = self.means, self.quats, self.scales, self.opacities, self.colors[None]
        size = self.width, self.height
        cameras = ((self.viewmats[view][None], self.K[None]) for view in views)
        return [gsplat.rasterization_2dgs(*splats, *camera, *size)[0] for camera in cameras]
