"""Adapter of the 2DGS authors' rasterizer: disks, one view per call, principal point at the image centre."""

import torch
from diff_surfel_rasterization import GaussianRasterizationSettings, GaussianRasterizer
from torch_gpu import TorchAdapter, pinned

NEAR, FAR = 0.2, 100.0  # metres, the authors' values


class Adapter(TorchAdapter):
    settings = {"default": {"disks": {"order": "centre"}}}

    def __init__(self):
        super().__init__("2DGS authors", pinned(__file__))

    def prepare(self):
        slopes = self.width / (2 * float(self.K[0, 0])), self.height / (2 * float(self.K[1, 1]))
        projection = torch.zeros((4, 4), device="cuda")
        projection[0, 0], projection[1, 1], projection[3, 2] = 1 / slopes[0], 1 / slopes[1], 1
        projection[2, 2], projection[2, 3] = FAR / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR)
        fixed = {"image_height": self.height, "image_width": self.width}
        fixed |= {"tanfovx": slopes[0], "tanfovy": slopes[1], "bg": torch.zeros(3, device="cuda")}
        fixed |= {"scale_modifier": 1.0, "sh_degree": 0, "prefiltered": False, "debug": False}
        if "near_n" in GaussianRasterizationSettings._fields:
            fixed |= {"near_n": NEAR, "far_n": FAR}
        self.rasterizers = []
        for view in self.viewmats:
            matrices = {"viewmatrix": view.T.contiguous(), "projmatrix": (projection @ view).T.contiguous()}
            settings = GaussianRasterizationSettings(
                **fixed, **matrices, campos=torch.inverse(view)[:3, 3].contiguous()
            )
            self.rasterizers.append(GaussianRasterizer(settings))
        self.splats = {"means3D": self.means, "means2D": torch.zeros_like(self.means)}
        self.splats |= {"opacities": self.opacities[:, None], "colors_precomp": self.colors}
        self.splats |= {"rotations": self.quats, "scales": self.scales[:, :2].contiguous()}

    def draw(self, setting, views):
        return [self.rasterizers[view](**self.splats)[0].permute(1, 2, 0) for view in views]
