"""Base class of adapters of PyTorch renderers on an NVIDIA GPU; subclasses define `settings` and `draw`."""

from pathlib import Path

import numpy as np
import torch

C0 = 0.28209479177387814  # value of the constant spherical harmonic


def pinned(adapter):
    """Commit in an adapter's requirements.txt (after the last @), for packages without a version."""
    text = Path(adapter).with_name("requirements.txt").read_text("utf-8")
    return text.rpartition("@")[2].partition("#")[0].strip()


class TorchAdapter:
    """Splats as tensors on the GPU: means, quats (w, x, y, z), scales (n, 3), opacities, colors, viewmats (v,
    4, 4), K (3, 3); width, height, poses (v, 4, 4) in float64."""

    def __init__(self, renderer, version):
        if not torch.cuda.is_available():
            raise RuntimeError("PyTorch must have a CUDA device, got none")
        self.facts = {"renderer": renderer, "version": version, "kind": "gpu"}
        self.facts["device"] = torch.cuda.get_device_properties(0).name
        self.facts["driver"] = f"PyTorch {torch.__version__}, CUDA {torch.version.cuda}"
        self.begin, self.end = (torch.cuda.Event(enable_timing=True) for _ in range(2))

    def tensor(self, array):
        return torch.tensor(np.ascontiguousarray(array, np.float32), device="cuda")

    def load(self, scene):
        scales, quats = scene["scales"], scene["quats"]
        if scales.shape[1] == 2:  # disks; 3D renderers do not declare them
            scales = np.column_stack([scales, np.ones(len(scales))])
        self.scales = self.tensor(scales)
        self.quats = self.tensor(quats / np.linalg.norm(quats, axis=1, keepdims=True))
        self.means, self.opacities, self.colors = (
            self.tensor(scene[name]) for name in ("means", "opacities", "colors")
        )
        self.poses, self.viewmats = scene["poses"], self.tensor(scene["poses"])
        self.K = self.tensor(scene["matrix"])
        self.width, self.height = map(int, scene["size"])
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
        self.prepare()

    def prepare(self):
        """Construct the renderer's objects for a scene, if there are any."""

    def render(self, setting, views):
        with torch.no_grad():
            self.begin.record()
            images = self.draw(setting, views)
            self.end.record()
            torch.cuda.synchronize()
        return images

    def device_ms(self, images):
        return self.begin.elapsed_time(self.end)

    def read(self, images):
        size = self.height, self.width, -1
        return np.stack([image.float().cpu().numpy().reshape(size)[..., :3] for image in images])

    def memory(self):
        return torch.cuda.max_memory_allocated()
