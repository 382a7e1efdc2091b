"""gsplat's `rasterization_2dgs`: disks, all views of a batch in one call."""

import gsplat
from torch_gpu import TorchAdapter


class Adapter(TorchAdapter):
    settings = {"default": {"disks": {"order": "centre"}}}

    def __init__(self):
        super().__init__("gsplat 2DGS", gsplat.__version__)

    def draw(self, setting, views):
        splats = self.means, self.quats, self.scales, self.opacities
        colors = self.colors.expand(len(views), *self.colors.shape)
        cameras = self.viewmats[views], self.K.expand(len(views), 3, 3), self.width, self.height
        # 1.6 refuses several cameras unpacked
        images, *_ = gsplat.rasterization_2dgs(*splats, colors, *cameras, packed=len(views) > 1)
        return images
