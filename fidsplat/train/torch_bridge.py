"""PyTorch bridge: differentiable rendering as an autograd function, for your own optimisation.

Images and gradients are copied from the device to the host once, and tensors on the CPU share that memory.
docs/gradients.md describes the gradients.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from fidsplat.cameras.pose_offset import offset_camera, offset_gradient
from fidsplat.capture.capture import Capture
from fidsplat.render.renderer import Renderer
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import C0
from fidsplat.util.errors import InputError, required_package

with required_package("PyTorch", "torch"):
    import torch as _torch  # type: ignore[import-not-found]

torch: Any = _torch  # untyped, since it may not be installed
_INPUTS = ("means", "quats", "scales", "opacities", "colors", "sh", "background", "pose")


def render(
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
    """Render splats from tensors; `backward` of a loss fills the gradients of the tensors.

    Call `backward` before the next frame of the device, and accumulate the gradients of several views.

    Args:
        renderer: a device with gradients.
        capture: camera, outputs (`rgb`, `alpha`, `depth`, `normal`), quality; see docs/gradients.md.
        means, quats, scales, opacities: (n, 3), (n, 4) wxyz of any length, (n, 2) or (n, 3) for 3D
            Gaussians, (n,), as in a `SplatCloud`.
        colors, sh: (n, 3), or (n, k, 3) harmonics; one of them.
        background: (3,), instead of the capture's.
        pose: (6,) rotation vector [rad] and translation [m] of a motion after the camera's
            `world_to_camera`, in its axes.

    Returns:
        the capture's outputs as float32 tensors on the device of `means`. Splats with invalid values are
        dropped with a warning, as by `SplatCloud`, and have gradients of 0.

    Raises:
        DeviceError: the device has no gradients, or fails.
        InputError: invalid arrays, or an effect without a gradient; in `backward`, if the device has rendered
            another frame since.
    """
    if sh is not None and sh.shape[1] == 1:  # degree 0 is rendered as colours, which are clamped at 0
        colors, sh = torch.clamp(C0 * sh[:, 0] + 0.5, min=0), None
    quats = torch.nn.functional.normalize(quats, dim=1)
    inputs = (means, quats, scales, opacities, colors, sh, background, pose)
    images = _Rendered.apply(renderer, capture, *inputs)
    return dict(zip(capture.outputs, images, strict=True))


class _Rendered(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, renderer: Renderer, capture: Capture, *tensors: Any) -> tuple[Any, ...]:
        arrays = {
            name: tensor.detach().cpu().numpy()
            for name, tensor in zip(_INPUTS, tensors, strict=True)
            if tensor is not None
        }
        background, pose = arrays.pop("background", None), arrays.pop("pose", None)
        if background is not None:
            capture = replace(capture, background=tuple(background.tolist()))
        if pose is not None:
            if capture.camera is None or pose.shape != (6,):
                raise InputError(f"pose must be 6 numbers, for a capture with a camera, got {pose!r}")
            capture = replace(capture, camera=offset_camera(capture.camera, pose.astype(np.float64)))
        # labels store input rows, to find the rows of the splats that were not dropped
        cloud = SplatCloud(**arrays, labels=np.arange(len(np.atleast_1d(arrays["means"]))))
        frame = ctx.frame = renderer.render_differentiable(cloud, capture)
        ctx.outputs, ctx.pose, ctx.rows, ctx.count = capture.outputs, pose, cloud.labels, len(tensors[0])
        ctx.thick = arrays["scales"].shape[1:] == (3,)
        ctx.like = [None if tensor is None else (tensor.device, tensor.dtype) for tensor in tensors]
        ctx.set_materialize_grads(False)
        return tuple(_tensor(image).to(tensors[0].device) for image in frame.values())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *by_images: Any) -> tuple[Any, ...]:
        image_gradients = {
            name: by.cpu().numpy() for name, by in zip(ctx.outputs, by_images, strict=True) if by is not None
        }
        input_gradients = ctx.frame.backward(image_gradients)
        if ctx.pose is not None:
            input_gradients["pose"] = offset_gradient(
                input_gradients["pose"].astype(np.float64), ctx.pose.astype(np.float64)
            )
        if ctx.thick:
            third = input_gradients.get(
                "thickness", np.zeros(len(ctx.rows), np.float32)
            )  # without one: all are disks
            input_gradients["scales"] = np.column_stack([input_gradients["scales"], third])
        gradients: list[Any] = [None, None]  # the renderer and the capture have no gradient
        for name, like, needed in zip(_INPUTS, ctx.like, ctx.needs_input_grad[2:], strict=True):
            if like is None or not needed:
                gradients.append(None)
                continue
            device, dtype = like
            array = input_gradients[name]
            if name not in ("background", "pose") and len(ctx.rows) < ctx.count:
                array = np.zeros((ctx.count, *array.shape[1:]), array.dtype)
                array[ctx.rows] = input_gradients[name]
            gradients.append(_tensor(array).to(device=device, dtype=dtype))
        return tuple(gradients)


def _tensor(array: np.ndarray) -> Any:
    """A tensor that shares the memory of an array, which nothing else may read."""
    array.flags.writeable = True
    return torch.from_numpy(array)
