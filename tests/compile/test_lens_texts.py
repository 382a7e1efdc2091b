"""Only frames that request a lens or shutter have its kernel code."""

import numpy as np
import pytest
from agreement import random_splats
from cloud_properties import CloudProperties
from sampling import sampled
from test_assemble import COLORS, GROUP, PLAIN, SHAPE, kernel_files, record_bytes

import fidsplat as fs
from fidsplat.backends.opencl.assemble import assemble
from fidsplat.backends.opencl.effect_code import EFFECT_CODE
from fidsplat.effects import select

BACKEND = "opencl"

OUTPUTS = ("alpha", "depth", "depth_median", "label", "normal")
CAMERAS = {
    "pinhole": fs.Camera.pinhole(33, 21, 30.0, 30.0, 16.0, 10.0),
    "brown_conrady": fs.Camera.pinhole(33, 21, 30.0, 30.0, 16.0, 10.0, lens=fs.BrownConrady(-0.1)),
    "fisheye": fs.Camera.fisheye(33, 21, 3.0),
    "equirectangular": fs.Camera.equirectangular(33, 21),
    "orthographic": fs.Camera.orthographic(33, 21, 4.0),
}

LENS_FILES = {
    *("effect/camera_brown_conrady", "effect/camera_fisheye", "effect/camera_equirectangular"),
    *(
        "effect/camera_orthographic",
        "effect/shutter_exposure",
        "effect/sub_frame_culling",
        "effect/motion_groups",
    ),
    *(
        "part/rays",
        "part/inverse_lens_lut",
        "part/polygon",
        "part/rays_box",
        "part/lens_ray_length",
        "part/world_ray",
    ),
}


@pytest.mark.parametrize("shape", [SHAPE, GROUP], ids=["lanes", "group"])
@pytest.mark.parametrize("outputs", [("rgb",), OUTPUTS], ids=str)
def test_pinhole_frames_have_no_line_of_a_lens_or_shutter(shape, outputs):
    source = assemble(select(CloudProperties(2, True), fs.Capture(outputs=outputs)), shape)
    assert not kernel_files(source) & LENS_FILES


def test_numbers_of_a_lens_are_not_in_its_text():
    cameras = [
        fs.Camera.pinhole(64, 48, f, f, 30.0, 20.0, lens=fs.BrownConrady(k))
        for f, k in ((50, 0.1), (60, -0.1))
    ]
    features = [select(COLORS, fs.Capture(camera, quality=PLAIN)) for camera in cameras]
    assert features[0] == features[1]


def test_values_without_effect_select_nothing(renderer):
    nothing = fs.Camera.pinhole(33, 21, 30.0, 30.0, 16.0, 10.0, lens=fs.BrownConrady())
    assert select(COLORS, fs.Capture(nothing, quality=PLAIN)) == select(COLORS, fs.Capture(quality=PLAIN))
    # a shutter with no exposure time selects nothing, and a motion is evaluated at its time
    cloud = random_splats(10, seed=1, depth=(1, 4))
    before = set(renderer.backend._pipelines)
    motion = fs.Motion(lambda time: CAMERAS["pinhole"].world_to_camera)
    renderer.render(cloud, nothing, quality=PLAIN, motion=motion, shutter=fs.Shutter(time=0.5, sub_poses=9))
    # nor does a shutter without motion
    renderer.render(cloud, nothing, quality=PLAIN, shutter=fs.Shutter(exposure_time=0.1, readout=0.2))
    added = set(renderer.backend._pipelines) - before
    assert not any(
        "shutter" in effect or "motion" in effect for features, *_ in added for effect in features.effects
    )


def test_record_sizes_of_lenses():
    """Bytes of a record; test_assemble.py has those without lenses."""

    def record(kind):
        return record_bytes(select(COLORS, fs.Capture(CAMERAS[kind], quality=PLAIN)))

    assert {kind: record(kind) for kind in CAMERAS} == {
        "pinhole": 80,
        "brown_conrady": 96,
        "fisheye": 96,
        "equirectangular": 96,
        "orthographic": 96,
    }
    assert not any(
        EFFECT_CODE[name].splat
        for name in ("shutter_exposure", "motion_groups", "inverse_lens_lut", "polygon")
    )


@pytest.mark.parametrize("kind", sampled(list(CAMERAS), 2, 3))
def test_every_lens_builds_with_everything_but_a_shutter(renderer, kind):
    """With all outputs, layers, view-dependent colour and moving groups; test_matrix.py adds a shutter."""
    cloud = random_splats(20, seed=1, depth=(1, 4), sh_degree=1).with_coplanar_groups(np.repeat([-1, 0], 10))
    motion = fs.Motion(None, {1: lambda time: np.eye(4)})
    frame = renderer.render(cloud, CAMERAS[kind], ("rgb", *OUTPUTS), None, motion=motion)
    assert all(np.isfinite(frame[name]).all() for name in frame)
