"""The viewer without a browser: images for given settings."""

import math
import threading
from dataclasses import replace

import numpy as np
import pytest
from viewing import HERE, TAG, scene

import fidsplat as fs
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.viewer import session as session_module
from fidsplat.viewer.session import Session
from fidsplat.viewer.settings import AT_REST, Settings


@pytest.fixture
def session():
    viewer_session = Session(scene(), "reference")
    yield viewer_session
    viewer_session.close()


def test_a_viewpoints_camera_sees_what_the_page_does():
    camera = HERE.camera(scene())
    assert (camera.width, camera.height) == (48, 36)
    assert camera.fy == pytest.approx(18 / math.tan(0.4))
    np.testing.assert_allclose(camera.project([[0, 0, 0]]), [[24, 18]])
    small = HERE.camera(scene(), scale=0.5)
    np.testing.assert_allclose(small.project([[0.1, 0.05, 0]]), camera.project([[0.1, 0.05, 0]]) / 2)
    flat = HERE.camera(scene(), "parallel")
    np.testing.assert_allclose(flat.project([[0.1, 0.05, 0]]), camera.project([[0.1, 0.05, 0]]))
    assert HERE.camera(scene(), "fisheye").lens.kind == "fisheye"
    assert HERE.camera(scene(), "panorama").lens.kind == "equirectangular"
    with pytest.raises(fs.InputError, match="unknown lens 'glass'"):
        HERE.camera(scene(), "glass")


def test_the_scenes_own_lens_keeps_its_angle():
    own = fs.Camera.pinhole(96, 72, 80, 88, 48, 36, lens=fs.BrownConrady(k1=-0.1), near=0.3)
    camera = HERE.camera(scene(camera=own), "scene")
    assert (camera.fx, camera.fy, camera.lens, camera.near) == (40, 44, own.lens, 0.3)
    assert Settings.of(scene(camera=own)).lens == "scene"


def test_a_scene_looks_as_its_file_says_until_a_control_is_moved():
    given = scene(
        fog=fs.Fog(0.3, (0.1, 0.2, 0.3)),
        sensor=fs.Sensor(exposure=1.5, full_well=1e4, read_noise=3.0, bits=8),
    )
    settings = Settings.of(given)
    capture = settings.capture(given, HERE.camera(given))
    assert capture.fog == given.fog
    assert capture.sensor == given.sensor
    other = replace(settings, fog=0.0, noise=0.0, exposure=2.0, quality="fast")
    capture = other.capture(given, HERE.camera(given))
    assert capture.fog is None
    assert capture.sensor == fs.Sensor(exposure=2.0, bits=8)
    assert capture.quality == fs.Quality.named("fast")


def test_only_what_moves_has_a_shutter():
    moving = fs.Scene(markers=[PlacedMarker(TAG, motion=lambda time: rigid_matrix((time, 0, 0)))])
    settings = replace(Settings.of(moving), time=0.5, exposure_ms=20.0)
    assert settings.capture(moving, HERE.camera(moving)).has_sub_frames
    assert not settings.capture(scene(), HERE.camera(scene())).has_sub_frames


def test_a_moving_frame_has_coarser_constants_and_its_colours_only():
    settings, camera = Settings.of(scene()), HERE.camera(scene())
    moving, rest = settings.moving(scene(), camera), settings.capture(scene(), camera)
    assert moving.outputs == ("rgb",)
    assert moving.quality == fs.Quality.named("fast")
    assert (rest.outputs, rest.quality) == (AT_REST, fs.Quality())
    quality = (
        "reference,samples=3,transmittance_stop=0.01,lowpass=none"  # coarser in one, a definition in another
    )
    fine = replace(settings, quality=quality).moving(scene(), camera).quality
    expected = fs.Quality.of("fast,transmittance_stop=0.01,lowpass=none")
    assert fine == expected.with_(order=fine.order, marker=fine.marker)


def test_an_image_equals_the_renderers(session):
    view = session.render(HERE)
    camera = fs.Camera.look_at(48, 36, 2 * math.atan(48 / 36 * math.tan(0.4)), (0, 0, -1), (0, 0, 0))
    frame = fs.Renderer("reference").render(scene(), camera, outputs=AT_REST)
    np.testing.assert_allclose(view.frame["rgb"], frame["rgb"], atol=1e-6)
    middle = view.pick(0.5, 0.5)
    assert (middle["label"], middle["marker"]) == (1, "aruco:4x4_50:7")
    assert middle["depth"] == pytest.approx(1.0, abs=1e-3)
    assert middle["pixel"] == (24, 18)
    corner = view.pick(0.0, 1.0)
    assert (corner["label"], corner["depth"], corner["marker"], corner["pixel"]) == (-1, None, None, (0, 35))


def test_settings_and_scenes_are_exchanged(session):
    messages = []
    before = session.render(HERE).frame["rgb"]
    session.request(settings=replace(session.state.settings, fog=1.0), done=messages.append)
    assert session.settle()
    foggy = session.render(HERE).frame["rgb"]
    assert np.abs(foggy - before).max() > 0.1
    _, settings = session.requested()
    moved = replace(session.state.scene, markers=[PlacedMarker(TAG, rigid_matrix((0.2, 0, 0)))])
    session.request(scene=moved, done=messages.append)
    assert session.settle()
    assert session.render(HERE).pick(0.05, 0.5)["label"] == -1
    assert session.state.settings == settings  # a new scene keeps the controls
    assert session.state.version == 2
    assert messages == [None, None]


def test_invalid_frames_change_nothing(session):
    messages = []
    state = session.state
    for wrong in ({"device": "opencl:nowhere"}, {"quality": "best"}, {"fog": -1.0, "exposure": -1.0}):
        session.request(settings=replace(state.settings, **wrong), done=messages.append)
        assert session.settle()
    assert session.state is state
    assert "nowhere" in messages[0]
    assert "unknown quality 'best'" in messages[1]
    assert "exposure" in messages[2]


def test_a_switch_never_blocks(session, monkeypatch):
    """The old renderer renders while the new one is opened."""
    compiling, go_on = threading.Event(), threading.Event()
    make_renderer = session_module.Renderer

    def slow(*words):
        compiling.set()
        assert go_on.wait(20)
        return make_renderer(*words)

    monkeypatch.setattr(session_module, "Renderer", slow)
    changed = []
    session.changed = lambda: changed.append(session.state.settings.fog)
    session.request(settings=replace(session.state.settings, fog=0.5))
    assert compiling.wait(20)
    assert session.render(HERE).state.settings.fog == 0
    assert session.requested()[1].fog == 0.5  # the next control builds upon it
    assert changed == []
    go_on.set()
    assert session.settle()
    assert session.render(HERE).state.settings.fog == 0.5
    assert changed == [0.5]


def test_numbers_open_no_renderer(session, monkeypatch):
    session.request(settings=replace(session.state.settings, fog=0.5))
    assert session.settle()
    monkeypatch.setattr(session_module, "Renderer", None)
    resident = session.state.resident
    session.request(settings=replace(session.state.settings, fog=0.7))
    assert session.settle()
    assert session.state.settings.fog == 0.7
    assert session.state.resident is resident
