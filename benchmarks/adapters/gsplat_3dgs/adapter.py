"""Adapter of gsplat's `rasterization`: 3D Gaussians by EWA, all views of a batch in one call."""

import gsplat
from torch_gpu import TorchAdapter


class Adapter(TorchAdapter):
    settings = {
        "classic": {"ellipsoids": {"ellipsoid": "ewa", "order": "centre"}},
        "antialiased": {"ellipsoids": {"ellipsoid": "ewa_antialiased", "order": "centre"}},
    }

    def __init__(self):
        super().__init__("gsplat 3DGS", gsplat.__version__)

    def draw(self, setting, views):
        splats = self.means, self.quats, self.scales, self.opacities, self.colors
        cameras = self.viewmats[views], self.K.expand(len(views), 3, 3), self.width, self.height
        images, *_ = gsplat.rasterization(*splats, *cameras, packed=False, rasterize_mode=setting)
        return images
