"""Prepared data of a capture are cached if nothing moves, and only then."""

import numpy as np

import fidsplat as fs
from fidsplat.backends.prepare import prepare, view_of
from fidsplat.scenes.random_clouds import random_splats

CAMERA = fs.Camera.pinhole(32, 24, 30.0, 30.0, 16.0, 12.0)


def test_a_still_capture_is_prepared_once_for_each_cloud():
    renderer = fs.Renderer("reference")
    first, second = (renderer.upload(random_splats(3, seed)).data for seed in (1, 2))
    capture = fs.Capture(CAMERA)
    assert prepare(first, capture)[1] is prepare(first, capture)[1]
    assert prepare(first, capture)[1] is not prepare(second, capture)[1]
    assert prepare(first, capture)[1] is not prepare(first, fs.Capture(CAMERA))[1]


def test_motions_are_evaluated_again():
    poses = iter(range(9))

    def stepping(time):
        pose = np.eye(4)
        pose[0, 3] = next(poses)
        return pose

    data = fs.Renderer("reference").upload(random_splats(3, 1)).data
    for motion in (fs.Motion(stepping), fs.Motion(None, {0: stepping})):
        capture = fs.Capture(CAMERA, motion=motion)
        views = [prepare(data, capture)[1] for _ in range(2)]
        views = [view.groups[0][1] if view.groups else view for view in views]
        assert views[0].translation[0] != views[1].translation[0]


def test_no_view_moves_by_minus_zero():
    """A sum with it might be -0, and splats at depths 0 and -0 would not tie in the kernels' sort keys."""
    rotation_matrix = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    for rotation, eye in ((np.eye(3), (1, 1, 0)), (np.eye(3), (-1, -1, -0.0)), (rotation_matrix, (0, 0, 0))):
        for sign in (1, -1):
            pose = np.eye(4)
            pose[:3, :3] = sign * rotation * np.linalg.det(sign * rotation)
            pose[:3, 3] = -pose[:3, :3] @ eye
            motion = fs.Motion(None, {0: lambda time: np.diag([-1.0, -1, 1, 1])})
            capture = fs.Capture(fs.Camera.pinhole(9, 7, 9.0, 9.0, 4, 3, world_to_camera=pose), motion=motion)
            view = view_of(capture, np.zeros(3))
            for moved in (view, view.groups[0][1]):
                assert not np.signbit(moved.translation[moved.translation == 0]).any()


def test_outputs_of_a_blurred_band_show_its_middle_pose_in_all_of_its_rows():
    """Whatever the samples: rows of pixels, not of samples, have the turn of their band's middle pose."""

    def turning(time):
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(time), -np.sin(time)], [np.sin(time), np.cos(time)]]
        return pose

    shutter = fs.Shutter(time=0.1, exposure_time=0.3, sub_poses=3, readout=0.4, rows_per_band=10)
    for samples in (1, 2):
        quality = fs.Quality(samples=samples)
        view = view_of(
            fs.Capture(CAMERA, quality=quality, motion=fs.Motion(turning), shutter=shutter), np.zeros(3)
        )
        bands = [(0, 10), (10, 20), (20, 24)]
        assert [sub_frame.middle for sub_frame in view.sub_frames] == [False, True, False] * 3
        assert view.row_rotations.shape == (24, 3, 3)
        for top, end in bands:
            time = 0.1 + 0.4 * ((top + end) / 2 / 24 - 0.5)
            assert np.allclose(view.row_rotations[top:end], turning(time)[:3, :3], atol=1e-12)
