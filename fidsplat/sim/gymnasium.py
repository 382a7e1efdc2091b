"""Pictures of splats in the observations of a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import numpy as np

from fidsplat.effects import Output, declared_output
from fidsplat.images.files import to_uint8
from fidsplat.sim.rig import Rig
from fidsplat.util.errors import InputError

try:
    import gymnasium as _gymnasium  # type: ignore[import-not-found]
except ImportError as error:
    raise InputError(f"Gymnasium is not here ({error}); pip install 'fidsplat[sim]'") from None

gymnasium: Any = _gymnasium  # whose names its types do not tell where it is not installed
spaces = gymnasium.spaces


class SplatObservation(gymnasium.ObservationWrapper):
    """An environment whose observation holds what a rig's cameras see.

    The observation becomes a dictionary: `state`, what the environment itself observes (its own entries
    where that is a dictionary), and CAMERA_OUTPUT for each picture, e.g. `front_rgb` (h, w, 3) uint8,
    `front_depth` (h, w) float32 metres.

    Args:
        env: the environment.
        rig: the cameras; a `MujocoRig` reads `env.unwrapped.data`.
        poses: called with the unwrapped environment, gives the arguments of `rig.render`, for other
            simulators: (bodies, cameras) as {name: (1, 7)}.

    Raises:
        InputError: an environment without MuJoCo's data and no `poses`.
    """

    def __init__(self, env: Any, rig: Rig, poses: Any = None) -> None:
        super().__init__(env)
        if poses is None and not hasattr(env.unwrapped, "data"):
            raise InputError(
                f"{env.unwrapped!r} has no MuJoCo data; say with poses=... where its bodies and cameras are"
            )
        self._rig, self._poses = rig, poses
        old = env.observation_space
        own = dict(old.spaces) if isinstance(old, spaces.Dict) else {"state": old}
        self._whole = not isinstance(old, spaces.Dict)
        self.observation_space = spaces.Dict(own | self._picture_spaces())

    def observation(self, observation: Any) -> dict[str, Any]:
        """The environment's observation with the pictures of this moment."""
        env = self.env.unwrapped
        given = (env.data,) if self._poses is None else self._poses(env)  # type: ignore[attr-defined]
        pictures = self._rig.render(*given)
        seen = {
            f"{name}_{output}": _as_observed(output, pictures.of(name)[output][0])
            for name in self._rig.cameras
            for output in pictures.of(name)
        }
        return ({"state": observation} if self._whole else dict(observation)) | seen

    def _picture_spaces(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, camera in self._rig.cameras.items():
            size = camera.camera.height, camera.camera.width
            for output in self._rig.outputs_of(name):
                if output == "rgb":
                    found[f"{name}_rgb"] = spaces.Box(0, 255, (*size, 3), np.uint8)
                else:
                    found[f"{name}_{output}"] = _space(declared_output(output), size)
        return found


def _space(output: Output, size: tuple[int, int]) -> Any:
    """Space of an output image."""
    shape = size if output.channels == 1 else (*size, output.channels)
    if output.dtype == "int32":
        return spaces.Box(output.blank, np.iinfo(np.int32).max, shape, np.int32)
    low, high = (-1.0, 1.0) if output.display == "normal" else (0.0, np.inf)
    return spaces.Box(low, high, shape, np.float32)


def _as_observed(output: str, image: np.ndarray) -> np.ndarray:
    if output == "rgb":
        return to_uint8(image)
    return np.clip(image, -1, 1) if declared_output(output).display == "normal" else image
