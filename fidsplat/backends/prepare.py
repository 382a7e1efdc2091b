"""From a cloud and a capture to what a backend draws: the features to compile, and the picture's numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol
from weakref import WeakKeyDictionary

import numpy as np

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.view import FAR_EYE, SubFrame, View, rotated
from fidsplat.capture.capture import Capture
from fidsplat.capture.views import Views
from fidsplat.effects import FeatureSet, select
from fidsplat.effects.select import CloudTraits
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import InputError


class Origined(CloudTraits, Protocol):
    """What decides the kernels, and where the zero of its means is."""

    @property
    def origin(self) -> np.ndarray:
        """(3,) float64 metres."""
        ...


_Prepared = tuple[FeatureSet, View]
_prepared: WeakKeyDictionary[Capture, WeakKeyDictionary[Origined, _Prepared]] = WeakKeyDictionary()
"""of captures in which nothing moves: a motion's functions may answer otherwise the next time"""


def prepare(cloud: Origined, capture: Capture) -> _Prepared:
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


def prepare_batch(cloud: Origined, views: Views) -> tuple[FeatureSet, ViewBatch]:
    """What the views of a batch call for, and those that are drawn.

    Raises:
        InputError: as `prepare`; views that call for different effects.
    """
    rendered = views.active
    indices = np.array(rendered, np.uint32)
    indices.flags.writeable = False
    if len(views.captures) == 1 and views.captures[0].motion.is_still:
        features, view = prepare(cloud, views.capture(0))
        if not view.sub_frames:
            numbers, groups = indices.astype(np.intp), sorted((views.groups or {}).items())
            poses = None if views.poses is None else views.poses[numbers]
            moved = {label: each[numbers] for label, each in groups}
            return features, ViewBatch.of_poses(view, cloud.origin, poses, moved, indices, len(views))
    own = [prepare(cloud, views.capture(number)) for number in range(len(views))]
    features = own[0][0]
    for number, (other, _) in enumerate(own):
        if other != features:
            differing = ", ".join(sorted(other.names ^ features.names)) or "samples or precision"
            raise InputError(
                f"the views of a batch must have the same effects, but views 0 and {number} differ in "
                f"{differing}; draw them in batches of their own"
            )
    every = [own[number][1] for number in rendered]
    return features, ViewBatch.of(every or [own[0][1]], indices, len(views))


def view_of(capture: Capture, origin: np.ndarray) -> View:
    """The view of a capture: at its shutter's time, with `sub_frames` if it is made of several poses.

    Raises:
        InputError: as View.of; a pose that is not rigid.
    """
    camera, motion, shutter = capture.camera, capture.motion, capture.shutter
    if motion.is_still:
        return View.of(capture, origin)

    def at(time: float) -> View:
        moved = None if camera is None else motion.moved(camera, time)
        view = View.of(capture, origin, moved)
        groups = tuple((k, _moved(view, m, origin)) for k, m in motion.groups_at(time))
        return replace(view, groups=groups) if groups else view

    whole = at(shutter.time)
    if not capture.exposed:
        return whole
    sub_frames, samples = [], capture.quality.samples
    for top, end, middle in shutter.bands(whole.height // samples):
        times = shutter.times(middle)
        for k, time in enumerate(times):
            view = at(time).rows(top * samples, end * samples)
            sub_frames.append(SubFrame(view, top * samples, 1 / len(times), k == 0, k == len(times) // 2))
    return replace(whole, sub_frames=tuple(sub_frames))


def _moved(view: View, motion: np.ndarray, origin: np.ndarray) -> View:
    """The view that splats have which the motion (4, 4) of the world moves."""
    turn, move = motion[:3, :3], motion[:3, 3]
    rotation = view.rotation @ turn
    # of the cloud's origin, before the camera is where it is
    translation = view.translation + rotated(view.rotation, rotated(turn, origin) + move - origin)
    eye = rotated(-rotation.T, translation)
    return replace(
        view,
        rotation=rotation,
        translation=translation,
        eye=eye - FAR_EYE * rotation[2] if view.parallel else eye,
    )
