"""fidsplat beside Mitsuba 3 on the processor, the same scenes in the same run.

    pip install . mitsuba
    DRJIT_LIBLLVM_PATH=.../libLLVM-19.so python benchmarks/peers/mitsuba_cpu.py r100k_720p --json mitsuba.json

Mitsuba's variant llvm_ad_rgb compiles with the system's LLVM. LLVM 15, the default of Debian 12, aborts on
its code ("Cannot select: fminimum"); LLVM 19 works, and need not be installed: the package can be unpacked
anywhere (`apt-get download libllvm19 && dpkg -x libllvm19*.deb DIR`).

Nothing on processors draws 2D splats but us. The nearest in meaning is the shape `ellipsoidsmesh` with the
integrator `volprim_rf_basic`: ray-traced Gaussians in the order in which the ray meets them. Splats become
ellipsoids of 0.1 mm thickness, with the plugin's own extent of 3 standard deviations, one sample in the
middle of each pixel and at most 64 fragments per pixel, its default. The picture stays in Mitsuba's memory.
"""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
from turns import arguments, compared, peer_device, report

from fidsplat.cameras import Camera
from fidsplat.experiments.bench.catalogue import BENCH_SCENES, scene_names
from fidsplat.experiments.bench.measure import Result, SceneRun
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.timing import Timer

THICKNESS = 1e-4  # metres, standard deviation
C0 = 0.28209479177387814  # of the constant spherical harmonic


def mitsuba_scene(cloud: SplatCloud, camera: Camera) -> dict:
    """The cloud and the camera in Mitsuba's words."""
    if cloud.colors is None:
        raise SystemExit("mitsuba_cpu: this scene has colours that depend on the view; choose another")
    count = len(cloud)
    scales = np.concatenate([cloud.scales, np.full((count, 1), THICKNESS, np.float32)], 1)
    means = cloud.means + cloud.origin.astype(np.float32)
    data = np.concatenate([means, scales, cloud.quats[:, [1, 2, 3, 0]]], 1)  # Mitsuba: x y z w
    fov_x = math.degrees(2 * math.atan(camera.width / 2 / camera.fx))
    return {
        "type": "scene",
        "integrator": {"type": "volprim_rf_basic", "srgb_primitives": False},
        "splats": {
            "type": "ellipsoidsmesh",
            "data": mi.TensorXf(np.ascontiguousarray(data, np.float32)),
            "opacities": mi.TensorXf(np.ascontiguousarray(cloud.opacities[:, None])),
            "sh_coeffs": mi.TensorXf(np.ascontiguousarray((cloud.colors - 0.5) / C0, np.float32)),
        },
        "sensor": {
            "type": "perspective",
            "fov": fov_x,
            "fov_axis": "x",
            "near_clip": camera.near,
            "far_clip": 1000.0,
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], [0, 0, 1], [0, -1, 0]),
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
            },
            # one sample of a stratified grid, without jitter, is the middle of the pixel
            "sampler": {"type": "stratified", "sample_count": 1, "jitter": False},
        },
    }


def main() -> None:
    options = arguments(__doc__, repeats=5, device="opencl:cpu").parse_args()
    mi.set_variant("llvm_ad_rgb")
    import drjit as dr  # after the variant, so that it finds the same LLVM

    records, names = [], scene_names(options.scenes)
    for name in names:
        cloud, camera = BENCH_SCENES[name].make()
        ours = SceneRun(name, options.device, None, cloud, camera)
        if ours.result.timer.error:
            raise SystemExit(f"mitsuba_cpu: {ours.result.timer.error}")
        scene = mi.load_dict(mitsuba_scene(cloud, camera))
        threads = dr.thread_count()
        device = peer_device("cpu", f"{threads} threads", "Dr.Jit LLVM", mi.__version__, "cpu", threads)

        def draw(scene=scene):
            picture = mi.render(scene, spp=1)
            dr.eval(picture)
            dr.sync_thread()
            return picture

        size = camera.width, camera.height
        peer = Result(name, device, *size, Timer(draw), renderer=f"Mitsuba {mi.__version__}")
        peer.counts = {"splats": len(cloud)}
        records += compared(ours, peer, draw, max(options.repeats, 1))
    report(records, list(names), options.json)


if __name__ == "__main__":
    main()
