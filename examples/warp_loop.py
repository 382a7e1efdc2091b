"""A simulation in Warp, rendered to a Warp array in every step without a copy through the host.

    python examples/warp_loop.py                        30 steps on the CPU, in seconds
    python examples/warp_loop.py --device warp:cuda --steps 1000

An AprilTag swings above a floor of splats. A kernel moves its splats in device memory; the renderer renders
them; another kernel reads the image, as a policy or a sensor model would (here: the number of pixels of the
tag, from the labels). Newton and MuJoCo Warp can replace `swing`: the renderer reads the wp.arrays that they
write.
"""

import argparse
import math
import time

import numpy as np
import warp as wp

import fidsplat as fs

FLOOR, TAG = 0, 1


@wp.kernel
def swing(
    angle: float,
    rest_means: wp.array(dtype=wp.vec3),
    rest_quats: wp.array(dtype=wp.vec4),
    first: int,
    means: wp.array(dtype=wp.vec3),
    quats: wp.array(dtype=wp.vec4),
):
    """Rotate the tag's splats about the axis x at the tag's upper edge."""
    i = wp.tid()
    pivot = wp.vec3(0.0, -0.1, 0.0)
    half = 0.5 * angle
    rotation = wp.quat(wp.sin(half), 0.0, 0.0, wp.cos(half))
    means[first + i] = wp.quat_rotate(rotation, rest_means[i] - pivot) + pivot
    q = rest_quats[i]  # w x y z; Warp's quaternions are x y z w
    rotated = rotation * wp.quat(q[1], q[2], q[3], q[0])
    quats[first + i] = wp.vec4(rotated[3], rotated[0], rotated[1], rotated[2])


@wp.kernel
def count_label(labels: wp.array(dtype=wp.int32, ndim=2), label: int, count: wp.array(dtype=wp.int32)):
    """Count the pixels of a label."""
    row, column = wp.tid()
    if labels[row, column] == label:
        wp.atomic_add(count, 0, 1)


def scene_arrays(device) -> tuple[dict, fs.SplatCloud, int]:
    """Arrays of floor and tag on the device, the tag at rest, and the index of its first splat."""
    generator = np.random.default_rng(0)
    n = 2000
    means = np.column_stack([generator.uniform(-1, 1, n), np.full(n, 0.15), generator.uniform(-0.5, 1.5, n)])
    flat = np.tile([math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0], (n, 1))
    grey = np.repeat(generator.uniform(0.2, 0.6, (n, 1)), 3, axis=1)
    floor = fs.SplatCloud(means, flat, np.full((n, 2), 0.04), np.full(n, 0.9), colors=grey, labels=FLOOR)
    tag = fs.marker("apriltag:36h11:5", size=0.16).cloud.with_labels(TAG)
    both = fs.SplatCloud.concatenate([floor, tag])
    types = {"means": wp.vec3, "quats": wp.vec4, "scales": wp.vec2, "opacities": wp.float32}
    types |= {"colors": wp.vec3, "labels": wp.int32}
    arrays = {
        name: wp.array(getattr(both, name), dtype=dtype, device=device) for name, dtype in types.items()
    }
    return arrays, tag, len(floor)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="warp:cpu", help="warp:cpu, warp:cuda or warp:cuda:N")
    parser.add_argument("--steps", type=int, default=30, help="steps of 1/60 s (default: 30)")
    options = parser.parse_args()
    if not options.device.startswith("warp"):
        parser.error(f"--device must be a Warp device, got {options.device}; `fidsplat devices` lists them")

    renderer = fs.Renderer(options.device)
    device = renderer.backend.device  # a wp.Device
    arrays, tag, first = scene_arrays(device)
    resident = renderer.wrap_arrays(**arrays)  # no copy: frames have the current content of the arrays
    rest = [wp.array(getattr(tag, name), dtype=dtype, device=device) for name, dtype in _REST.items()]
    camera = fs.Camera.look_at(320, 240, 0.9, position=(0.15, -0.15, -0.5), target=(0, 0, 0))

    angle, speed, visible = 0.9, 0.0, wp.zeros(1, dtype=wp.int32, device=device)
    begun = time.perf_counter()
    for step in range(options.steps):
        speed -= (40.0 * math.sin(angle) + 0.8 * speed) / 60
        angle += speed / 60
        moving = [arrays["means"], arrays["quats"]]
        wp.launch(swing, len(tag), [angle, *rest, first], moving, device=device)
        frame = renderer.render(resident, camera, outputs=("rgb", "label"))
        labels = frame.device_array("label")  # a wp.array (240, 320) on the same device
        visible.zero_()
        wp.launch(count_label, labels.shape, [labels, TAG], [visible], device=device)
        if step % 10 == 0:
            print(
                f"step {step:4d}: {math.degrees(angle):6.1f} degrees, "
                f"the tag covers {visible.numpy()[0]:5d} pixels"
            )
    wp.synchronize_device(device)
    took = (time.perf_counter() - begun) / max(options.steps, 1) * 1e3
    print(
        f"{options.steps} steps on {renderer.device.title}, {took:.1f} ms a step, the first with compilation"
    )


_REST = {"means": wp.vec3, "quats": wp.vec4}


if __name__ == "__main__":
    main()
