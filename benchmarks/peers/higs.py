"""Compare interleaved frames of fidsplat, gsplat and HiGS on one NVIDIA GPU, for random and captured scenes.

    python benchmarks/peers/higs.py r1m_1080p biker.compressed.ply playbot/0_0/meta.json --json higs.json

HiGS is the inference renderer of gsplat's main branch (gsplat.experimental.render, BUILD_EXPERIMENTAL=1):
3D Gaussians, half precision, CUDA. Random scenes are disks for fidsplat and `rasterization_2dgs`, and flat 3D
Gaussians for HiGS. Captured scenes (files) are 3D Gaussians with plain colours, in a far, a middle and a near
view of 1920 x 1080. Splats and images stay on the GPU; times end when it is done. fidsplat renders with the
cut-off 1/255 and the stop 1e-4, captured scenes with all constants of gsplat, and with the changes of
--ours. PSNR is against fidsplat's first setting.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import gsplat
import numpy as np
import torch
from gsplat.experimental.render.components.gaussian_inference_renderer import GaussianInferenceRenderer
from gsplat.scene import GaussianInferenceScene

import fidsplat as fs
from fidsplat.capture.quality import Quality
from fidsplat.formats import load_splats
from fidsplat.scenes.random_clouds import SCENES, load_scene
from fidsplat.splats.harmonics import C0
from fidsplat.util.timing import Timer, frame_timer, ratios, time_interleaved
from fidsplat.vision.metrics import psnr

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from measuring import PROGRESS, keep, options, show

RANDOM, CAPTURED = f"alpha_cutoff={1 / 255}", "gsplat"
"""fidsplat's settings for both kinds of scenes"""
CHANGES = (
    "",
    "arithmetic=approximate",
    "blend_precision=float16",
    "blend_precision=float16,arithmetic=approximate,setup_precision=float32",
)
VIEWS = {"far": 2.2, "middle": 1.2, "near": 0.5}
"""distance of the camera from the median splat, in radii that hold 95 % of the splats"""
DIRECTION = np.array([0.6, -0.3, -0.74])


def captured(file: str) -> Iterator[tuple[str, fs.SplatCloud, fs.Camera]]:
    """Views of a captured scene, with plain colours."""
    cloud = load_splats(file)
    means = cloud.means + cloud.origin.astype(np.float32)
    colors = cloud.colors
    if colors is None:
        colors = np.clip(cloud.sh[:, 0] * C0 + 0.5, 0, None)
    thickness = np.zeros(len(cloud)) if cloud.thickness is None else cloud.thickness
    scales = np.column_stack([cloud.scales, thickness])
    plain = fs.SplatCloud(means, cloud.quats, scales, cloud.opacities, colors=colors)
    middle = np.median(means, axis=0)
    radius = float(np.percentile(np.linalg.norm(means - middle, axis=1), 95))
    name = Path(file).name.split(".")[0] if Path(file).stem != "meta" else Path(file).parents[1].name
    for view, distance in VIEWS.items():
        position = tuple(middle + distance * radius * DIRECTION)
        yield (
            f"{name} {view}",
            plain,
            fs.Camera.look_at(1920, 1080, 1.0, position=position, target=tuple(middle)),
        )


def tensors(cloud: fs.SplatCloud, camera: fs.Camera) -> dict:
    """Arguments of both rasterizations on the GPU: one camera, plain colours, three scales (disks ignore the
    last)."""
    colors = cloud.colors
    assert colors is not None
    third = np.ones(len(cloud)) if cloud.thickness is None else cloud.thickness
    arrays = {
        "means": cloud.means + cloud.origin,
        "quats": cloud.quats,
        "scales": np.column_stack([cloud.scales, third]),
        "opacities": cloud.opacities,
        "colors": colors[None],  # for each camera
        "viewmats": camera.world_to_camera[None],
        "Ks": camera.matrix[None],
    }
    on_gpu = {
        name: torch.tensor(np.asarray(array, np.float32), device="cuda") for name, array in arrays.items()
    }
    return on_gpu | {"width": camera.width, "height": camera.height}


