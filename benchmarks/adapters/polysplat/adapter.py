"""Adapter of PolySplat (LuoLongZan/PolySplat, its folder on PYTHONPATH): 3D Gaussians by EWA, 8-bit images,
one view per call, principal point at the image centre. The pipeline is as in PolySplat's benchmark."""

from types import SimpleNamespace

import numpy as np
import torch
from example import Rasterizer
from polysplat import ops  # noqa: F401 an ImportError where the extension was not built
from torch_gpu import C0, TorchAdapter, pinned


class Adapter(TorchAdapter):
    settings = {"fused": {"ellipsoids": {"ellipsoid": "ewa", "order": "centre"}}}

    def __init__(self):
        super().__init__("PolySplat", pinned(__file__))

    def prepare(self):
        w, x, y, z = self.quats.T
        rotation = torch.stack(
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
             2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
             2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1
        ).reshape(-1, 3, 3)  # fmt: skip
        half = rotation * self.scales[:, None]
        i, j = np.triu_indices(3)
        shs = torch.zeros((len(self.means), 48), device="cuda")
        shs[:, :3] = (self.colors - 0.5) / C0
        self.scene = SimpleNamespace(device=torch.device("cuda:0"), num_vertex=len(self.means))
        self.scene.position, self.scene.opacity, self.scene.shs = self.means, self.opacities, shs
        self.scene.shs_half, self.scene.cov3d = shs.half(), (half @ half.mT)[:, i, j].contiguous()
        self.rasterizer, self.background = Rasterizer(self.scene, 2**27, 2**20), torch.zeros(3)
        self.cameras = []
        for pose in np.linalg.inv(self.poses).astype(np.float32):
            camera = SimpleNamespace(width=self.width, height=self.height, zNear=0.01, zFar=100.0)
            camera.focal_x, camera.focal_y = float(self.K[0, 0]), float(self.K[1, 1])
            camera.position, camera.rotation = torch.tensor(pose[:3, 3]), torch.tensor(pose[:3, :3].copy())
            self.cameras.append(camera)

    def draw(self, setting, views):
        how, forward = {"render_variant": "preranges_smem_persistent_lite_e2e"}, self.rasterizer.forward
        images = [forward(self.scene, self.cameras[view], self.background, **how) for view in views]
        return images if len(views) == 1 else [image.clone() for image in images]

    def read(self, images):
        return super().read([image / 255.0 for image in images])
