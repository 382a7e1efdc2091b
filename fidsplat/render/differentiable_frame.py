"""DifferentiableFrame: a rendered frame with gradients."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import numpy as np

from fidsplat.backends.gradients import DifferentiableImages, on_host
from fidsplat.backends.interface import GradientPipeline, Images
from fidsplat.capture.capture import Capture
from fidsplat.render.array_export import host_array
from fidsplat.render.frame import Frame
from fidsplat.util import interrupts
from fidsplat.util.arguments import flag, instance, real_array


class DifferentiableFrame(Frame):
    """A Frame with `backward`, from `Renderer.render_differentiable`."""

    def __init__(
        self,
        images: Images,
        capture: Capture,
        pipeline: GradientPipeline,
        lock: threading.Lock,
        distortion: bool = False,
    ) -> None:
        super().__init__(images.images if isinstance(images, DifferentiableImages) else images, capture)
        self._forward_images, self._pipeline, self._lock = images, pipeline, lock
        if distortion:
            self.outputs = (*capture.outputs, "distortion")

    def backward(self, gradients: Mapping[str, Any], on_device: bool = False) -> dict[str, Any]:
        """Gradients of a loss with respect to the splats, the background and the camera pose.

        Call it before the next frame of this device. Results are bit-identical on every run. Decisions of the
        forward pass (alpha cut-off, transmittance stop, near plane, order of splats) have no derivative.

        Args:
            gradients: derivatives of the loss with respect to the outputs, float32 arrays, by output name:
                `rgb` (h, w, 3), `alpha` (h, w), `depth` (h, w) [1/m], `normal` (h, w, 3), `distortion`
                (h, w). NumPy arrays, arrays of the device (pyopencl, Warp), or arrays with DLPack (torch,
                JAX, CuPy) on the host or on Warp's device. Device arrays are not copied.
                Outputs without an entry have a gradient of 0.
            on_device: return device arrays (pyopencl, Warp; NumPy float64 on the device `reference`), which
                are valid until the next call, instead of NumPy float32.

        Returns:
            Derivatives of the loss with respect to the n splats: `means` (n, 3) [1/m]; `quats` (n, 4),
            w x y z, with respect to the quaternions before they are normalised; `scales` (n, 2) [1/m];
            `opacities` (n,); `colors` (n, 3) or `sh` (n, k, 3); `thickness` (n,) [1/m], the third scale, if
            there are 3D Gaussians, 0 for disks. Also `background` (3,); `intrinsics` (4,), fx, fy, cx and cy
            [1/pixel]; `pose` (6,), a rotation vector [1/rad] and a translation [1/m] applied after
            `world_to_camera`, in camera axes; `grad2d` (n,), the densification statistic of 2DGS trainers:
            the norm of the derivative with respect to the projected centre in normalised device coordinates
            (-1 to 1 across the image). Splats that are not rendered have zeros.

        Raises:
            InputError: the device has rendered another frame since; the output of a gradient was not
                rendered or is not differentiable; a gradient has another shape or type.
            DeviceError: the device fails or lacks memory.
        """
        interrupts.check()
        flag("on_device", on_device)
        instance("gradients", gradients, Mapping, "arrays by the name of their output")
        if not self._images.shares_arrays:
            gradients = {
                name: host_array(f"the gradient of {name}", gradient) for name, gradient in gradients.items()
            }
        arrays = {name: _numeric_array(name, value) for name, value in gradients.items()}
        with self._lock:
            results = self._pipeline.backward(self._forward_images, arrays)
            return results if on_device else {name: on_host(array) for name, array in results.items()}


def _numeric_array(name: str, value: Any) -> Any:
    """The gradient of an output as an array of real numbers; arrays on the device are not converted."""
    if value is None or (hasattr(value, "shape") and not isinstance(value, (np.ndarray, np.generic))):
        return value
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        return value
    return real_array(f"the gradient of {name}", value)