def peers(cloud: fs.SplatCloud, camera: fs.Camera) -> dict[str, Callable[[], torch.Tensor]]:
    """Functions by renderer that render a frame (h, w, 3) and wait for the GPU."""
    given = tensors(cloud, camera)
    disks = cloud.thickness is None
    rasterize = gsplat.rasterization_2dgs if disks else gsplat.rasterization
    scales = given["scales"].clone()
    if disks:
        scales[:, 2] = 1e-6
    quats = torch.nn.functional.normalize(given["quats"], dim=-1)
    scene = GaussianInferenceScene.from_gaussian_tensors(
        given["means"],
        quats,
        scales,
        given["opacities"],
        given["colors"][0].contiguous(),
        None,
        "none",
        id="a",
    )
    higs = GaussianInferenceRenderer(scene, tile_size=8)

    def of_gsplat() -> torch.Tensor:
        image = rasterize(**given, packed=False)[0][0]
        torch.cuda.synchronize()
        return image

    def of_higs() -> torch.Tensor:
        size = {"width": camera.width, "height": camera.height}
        frame = higs.render(viewmat=given["viewmats"][0], K=given["Ks"][0], **size).frame
        torch.cuda.synchronize()
        return frame.reshape(camera.height, camera.width, -1)[..., :3]

    return {"gsplat": of_gsplat, "HiGS": of_higs}


@torch.no_grad()
def measure(name: str, cloud: fs.SplatCloud, camera: fs.Camera, options, ours: list[str]) -> list[dict]:
    """Records of a scene by renderer."""
    renderer = fs.Renderer(options.device)
    resident = renderer.upload(cloud)
    captures = {f"fidsplat {each}": fs.Capture(camera, quality=Quality.of(each)) for each in ours}
    images = {
        each: np.asarray(renderer.render(resident, capture)["rgb"]) for each, capture in captures.items()
    }
    timers = {each: frame_timer(renderer, resident, capture) for each, capture in captures.items()}
    others = peers(cloud, camera)
    images |= {each: draw().float().cpu().numpy() for each, draw in others.items()}
    timers |= {each: Timer(draw, parts=lambda image: {}) for each, draw in others.items()}
    time_interleaved(list(timers.values()), options.repeats, warm_up=6)
    return [
        {
            "scene": name,
            "renderer": each,
            "splats": len(cloud),
            "frame_ms": timer.median,
            "quartiles_ms": timer.quartiles[::2],
            "fastest_ms": min(timer.ms),
            "over_higs": float(np.median(ratios(timer, timers["HiGS"]))),
            "stages_ms": timer.part_medians,
            "psnr_db": psnr(np.clip(images[each], 0, 1), np.clip(images[f"fidsplat {ours[0]}"], 0, 1)),
        }
        for each, timer in timers.items()
    ]


def main() -> None:
    parser = options(__doc__, device="opencl:nvidia", repeats=40)
    parser.add_argument("scenes", nargs="+", help="random scenes by name, and files of captured scenes")
    parser.add_argument("--ours", nargs="+", default=CHANGES, help="changes of fidsplat's quality settings")
    given = parser.parse_args()
    records = []
    for scene in given.scenes:
        random = scene in SCENES
        base = RANDOM if random else CAPTURED
        ours = [f"{base},{change}".rstrip(",") for change in given.ours]
        for name, cloud, camera in [(scene, *load_scene(scene))] if random else captured(scene):
            records += measure(name, cloud, camera, given, ours)
            for record in records[-len(given.ours) - 2 :]:
                PROGRESS.print(f"{name} {record['renderer']}: {record['frame_ms']:.3f} ms")
            gc.collect()
            torch.cuda.empty_cache()
    facts = {"device": torch.cuda.get_device_name(), "gsplat": gsplat.__version__, "fidsplat": fs.__version__}
    if not keep({**facts, "results": records}, given.json):
        rows = [
            (
                record["scene"],
                record["renderer"],
                f"{record['frame_ms']:.3f}",
                f"{record['over_higs']:.2f}",
                f"{record['psnr_db']:.1f}",
            )
            for record in records
        ]
        show("Milliseconds per frame", ("scene", "renderer", "ms", "over HiGS", "PSNR, dB"), rows)


if __name__ == "__main__":
    main()
