"""What a shutter makes of one picture: sub-pictures, each of its own rows, time and weight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fidsplat.backends.view import FAR_EYE, Shot, View
from fidsplat.cameras import Camera
from fidsplat.cameras.motion import Motion, Shutter
from fidsplat.quality import Quality
from fidsplat.sensor import Sensor
from fidsplat.surroundings import Background, Fog


def exposed_view(
    camera: Camera,
    quality: Quality,
    origin: np.ndarray,
    background: Background,
    motion: Motion,
    shutter: Shutter,
    sensor: Sensor | None = None,
    fog: Fog | None = None,
) -> View:
    """The view of a picture under a shutter: with `shots` if something moves and it takes more than one pose,
    else just at its time.

    Raises:
        InputError: as View.of; a pose that is not rigid.
    """
    bands = shutter.bands(camera.height)

    def at(time: float) -> View:
        view = View.of(motion.moved(camera, time), quality, origin, background, sensor, fog)
        groups = tuple((k, _moved(view, m, origin)) for k, m in motion.groups_at(time))
        return replace(view, groups=groups) if groups else view

    whole = at(shutter.time)
    still = motion.camera is None and not motion.groups
    if still or (len(bands) == 1 and len(shutter.times(0.0)) == 1):
        return whole
    shots = []
    for top, end, middle in bands:
        times = shutter.times(middle)
        for k, time in enumerate(times):
            view = at(time).rows(top * quality.samples, end * quality.samples)
            shots.append(Shot(view, top * quality.samples, 1 / len(times), k == 0, k == len(times) // 2))
    return replace(whole, shots=tuple(shots))


def _moved(view: View, motion: np.ndarray, origin: np.ndarray) -> View:
    """The view that splats have which the motion (4, 4) of the world moves."""
    turn, move = motion[:3, :3], motion[:3, 3]
    rotation = view.rotation @ turn
    # of the cloud's origin, before the camera is where it is
    translation = view.translation + view.rotation @ (turn @ origin + move - origin)
    eye = -rotation.T @ translation
    return replace(
        view,
        rotation=rotation,
        translation=translation,
        eye=eye - FAR_EYE * rotation[2] if view.parallel else eye,
    )
