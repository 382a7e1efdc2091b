"""Compare fidsplat and gsplat on one NVIDIA GPU, with the same scenes in the same run: disks by
`rasterization_2dgs`, 3D Gaussians (r100k_720p_3d ...) by `rasterization`.

    pip install . torch gsplat       # 1.5.3; the latest: git+https://github.com/nerfstudio-project/gsplat
    python benchmarks/peers/gsplat_cuda.py r100k_720p r1m_1080p r5m_1080p r20m_4k --json gsplat.json

Requires CUDA with a compiler: gsplat builds its kernels on first use (a minute on 16 cores). The driver's
OpenCL must be visible (docs/rendering.md, "Devices"). Splats and images of both stay on the GPU; both are
timed from the call until the GPU is done. gsplat renders with its constants (opacity ceiling 0.999, exclusive
stop), fidsplat with its own, which are more accurate. The PSNR between both with gsplat's constants is
reported too.
"""

from __future__ import annotations

import gsplat
import numpy as np
import torch
from interleaved import arguments, compared, peer_device, report

from fidsplat.cameras import Camera
from fidsplat.capture.quality import Quality
from fidsplat.experiments.bench.catalogue import BENCH_SCENES, scene_names
from fidsplat.experiments.bench.measure import Result, SceneRun
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.timing import Timer
from fidsplat.vision.metrics import psnr

SAME = Quality.named("gsplat").with_(opacity_ceiling=0.999)
"""the constants of gsplat 1.5.3"""


def tensors(cloud: SplatCloud, camera: Camera) -> dict:
    """Arguments of both rasterizations on the GPU: one camera, plain colours, three scales (disks ignore the
    last)."""
    if cloud.colors is None:
        raise SystemExit("gsplat_cuda: the scene must have plain colours; choose another")
    third = np.ones(len(cloud), np.float32) if cloud.thickness is None else cloud.thickness
    scales = np.column_stack([cloud.scales, third])
    arrays = {
        "means": cloud.means + cloud.origin.astype(np.float32),
        "quats": cloud.quats,
        "scales": scales,
        "opacities": cloud.opacities,
        "colors": cloud.colors[None],  # for each camera
        "viewmats": camera.world_to_camera[None],
        "Ks": camera.matrix[None],
    }
    on_gpu = {
        name: torch.tensor(np.asarray(array, np.float32), device="cuda") for name, array in arrays.items()
    }
    return on_gpu | {"width": camera.width, "height": camera.height}


def main() -> None:
    parser = arguments(__doc__, repeats=30, device="opencl:nvidia")
    parser.add_argument("--packed", action="store_true", help="gsplat's packed mode: less memory")
    options = parser.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("gsplat_cuda: PyTorch must have a CUDA device, which gsplat requires")
    facts = torch.cuda.get_device_properties(0)
    version = f"PyTorch {torch.__version__}, CUDA {torch.version.cuda}"
    device = peer_device("cuda:0", facts.name, "CUDA", version, "gpu", facts.multi_processor_count)

    records, names = [], scene_names(options.scenes)
    for name in names:
        cloud, camera = BENCH_SCENES[name].make()
        ours = SceneRun(name, options.device, None, cloud, camera)
        if ours.result.timer.error:
            raise SystemExit(f"gsplat_cuda: {ours.result.timer.error}")
        given = tensors(cloud, camera)
        torch.cuda.reset_peak_memory_stats()

        last = {}  # gsplat's data of the latest frame

        rasterize = gsplat.rasterization_2dgs if cloud.thickness is None else gsplat.rasterization

        def draw(given=given, last=last, rasterize=rasterize):
            with torch.no_grad():
                colors, *_, last["meta"] = rasterize(**given, packed=options.packed)
            torch.cuda.synchronize()
            return _Image(colors)

        size = camera.width, camera.height
        peer = Result(name, device, *size, Timer(draw), renderer=f"gsplat {gsplat.__version__}")
        peer.counts = {"splats": len(cloud)}
        records += compared(ours, peer, draw, max(options.repeats, 1))
        same = ours.renderer.render(ours.resident, camera, quality=SAME)["rgb"]
        records[-1]["psnr_same_constants_db"] = psnr(same, np.asarray(draw()))
        radii, pairs = last["meta"]["radii"], last["meta"]["flatten_ids"]
        visible = (
            radii.reshape(-1, 2).amin(-1) if radii.shape[-1] == 2 else radii.reshape(-1)
        )  # version 1.4: one radius
        records[-1] |= {
            "visible": int((visible > 0).sum()),
            "pairs": int(pairs.shape[0]),
            "memory_bytes": torch.cuda.max_memory_allocated(),
        }
        del given, last, draw, radii, pairs, visible
        torch.cuda.empty_cache()
    report(records, list(names), options.json)


class _Image:
    """An image on the GPU that NumPy can read."""

    def __init__(self, colors: torch.Tensor) -> None:
        self.colors = colors  # (1, h, w, 3)

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return self.colors[0].cpu().numpy()


if __name__ == "__main__":
    main()
