"""Adapter of Mitsuba 3: ray-traced ellipsoids on a processor. Requires LLVM 19 (DRJIT_LIBLLVM_PATH); 15
aborts.

A ray composites the maximum of each Gaussian along the ray, ordered by its position, as fidsplat does with
`ellipsoid="exact"` and `order="pixel"`. The plugin truncates at 3 standard deviations and at 64 fragments per
pixel.
"""

import math

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
import drjit as dr  # noqa: E402 after set_variant, so that it uses the same LLVM

C0 = 0.28209479177387814  # value of the constant spherical harmonic


class Adapter:
    settings = {"default": {"ellipsoids": {"ellipsoid": "exact", "order": "pixel", "lowpass": "none"}}}

    def __init__(self):
        device = f"{dr.thread_count()} threads"
        self.facts = {"renderer": "Mitsuba", "version": mi.__version__, "kind": "cpu", "device": device}
        self.facts["driver"] = f"Dr.Jit {dr.__version__}"

    def load(self, scene):
        width, height = map(int, scene["size"])
        quats = scene["quats"][:, [1, 2, 3, 0]]  # Mitsuba: x y z w
        data = np.concatenate([scene["means"], scene["scales"], quats], 1)
        splats = {"type": "ellipsoidsmesh", "data": mi.TensorXf(np.ascontiguousarray(data, np.float32))}
        splats["opacities"] = mi.TensorXf(np.ascontiguousarray(scene["opacities"][:, None]))
        splats["sh_coeffs"] = mi.TensorXf(np.ascontiguousarray((scene["colors"] - 0.5) / C0, np.float32))
        self.scene = mi.load_dict({"type": "scene", "splats": splats})
        self.integrator = mi.load_dict({"type": "volprim_rf_basic", "srgb_primitives": False})
        film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb"}
        fov = math.degrees(2 * math.atan(width / 2 / scene["matrix"][0, 0]))
        flip = np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba: x left, y up
        self.sensors = [
            mi.load_dict(
                {"type": "perspective", "fov": fov, "fov_axis": "x", "near_clip": float(scene["near"]),
                 "film": film | {"rfilter": {"type": "box"}},
                 "to_world": mi.ScalarTransform4f(np.linalg.inv(pose) @ flip),
                 "sampler": {"type": "stratified", "sample_count": 1, "jitter": False}}
            )
            for pose in scene["poses"]
        ]  # fmt: skip

    def render(self, setting, views):
        how = {"integrator": self.integrator, "spp": 1}
        images = [mi.render(self.scene, sensor=self.sensors[view], **how) for view in views]
        dr.eval(images)
        dr.sync_thread()
        return images

    def read(self, images):
        return [np.array(image) for image in images]
