"""Adapter of HiGS, the inference renderer of gsplat 1.6 (built with BUILD_EXPERIMENTAL=1): 3D Gaussians by
EWA in half precision, one view per call."""

import gsplat
from gsplat.experimental.render.components.gaussian_inference_renderer import GaussianInferenceRenderer
from gsplat.scene import GaussianInferenceScene
from torch_gpu import TorchAdapter


class Adapter(TorchAdapter):
    settings = {"tiles of 8": {"ellipsoids": {"ellipsoid": "ewa", "order": "centre"}}}

    def __init__(self):
        super().__init__("HiGS", gsplat.__version__)

    def prepare(self):
        splats = self.means, self.quats, self.scales, self.opacities, self.colors
        scene = GaussianInferenceScene.from_gaussian_tensors(*splats, None, "none", id="scene")
        self.renderer = GaussianInferenceRenderer(scene, tile_size=8)

    def draw(self, setting, views):
        camera = {"K": self.K, "width": self.width, "height": self.height}
        frames = (self.renderer.render(viewmat=self.viewmats[view], **camera).frame for view in views)
        # its buffers are reused by the next frame
        return [frame if len(views) == 1 else frame.clone() for frame in frames]
