"""From a cloud and a capture to what a backend draws: the features to compile, and the picture's numbers."""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from fidsplat.backends.base import ResidentData
from fidsplat.backends.view import FAR_EYE, Shot, View
from fidsplat.capture import Capture
from fidsplat.effects import FeatureSet, select
from fidsplat.splats import SplatCloud

_Prepared = tuple[FeatureSet, View]
_prepared: WeakKeyDictionary[Capture, WeakKeyDictionary[ResidentData, _Prepared]] = WeakKeyDictionary()
"""of captures in which nothing moves: a motion's functions may answer otherwise the next time"""


def prepare(cloud: ResidentData | SplatCloud, capture: Capture) -> _Prepared:
    """What a capture of a cloud calls for, and its view; kept for a resident cloud that is drawn again.

    Raises:
        InputError: no camera, an output that nobody declares, effects that do not go together, a picture that
            is too large, or a pose that is not rigid.
    """
    if isinstance(cloud, SplatCloud) or not capture.motion.is_still:
        view = view_of(capture, cloud.origin)
        return select(cloud, capture), view
    held = _prepared.setdefault(capture, WeakKeyDictionary())
    if cloud not in held:
        view = view_of(capture, cloud.origin)
        held[cloud] = select(cloud, capture), view
    return held[cloud]


def view_of(capture: Capture, origin: np.ndarray) -> View:
    """The view of a capture: at its shutter's time, with `shots` if it is made of several poses.

    Raises:
        InputError: as View.of; a pose that is not rigid.
    """
    camera, motion, shutter = capture.camera, capture.motion, capture.shutter

    def at(time: float) -> View:
        moved = None if camera is None else motion.moved(camera, time)
        view = View.of(capture, origin, moved)
        groups = tuple((k, _moved(view, m, origin)) for k, m in motion.groups_at(time))
        return replace(view, groups=groups) if groups else view

    whole = at(shutter.time)
    if not capture.exposed:
        return whole
    shots, samples = [], capture.quality.samples
    for top, end, middle in shutter.bands(whole.height // samples):
        times = shutter.times(middle)
        for k, time in enumerate(times):
            view = at(time).rows(top * samples, end * samples)
            shots.append(Shot(view, top * samples, 1 / len(times), k == 0, k == len(times) // 2))
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
