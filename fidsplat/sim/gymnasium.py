"""Images of splats in the observations of a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import numpy as np

from fidsplat.effects import Output, declared_output
from fidsplat.images.files import to_uint8
from fidsplat.sim.rig import Rig
from fidsplat.util.errors import InputError, required_package

with required_package("Gymnasium", "sim"):
    import gymnasium as _gymnasium  # type: ignore[import-not-found]

gymnasium: Any = _gymnasium  # type checkers do not know its names where it is not installed
spaces = gymnasium.spaces


class SplatObservation(gymnasium.ObservationWrapper):
    """Wrapper that adds images of a rig's cameras to the observation of an environment.

    The observation becomes a dictionary: `state`, the observation of the environment (or its entries, if it
    is a dictionary), and CAMERA_OUTPUT for each image, e.g. `front_rgb` (h, w, 3) uint8, `front_depth` (h, w)
    float32 metres.

    Args:
        env: the environment.
        rig: the cameras; a `MujocoRig` reads `env.unwrapped.data`.
        poses: for simulators other than MuJoCo: function of the unwrapped environment that returns the
            arguments (bodies, cameras) of `rig.render` as {name: (1, 7)}.

    Raises:
        InputError: an environment without MuJoCo's data and no `poses`.
    """

    def __init__(self, env: Any, rig: Rig, poses: Any = None) -> None:
        super().__init__(env)
        if poses is None and not hasattr(env.unwrapped, "data"):
            raise InputError(
                f"env must have MuJoCo data, got {env.unwrapped!r}; give the poses of bodies and cameras "
                "by poses=..."
            )
        self._rig, self._poses = rig, poses
        old = env.observation_space
        observed = dict(old.spaces) if isinstance(old, spaces.Dict) else {"state": old}
        self._whole = not isinstance(old, spaces.Dict)
        self.observation_space = spaces.Dict(observed | self._image_spaces())

    def observation(self, observation: Any) -> dict[str, Any]:
        """The environment's observation and images of its current state."""
        env = self.env.unwrapped
        arguments = (env.data,) if self._poses is None else self._poses(env)  # type: ignore[attr-defined]
        images = self._rig.render(*arguments)
        observed = {
            f"{name}_{output}": _as_observed(output, images.of(name)[output][0])
            for name in self._rig.cameras
            for output in images.of(name)
        }
        return ({"state": observation} if self._whole else dict(observation)) | observed

    def _image_spaces(self) -> dict[str, Any]:
        image_spaces: dict[str, Any] = {}
        for name, camera in self._rig.cameras.items():
            size = camera.camera.height, camera.camera.width
            for output in self._rig.outputs_of(name):
                if output == "rgb":
                    image_spaces[f"{name}_rgb"] = spaces.Box(0, 255, (*size, 3), np.uint8)
                else:
                    image_spaces[f"{name}_{output}"] = _space(declared_output(output), size)
        return image_spaces


def _space(output: Output, size: tuple[int, int]) -> Any:
    """Gymnasium space of an output image."""
    shape = size if output.channels == 1 else (*size, output.channels)
    if output.dtype == "int32":
        return spaces.Box(output.empty_value, np.iinfo(np.int32).max, shape, np.int32)
    low, high = (-1.0, 1.0) if output.display == "normal" else (0.0, np.inf)
    return spaces.Box(low, high, shape, np.float32)


def _as_observed(output: str, image: np.ndarray) -> np.ndarray:
    if output == "rgb":
        return to_uint8(image)
    return np.clip(image, -1, 1) if declared_output(output).display == "normal" else image
