"""Warp bridge: differentiable rendering recorded on a `warp.Tape`.

Arrays stay on the device. docs/gradients.md describes the gradients.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from fidsplat.backends.gradients import on_host
from fidsplat.backends.warp.cloud import split_scales
from fidsplat.backends.warp.device import WarpBackend
from fidsplat.backends.warp.gradients import add_to
from fidsplat.backends.warp.runtime import load
from fidsplat.cameras.pose_offset import offset_camera, offset_gradient
from fidsplat.capture.capture import Capture
from fidsplat.render.renderer import Renderer
from fidsplat.util.errors import DeviceError, InputError


def render(
    tape: Any,
    renderer: Renderer,
    capture: Capture,
    means: Any,
    quats: Any,
    scales: Any,
    opacities: Any,
    *,
    colors: Any = None,
    sh: Any = None,
    background: Any = None,
    pose: Any = None,
) -> dict[str, Any]:
    """Render splats from wp.arrays and record it: `tape.backward` adds to the `grad` of each array that
    `requires_grad`.

    Call `tape.backward` before the next frame of the device. On CUDA all kernels run on the device's stream.

    Args:
        tape: a `warp.Tape`.
        renderer: a Warp device.
        capture: camera, outputs (`rgb`, `alpha`, `depth`, `normal`), quality; see docs/gradients.md.
        means, quats, scales, opacities: (n,) float32 vectors or (n, 3), (n, 4) wxyz of any length, (n, 2) or
            (n, 3) for 3D Gaussians, (n,), as in a `SplatCloud`; on the renderer's device; not copied.
        colors, sh: (n, 3), or (n, k, 3) harmonics of degree 1 to 3; one of them.
        background: (3,), instead of the capture's.
        pose: (6,) rotation vector [rad] and translation [m] of a motion after the camera's
            `world_to_camera`, in its axes.

    Returns:
        the capture's outputs as new float32 arrays (h, w) or (h, w, 3), with gradients.

    Raises:
        DeviceError: the renderer is not a Warp device, or the device fails.
        InputError: invalid arrays, or an effect without a gradient; in `tape.backward`, if the device has
            rendered another frame since.
    """
    wp, backend = load(), renderer.backend
    if not isinstance(backend, WarpBackend):
        raise DeviceError(
            f"renderer must use a Warp device, got {renderer.device.name}; use 'warp:cpu' or 'warp:cuda'"
        )
    arrays = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    arrays |= {name: array for name, array in (("colors", colors), ("sh", sh)) if array is not None}
    inputs = arrays | {"background": background, "pose": pose}
    with_grad = {name: array for name, array in inputs.items() if getattr(array, "requires_grad", False)}
    if background is not None:
        capture = replace(capture, background=tuple(_numbers("background", background, 3).tolist()))
    offset = None if pose is None else _numbers("pose", pose, 6)
    if offset is not None:
        if capture.camera is None:
            raise InputError("capture must have a camera for a pose, got none; give fs.Capture(camera)")
        capture = replace(capture, camera=offset_camera(capture.camera, offset))
    frame = renderer.render_differentiable(renderer.wrap_arrays(**arrays), capture)
    images = {name: wp.clone(frame.device_array(name), requires_grad=True) for name in capture.outputs}

    def backward() -> None:
        by_images = {name: image.grad for name, image in images.items()}
        found = frame.backward(by_images, on_device=True)
        if offset is not None:
            by_offset = offset_gradient(on_host(found["pose"]).astype(np.float64), offset)
            found["pose"] = wp.array(by_offset, dtype=wp.float32, device=backend.device)
        for name, array in with_grad.items():
            own = {name: array.grad}
            if name == "scales" and "thickness" in found:
                own = split_scales(array.grad)
            for part, sums in own.items():
                add_to(sums, found[part])

    tape.record_func(backward, [*with_grad.values(), *images.values()])
    return images


def _numbers(name: str, array: Any, count: int) -> np.ndarray:
    """An array of `count` numbers as float64."""
    numbers = on_host(array).astype(np.float64)
    if numbers.shape != (count,):
        raise InputError(f"{name} must be {count} numbers, got the shape {numbers.shape}")
    return numbers
