"""Preparation of a frame from a cloud and a capture: features to compile, and uniforms of the view."""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.view import SubFrame, View, moved_pose
from fidsplat.capture.capture import Capture
from fidsplat.capture.views import CaptureBatch
from fidsplat.effects import FeatureSet, select
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.properties import CloudLike
from fidsplat.util.errors import InputError

_Prepared = tuple[FeatureSet, View]
_prepared: WeakKeyDictionary[Capture, WeakKeyDictionary[CloudLike, _Prepared]] = WeakKeyDictionary()
"""cached for static captures only: the functions of a motion may return other poses next time"""


def prepare(cloud: CloudLike, capture: Capture) -> _Prepared:
    """The features that a capture of a cloud requires, and its view; cached for uploaded clouds and stores.
    Raises InputError for a missing camera, an unknown output, effects that exclude each other, or a pose that
    is not rigid."""
    if isinstance(cloud, SplatCloud) or not capture.motion.is_still:
        view = view_of(capture, cloud.origin)
        return select(cloud, capture), view
    cached = _prepared.setdefault(capture, WeakKeyDictionary())
    if cloud not in cached:
        view = view_of(capture, cloud.origin)
        cached[cloud] = select(cloud, capture), view
    return cached[cloud]


def prepare_batch(cloud: CloudLike, views: CaptureBatch) -> tuple[FeatureSet, ViewBatch]:
    """The features that the views of a batch require, and the batch of rendered views. Raises InputError as
    `prepare`, and if the views have different effects."""
    active = views.active
    indices = np.array(active, np.uint32)
    indices.flags.writeable = False
    if len(views.captures) == 1 and views.captures[0].motion.is_still:
        features, view = prepare(cloud, views.capture(0))
        if not view.sub_frames:
            positions, groups = indices.astype(np.intp), sorted((views.groups or {}).items())
            poses = None if views.poses is None else views.poses[positions]
            moved = {label: motions[positions] for label, motions in groups}
            external = views.captures[0].external_depth
            if external and external.stacked:
                if len(active) < len(views):
                    external = external.of_views(positions)
                view = replace(view, external_depth=external)
            return features, ViewBatch.of_poses(view, cloud.origin, poses, moved, indices, len(views))
    prepared = [prepare(cloud, views.capture(number)) for number in range(len(views))]
    features, first_view = prepared[0]
    for number, (other, _) in enumerate(prepared):
        if other != features:
            differing = ", ".join(sorted(other.names ^ features.names)) or "samples or precision"
            raise InputError(
                f"the views of a batch must have the same effects, got views 0 and {number} that differ in "
                f"{differing}; render them in separate batches"
            )
    active_views = [prepared[number][1] for number in active]
    return features, ViewBatch.of(active_views or [first_view], indices, len(views))


def view_of(capture: Capture, origin: np.ndarray) -> View:
    """The view of a capture at its shutter's time, with `sub_frames` for each pose of a long exposure."""
    camera, motion, shutter = capture.camera, capture.motion, capture.shutter
    if motion.is_still:
        return View.of(capture, origin)

    def at(time: float) -> View:
        moved = None if camera is None else motion.moved(camera, time)
        view = View.of(capture, origin, moved)
        groups = []
        for label, matrix in motion.groups_at(time):
            pose = moved_pose(view.rotation, view.translation, matrix, origin, view.parallel)
            rotation, translation, eye = pose
            groups.append((label, replace(view, rotation=rotation, translation=translation, eye=eye)))
        return replace(view, groups=tuple(groups)) if groups else view

    full_view = at(shutter.time)
    if not capture.has_sub_frames:
        return full_view
    sub_frames, samples = [], capture.quality.samples
    for top, end, middle_time in shutter.bands(full_view.height // samples):
        times = shutter.times(middle_time)
        for k, time in enumerate(times):
            view = at(time).rows(top * samples, end * samples)
            sub_frames.append(SubFrame(view, top * samples, 1 / len(times), k == 0, k == len(times) // 2))
    return replace(full_view, sub_frames=tuple(sub_frames))
