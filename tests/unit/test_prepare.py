"""What is prepared for a capture is kept where nothing moves, and only there."""

import numpy as np

import fidsplat as fs
from fidsplat.backends.prepare import prepare
from fidsplat.random_clouds import random_splats

CAMERA = fs.Camera.pinhole(32, 24, 30.0, 30.0, 16.0, 12.0)


def test_a_still_capture_is_prepared_once_for_each_cloud():
    renderer = fs.Renderer("reference")
    first, second = (renderer.upload(random_splats(3, seed))._data for seed in (1, 2))
    capture = fs.Capture(CAMERA)
    assert prepare(first, capture)[1] is prepare(first, capture)[1]
    assert prepare(first, capture)[1] is not prepare(second, capture)[1]
    assert prepare(first, capture)[1] is not prepare(first, fs.Capture(CAMERA))[1]


def test_what_moves_is_asked_again():
    poses = iter(range(9))

    def stepping(time):
        pose = np.eye(4)
        pose[0, 3] = next(poses)
        return pose

    data = fs.Renderer("reference").upload(random_splats(3, 1))._data
    for motion in (fs.Motion(stepping), fs.Motion(None, {0: stepping})):
        capture = fs.Capture(CAMERA, motion=motion)
        views = [prepare(data, capture)[1] for _ in range(2)]
        views = [view.groups[0][1] if view.groups else view for view in views]
        assert views[0].translation[0] != views[1].translation[0]
