"""Compare batches of disks of fidsplat and gsplat on one NVIDIA GPU, with the same views in the same run.

    pip install . torch gsplat       # 1.5.3 or 1.6
    python benchmarks/peers/gsplat_batches.py --rows scenes --json gsplat-batches.json

Requires CUDA with a compiler. gsplat renders with its constants (opacity ceiling 0.999, exclusive stop), and
the fastest number of cameras per call of CAMERAS by `rasterization_2dgs`, with colours and the outputs that
it always computes, median depth included (mean depth takes longer); it has no labels. fidsplat renders the
outputs of the row as in benchmarks/batches.py, the same with gsplat's constants and a float32 projection, and
gsplat's outputs with these. gsplat's images are discarded after each call, fidsplat's are retained. Times are
from the first call until the GPU is done.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import gsplat
import numpy as np
import torch

import fidsplat as fs
from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.util.timing import Timer, time_interleaved
from fidsplat.vision.metrics import psnr

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from batches import ROWS, scene_of
from measuring import PROGRESS, facts, keep, options, show

CAMERAS = 4, 16, 64, 256
"""cameras per call of gsplat"""
SAME = fs.Quality.named("gsplat").with_(opacity_ceiling=0.999)
"""the constants of gsplat 1.5.3"""
PACKED = gsplat.__version__ >= "1.6"
"""whether gsplat's packed mode is used: from 1.6 on the other one fails with several cameras ("opacities must
be contiguous")"""
ITS_OUTPUTS = "rgb", "alpha", "normal", "depth_median"
"""outputs that gsplat always computes, by fidsplat's names"""


def on_gpu(array: np.ndarray) -> torch.Tensor:
    """A float32 tensor on the GPU."""
    return torch.tensor(np.asarray(array, np.float32), device="cuda")


def peer(cloud: fs.SplatCloud, capture: fs.Capture, poses: np.ndarray) -> Callable[[int], torch.Tensor]:
    """Function that renders all views by gsplat with a number of cameras per call; it returns the first view
    (h, w, 3)."""
    camera, colors = capture.camera, cloud.colors
    if camera is None or colors is None:
        raise SystemExit("gsplat_batches: the batch must have plain colours and a camera")
    poses_of_camera = np.tile(np.eye(4), (len(poses), 1, 1))
    poses_of_camera[:, :3, :3], poses_of_camera[:, :3, 3] = quaternion_to_matrix(poses[:, 3:]), poses[:, :3]
    views = on_gpu(np.linalg.inv(poses_of_camera))
    matrix = on_gpu(camera.matrix)
    given = {
        "means": on_gpu(cloud.means + cloud.origin),
        "quats": on_gpu(cloud.quats),
        "scales": on_gpu(np.column_stack([cloud.scales, np.ones(len(cloud))])),
        "opacities": on_gpu(cloud.opacities),
        "width": camera.width,
        "height": camera.height,
        "packed": PACKED,
    }
    rgb = on_gpu(colors)

    def draw(cameras: int) -> torch.Tensor:
        first = None
        for some in views.split(cameras):
            each = {"viewmats": some, "Ks": matrix.expand(len(some), 3, 3)}
            each["colors"] = rgb.expand(len(some), *rgb.shape)
            images, *_ = gsplat.rasterization_2dgs(**given, **each)
            first = images[0].clone() if first is None else first
        torch.cuda.synchronize()
        assert first is not None
        return first

    return torch.no_grad()(draw)


def captures_of(capture: fs.Capture) -> list[fs.Capture]:
    """Captures of fidsplat's measurements."""
    same = capture.with_(quality=SAME.with_(projection_precision="float32"))
    return [capture, same, same.with_(outputs=ITS_OUTPUTS)]


def times_by_cameras(draw: Callable[[int], torch.Tensor]) -> dict[int, float]:
    """Milliseconds of gsplat by number of cameras per call, up to the limit of memory."""
    found = {}
    for cameras in CAMERAS:
        try:
            draw(cameras)  # allocations on first use are not timed
            found[cameras] = Timer(lambda cameras=cameras: draw(cameras)).run()
        except torch.cuda.OutOfMemoryError:
            break
        finally:
            torch.cuda.empty_cache()
    return found


def measure(renderer: fs.Renderer, name: str, repeats: int) -> list[dict]:
    """Figures of a row per view: records of fidsplat, each followed by gsplat's."""
    row = ROWS[name]
    cloud, capture, poses = scene_of(row)
    resident, draw = renderer.upload(cloud), peer(cloud, capture, poses)
    captures = captures_of(capture)
    ours = [
        Timer(lambda taken=taken: renderer.render_batch(resident, taken, poses=poses).wait())
        for taken in captures
    ]
    for timer in ours:
        timer.run(timed=False)
    by_cameras = times_by_cameras(draw)
    best = min(by_cameras, key=by_cameras.__getitem__)
    theirs = Timer(lambda: draw(best))
    time_interleaved([*ours, theirs], repeats)
    same = renderer.render_batch(resident, capture.with_(quality=SAME, outputs=("rgb",)), poses=poses[:1])
    error = psnr(same["rgb"][0], draw(best).cpu().numpy())

    def record(who: str, timer: Timer, outputs: tuple[str, ...]) -> dict:
        low, middle, high = (1e3 * each / row.views for each in timer.quartiles)
        return {
            "batch": name,
            **{what: getattr(row, what) for what in ("views", "splats", "width", "height")},
            "renderer": who,
            "us_per_view": middle,
            "quartiles_us": [low, high],
            "repeats": repeats,
            "outputs": list(outputs),
            **facts(renderer),
        }

    its = record(f"gsplat {gsplat.__version__}", theirs, ITS_OUTPUTS) | {
        "cameras": best,
        "us_per_view_by_cameras": {each: 1e3 * ms / row.views for each, ms in by_cameras.items()},
        "psnr_same_constants_db": error,
    }
    records = []
    for timer, taken in zip(ours, captures, strict=True):
        own = record(f"fidsplat {fs.__version__}", timer, taken.outputs)
        single = taken.quality.projection_precision == "float32"
        own["constants"] = "its, float32" if single else "batches.py's"
        records += [own, its | {"times_ours": its["us_per_view"] / own["us_per_view"]}]
    return records


def main() -> None:
    parser = options(__doc__, "opencl:nvidia", repeats=5)
    parser.add_argument("--rows", nargs="*", default=["scenes"], choices=[*ROWS], metavar="ROW")
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("gsplat_batches: PyTorch must have a CUDA device, which gsplat requires")
    renderer, records = fs.Renderer(arguments.device), []
    for name in arguments.rows:
        with PROGRESS.status(f"rendering {name}"):
            records += measure(renderer, name, max(arguments.repeats, 1))
    if keep(records, arguments.json):
        return

    def cells(record: dict) -> tuple[str, ...]:
        size = f"{record['views']} x {record['width']} x {record['height']}"
        times = record.get("times_ours")
        rate = f"{1e6 / record['us_per_view']:,.0f}"
        return (
            size,
            record["renderer"],
            record.get("constants", ""),
            ", ".join(record["outputs"]),
            rate,
            "" if times is None else f"{times:.1f}",
        )

    show(
        renderer.device.title,
        ("views", "renderer", "constants", "outputs", "a second", "times ours"),
        map(cells, records),
    )


if __name__ == "__main__":
    main()
