"""Adapter of Faster-GS (FasterGSCudaBackend of nerficg-project/faster-gaussian-splatting): 3D Gaussians by
EWA, one view per call."""

import numpy as np
import torch
from FasterGSCudaBackend.torch_bindings import RasterizerSettings, rasterize
from torch_gpu import C0, TorchAdapter, pinned


class Adapter(TorchAdapter):
    settings = {"default": {"ellipsoids": {"ellipsoid": "ewa", "order": "centre"}}}

    def __init__(self):
        super().__init__("Faster-GS", pinned(__file__))

    def prepare(self):
        count = len(self.means)
        self.splats = {"means": self.means, "scales": self.scales.log(), "rotations": self.quats}
        self.splats["opacities"] = self.opacities.clamp(1e-7, 1 - 1e-7).logit()[:, None]
        self.splats["sh_coefficients_0"] = ((self.colors - 0.5) / C0)[:, None].contiguous()
        self.splats["sh_coefficients_rest"] = torch.zeros((count, 0, 3), device="cuda")
        (fx, _, cx), (_, fy, cy), _ = self.K.tolist()
        lens = {"focal_x": fx, "focal_y": fy, "center_x": cx, "center_y": cy}
        rest = {"near_plane": 0.01, "far_plane": 1e4, "active_sh_bases": 1, "proper_antialiasing": False}
        rest["bg_color"] = torch.zeros(3, device="cuda")
        positions = self.tensor(np.linalg.inv(self.poses)[:, :3, 3])
        self.cameras = [
            RasterizerSettings(
                w2c=view, cam_position=position, width=self.width, height=self.height, **lens, **rest
            )
            for view, position in zip(self.viewmats, positions, strict=True)
        ]

    def draw(self, setting, views):
        how = {"to_chw": False, "clamp_output": False}
        return [rasterize(**self.splats, rasterizer_settings=self.cameras[view], **how) for view in views]
