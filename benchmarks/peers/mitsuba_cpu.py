"""Compare fidsplat and Mitsuba 3 on the processor, with the same scenes in the same run.

    pip install . mitsuba
    DRJIT_LIBLLVM_PATH=.../libLLVM-19.so python benchmarks/peers/mitsuba_cpu.py r100k_720p --json mitsuba.json

Mitsuba's variant llvm_ad_rgb compiles with the system's LLVM. LLVM 15, the default of Debian 12, aborts on
its code ("Cannot select: fminimum"); LLVM 19 works, and can be used without installation by unpacking the
package anywhere (`apt-get download libllvm19 && dpkg -x libllvm19*.deb DIR`).

No other renderer of 2D splats for processors is known. The most similar method is the shape `ellipsoidsmesh`
with the integrator `volprim_rf_basic`: Gaussians are ray-traced in the order of intersection. Splats become
ellipsoids of 0.1 mm thickness, with the plugin's extent of 3 standard deviations, one sample at the centre of
each pixel and at most 64 fragments per pixel, its default. The image stays in Mitsuba's memory.
"""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
from interleaved import arguments, compared, peer_device, report

from fidsplat.cameras import Camera
from fidsplat.experiments.bench.catalogue import BENCH_SCENES, scene_names
from fidsplat.experiments.bench.measure import Result, SceneRun
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.timing import Timer

THICKNESS = 1e-4  # metres, standard deviation
C0 = 0.28209479177387814  # value of the constant spherical harmonic


def mitsuba_scene(cloud: SplatCloud, camera: Camera) -> dict:
    """Cloud and camera as a Mitsuba scene."""
    if cloud.colors is None:
        raise SystemExit("mitsuba_cpu: the scene must have plain colours; choose another")
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
            # one sample of a stratified grid without jitter is the centre of the pixel
            "sampler": {"type": "stratified", "sample_count": 1, "jitter": False},
        },
    }


def main() -> None:
    options = arguments(__doc__, repeats=5, device="opencl:cpu").parse_args()
    mi.set_variant("llvm_ad_rgb")
    import drjit as dr  # after set_variant, so that it uses the same LLVM

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
            image = mi.render(scene, spp=1)
            dr.eval(image)
            dr.sync_thread()
            return image

        size = camera.width, camera.height
        peer = Result(name, device, *size, Timer(draw), renderer=f"Mitsuba {mi.__version__}")
        peer.counts = {"splats": len(cloud)}
        records += compared(ours, peer, draw, max(options.repeats, 1))
    report(records, list(names), options.json)


if __name__ == "__main__":
    main()
