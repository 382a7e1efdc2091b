"""The viewer without a browser: what is drawn by which settings, pacing, poses that go back into scene
files."""

import math
import socket
import threading
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.rotations import rigid_matrix
from fidsplat.scenes import PlacedMarker
from fidsplat.viewer import session as session_module
from fidsplat.viewer.edits import Body, SceneFile, placed
from fidsplat.viewer.guard import guarded, refused
from fidsplat.viewer.session import Session
from fidsplat.viewer.settings import AT_REST, Settings, Viewpoint
from fidsplat.viewer.stream import REST, SMALLEST, Pace, Stream

HERE = Viewpoint((0.0, 0.0, -1.0), (1.0, 0.0, 0.0, 0.0), 0.8, 48, 36)
TAG = fs.marker("aruco:4x4_50:7", size=0.4)


def scene(**parts) -> fs.Scene:
    return fs.Scene(markers=[PlacedMarker(TAG)], background=(0.2, 0.3, 0.4), **parts)


@pytest.fixture
def session():
    made = Session(scene(), "reference")
    yield made
    made.close()


# settings


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
    assert settings.capture(moving, HERE.camera(moving)).exposed
    assert not settings.capture(scene(), HERE.camera(scene())).exposed


def test_a_moving_picture_has_coarser_constants_and_its_colours_alone():
    settings, camera = Settings.of(scene()), HERE.camera(scene())
    moving, rest = settings.moving(scene(), camera), settings.capture(scene(), camera)
    assert moving.outputs == ("rgb",)
    assert moving.quality == fs.Quality.named("fast")
    assert (rest.outputs, rest.quality) == (AT_REST, fs.Quality())
    asked = (
        "reference,samples=3,transmittance_stop=0.01,lowpass=none"  # coarser in one, a definition in another
    )
    fine = replace(settings, quality=asked).moving(scene(), camera).quality
    wanted = fs.Quality.of("fast,transmittance_stop=0.01,lowpass=none")
    assert fine == wanted.with_(order=fine.order, marker=fine.marker)


# the session


def test_a_picture_is_that_of_the_renderer(session):
    view = session.draw(HERE)
    camera = fs.Camera.look_at(48, 36, 2 * math.atan(48 / 36 * math.tan(0.4)), (0, 0, -1), (0, 0, 0))
    frame = fs.Renderer("reference").render(scene(), camera, outputs=AT_REST)
    np.testing.assert_allclose(view.frame["rgb"], frame["rgb"], atol=1e-6)
    middle = view.at(0.5, 0.5)
    assert (middle["label"], middle["marker"]) == (1, "aruco:4x4_50:7")
    assert middle["depth"] == pytest.approx(1.0, abs=1e-3)
    assert middle["pixel"] == (24, 18)
    corner = view.at(0.0, 1.0)
    assert (corner["label"], corner["depth"], corner["marker"], corner["pixel"]) == (-1, None, None, (0, 35))


def test_settings_and_scenes_are_exchanged(session):
    told = []
    before = session.draw(HERE).frame["rgb"]
    session.wish(settings=replace(session.drawn.settings, fog=1.0), done=told.append)
    assert session.settle()
    foggy = session.draw(HERE).frame["rgb"]
    assert np.abs(foggy - before).max() > 0.1
    _, settings = session.wanted()
    moved = replace(session.drawn.scene, markers=[PlacedMarker(TAG, rigid_matrix((0.2, 0, 0)))])
    session.wish(scene=moved, done=told.append)
    assert session.settle()
    assert session.draw(HERE).at(0.05, 0.5)["label"] == -1
    assert session.drawn.settings == settings  # a new scene keeps the controls
    assert session.drawn.version == 2
    assert told == [None, None]


def test_what_cannot_be_drawn_changes_nothing(session):
    told = []
    drawn = session.drawn
    for wrong in ({"device": "opencl:nowhere"}, {"quality": "best"}, {"fog": -1.0, "exposure": -1.0}):
        session.wish(settings=replace(drawn.settings, **wrong), done=told.append)
        assert session.settle()
    assert session.drawn is drawn
    assert "nowhere" in told[0]
    assert "unknown quality 'best'" in told[1]
    assert "exposure" in told[2]


def test_a_switch_never_blocks(session, monkeypatch):
    """While the new renderer is made, the old one draws."""
    compiling, go_on = threading.Event(), threading.Event()
    made = session_module.Renderer

    def slow(*words):
        compiling.set()
        assert go_on.wait(20)
        return made(*words)

    monkeypatch.setattr(session_module, "Renderer", slow)
    changed = []
    session.changed = lambda: changed.append(session.drawn.settings.fog)
    session.wish(settings=replace(session.drawn.settings, fog=0.5))
    assert compiling.wait(20)
    assert session.draw(HERE).drawn.settings.fog == 0
    assert session.wanted()[1].fog == 0.5  # the next control builds upon it
    assert changed == []
    go_on.set()
    assert session.settle()
    assert session.draw(HERE).drawn.settings.fog == 0.5
    assert changed == [0.5]


def test_numbers_alone_open_no_renderer(session, monkeypatch):
    session.wish(settings=replace(session.drawn.settings, fog=0.5))
    assert session.settle()
    monkeypatch.setattr(session_module, "Renderer", None)
    resident = session.drawn.resident
    session.wish(settings=replace(session.drawn.settings, fog=0.7))
    assert session.settle()
    assert session.drawn.settings.fog == 0.7
    assert session.drawn.resident is resident


# pacing


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def looked_at(moving_takes=lambda scale: 0.0):
    """A stream with a clock of its own, and what it drew."""
    clock, drawn = Clock(), []

    def moving(viewpoint, scale):
        drawn.append((viewpoint.position[0], scale))
        clock.now += moving_takes(scale)

    stream = Stream(moving, lambda viewpoint: drawn.append((viewpoint.position[0], "exact")), clock=clock)
    return stream, clock, drawn


def at(x) -> Viewpoint:
    return replace(HERE, position=(x, 0.0, 0.0))


def test_the_newest_viewpoint_then_one_exact_picture_then_nothing():
    stream, clock, drawn = looked_at()
    assert stream.step() is None  # nobody looks yet
    for x in (1.0, 2.0, 3.0):
        stream.look(at(x))
    assert stream.step() == 0.0
    assert drawn == [(3.0, 0.5)]
    assert stream.step() == pytest.approx(REST)
    assert len(drawn) == 1
    clock.now += REST
    assert stream.step() == 0.0
    assert drawn[1:] == [(3.0, "exact")]
    for _ in range(3):
        clock.now += 60
        assert stream.step() is None
    stream.look(at(3.0))  # the same again is no news
    assert stream.step() is None
    stream.refresh()
    assert stream.step() == 0.0
    assert drawn[2][0] == 3.0
    assert len(drawn) == 3


@pytest.mark.parametrize("full", [0.01, 0.05, 0.2])
def test_the_scale_holds_the_rate(full):
    """Of a machine that takes so long for a picture of the page's size."""
    stream, _, drawn = looked_at(lambda scale: full * scale**2)
    for k in range(40):
        stream.look(at(float(k)))
        stream.step()
    last = drawn[-1][1]
    assert last == stream.pace.steps
    if full < 0.03:
        assert last == 1.0
    else:
        assert full * last**2 == pytest.approx(0.9 / 30, rel=0.1)


def test_the_scale_has_an_end():
    pace = Pace()
    for _ in range(50):
        pace.took(10.0, pace.steps)
    assert pace.steps == SMALLEST
    for _ in range(50):
        pace.took(1e-9, pace.steps)
    assert pace.steps == 1.0


def test_a_picture_that_fails_is_told_and_the_stream_goes_on():
    told = []

    def refused(*_):
        raise fs.InputError("too large")

    stream = Stream(refused, refused, told.append, clock=Clock())
    stream.look(HERE)
    assert stream.step() == 0.0
    assert told == ["too large"]
    assert stream.step() is not None


def test_a_picture_that_is_too_large_for_the_memory_is_told():
    told: list[str] = []

    def draw(*_):
        raise MemoryError

    stream = Stream(draw, draw, told.append, clock=lambda: 0.0)
    stream.look(HERE)
    stream.step()
    assert told == ["not enough memory for this picture"]


def test_a_stream_runs_in_a_thread_until_it_is_closed():
    seen = threading.Event()
    stream = Stream(lambda *_: None, lambda *_: seen.set())
    thread = threading.Thread(target=stream.run)
    thread.start()
    stream.look(HERE)
    assert seen.wait(20)
    stream.close()
    thread.join(20)
    assert not thread.is_alive()


# poses that go back into scene files

FILE = """# a scene, with words of its own
[camera]   # where from
width = 33

[[markers]]
spec = "aruco:4x4_50:7"   # the first
size = 0.4

[[ markers ]] # the second
spec = "aruco:4x4_50:8"
size = 0.4
position = [ 1.0,
             2.0, 3.0 ]  # metres
quaternion = [1, 0, 0, 0]

[render]
outputs = ["rgb"]
"""
POSE = rigid_matrix((0.25, -0.5, 1 / 3), (math.cos(0.3), 0, math.sin(0.3), 0))


@pytest.mark.parametrize("number", [0, 1])
def test_a_moved_marker_goes_back_into_its_file(number):
    new = placed(FILE, number, POSE, "scene.toml")
    said, before = tomllib.loads(new), tomllib.loads(FILE)
    marker = said["markers"][number]
    np.testing.assert_allclose(rigid_matrix(marker["position"], marker["quaternion"]), POSE, atol=1e-8)
    for key in ("position", "quaternion"):
        marker.pop(key), before["markers"][number].pop(key, None)
    assert said == before
    for words in ("# a scene, with words", "# the first", "# the second", "# where from"):
        assert words in new
    assert placed(new, number, POSE, "") == new


@pytest.mark.parametrize(
    ("text", "number"),
    [(FILE, 2), ('markers = [{spec = "a", size = 1.0}]\n', 0), ("x = '''\n[[markers]]\n'''", 0), ("[", 0)],
)
def test_a_file_that_is_written_otherwise_is_left_alone(text, number):
    with pytest.raises(
        fs.InputError, match=rf"s.toml: the pose of marker {number} is not written.*put position"
    ):
        placed(text, number, POSE, "s.toml")


def test_a_file_that_was_edited_meanwhile_is_not_written(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(FILE)
    file = SceneFile(path)
    assert not file.changed()
    file.place(0, POSE)
    assert not file.changed()  # our own hand
    assert "position = [0.25, -0.5, 0.333333333]" in path.read_text()
    path.write_text(FILE + "\n# edited")
    with pytest.raises(fs.InputError, match="was edited meanwhile; it is read again"):
        file.place(0, POSE)
    assert path.read_text() == FILE + "\n# edited"
    text = file.changed()
    assert text == FILE + "\n# edited"
    assert file.changed() is None
    with pytest.raises(fs.InputError, match="was edited meanwhile"):
        file.place(0, POSE)  # until the scene of that text is shown
    file.text = text
    file.place(0, POSE)
    path.unlink()
    with pytest.raises(fs.InputError, match="cannot read"):
        file.changed()


def test_a_link_to_a_scene_file_stays_one(tmp_path):
    (tmp_path / "real.toml").write_text(FILE)
    link = tmp_path / "scene.toml"
    link.symlink_to("real.toml")
    SceneFile(link).place(0, POSE)
    assert link.is_symlink()
    assert "position = [0.25" in (tmp_path / "real.toml").read_text()


# the page, with a client that is none


class Client(SimpleNamespace):
    """What the server uses of viser's handle of a browser."""

    def __init__(self, number=1):
        sent: list = []
        said = SimpleNamespace(content="")
        camera = SimpleNamespace(
            position=(0, 0, -1), wxyz=(1, 0, 0, 0), fov=0.8, image_width=48, image_height=36,
            look_at=(0, 0, 0),
            on_update=lambda callback: setattr(self, "turned", callback),
        )  # fmt: skip
        super().__init__(
            client_id=number, sent=sent, said=said, files=[], camera=camera,
            gui=SimpleNamespace(add_folder=lambda _: _Folder(), add_markdown=lambda _: said),
            scene=SimpleNamespace(
                set_background_image=lambda image, kind, **_: sent.append((image, kind))
            ),
            send_file_download=lambda name, content: self.files.append((name, content)),
        )  # fmt: skip


class _Folder:
    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None


@pytest.fixture
def viewer(tmp_path):
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from fidsplat.viewer.server import Viewer

    (tmp_path / "scene.toml").write_text(
        '[[markers]]\nspec = "aruco:4x4_50:7"\nsize = 0.4\n[render]\nbackground = [0.2, 0.3, 0.4]\n'
    )
    path = tmp_path / "scene.toml"
    made = Viewer(fs.Scene.load(path), path, "reference", port=0)
    yield made
    made.close()


def until(condition) -> bool:
    waited = threading.Event()
    for _ in range(400):
        if condition():
            return True
        waited.wait(0.05)
    return False


def test_what_a_browser_gets_and_asks(viewer):
    client = Client()
    viewer._enter(client)
    assert until(lambda: [kind for _, kind in client.sent][-1:] == ["png"])
    assert client.sent[-1][0].shape == (36, 48, 3)
    viewer._click(SimpleNamespace(client_id=1, screen_pos=(0.5, 0.5)))
    assert "label 1" in client.said.content
    assert "marker aruco:4x4_50:7" in client.said.content
    assert "depth 1.0000 m" in client.said.content
    viewer._click(SimpleNamespace(client_id=9, screen_pos=(0.5, 0.5)))  # a browser that has left
    viewer.picture(client)
    assert client.files[0][0] == "fidsplat.png"
    assert client.files[0][1].startswith(b"\x89PNG")
    client.camera.image_width, client.camera.image_height = 320, 240
    count = len(client.sent)
    client.turned(client.camera)
    assert until(lambda: client.sent[count:] and client.sent[-1][0].shape == (240, 320, 3))
    assert until(lambda: viewer._views[1].frame["rgb"].shape == (240, 320, 3))
    viewer.read(client)
    assert "| aruco:4x4_50:7 | 0." in client.said.content
    viewer._leave(client)
    viewer._leave(client)
    viewer.read(client)


def test_what_a_button_cannot_do_is_said(viewer, monkeypatch):
    client = Client()
    viewer._said[1] = client.said
    viewer.read(client)
    assert client.said.content == "Wait until the picture is still, then ask again."
    viewer.picture(client)  # of a browser that has left
    viewer._streams[1] = Stream(lambda *_: None, lambda *_: None)

    def fails(viewpoint):
        raise MemoryError

    monkeypatch.setattr(viewer.session, "draw", fails)
    viewer.picture(client)
    assert "**not enough memory for this picture**" in viewer._controls.status.content
    assert client.files == []


def test_a_gizmo_moves_a_marker_and_its_file(viewer, tmp_path):
    viewer.hold("1: aruco:4x4_50:7")
    pose = rigid_matrix((0.1, 0.0, 0.2))
    viewer._move(pose, False)
    assert viewer.session.settle()
    np.testing.assert_allclose(viewer.session.drawn.scene.markers[0].pose, pose)
    assert "position" not in (tmp_path / "scene.toml").read_text()
    viewer._move(pose, True)
    assert viewer.session.settle()
    again = fs.Scene.load(tmp_path / "scene.toml")
    np.testing.assert_allclose(again.markers[0].pose, pose, atol=1e-8)
    viewer.hold("none")
    viewer._move(np.eye(4), True)
    np.testing.assert_allclose(fs.Scene.load(tmp_path / "scene.toml").markers[0].pose, pose, atol=1e-8)


def test_a_gizmo_moves_a_splat_file(viewer, tmp_path):
    """Its scale stays, and what the file says is what is shown."""
    viewer.close()
    path = tmp_path / "scene.toml"
    cloud = fs.SplatCloud(
        [[0, 0, 0], [1, 0, 0]], [[1, 0, 0, 0]] * 2, [[0.1, 0.1]] * 2, [1, 1], colors=[[1, 0, 0]] * 2
    )
    fs.save_ply(cloud, tmp_path / "box.ply")
    path.write_text(
        path.read_text() + '[[splats]]\nfile = "box.ply"\n\n'
        '[[splats]]\nfile = "box.ply"\nscale = 2.0 # twice\nposition = [0, 0, 1]\n'
        '[[splats]]\nfile = "box.ply"\nmotion = [{time = 0, position = [0, 0, 5]}, '
        "{time = 1, position = [0, 0, 6]}]\n"
    )
    viewer = type(viewer)(fs.Scene.load(path), path, "reference", port=0)
    viewer._closed.set()  # nobody looks at the file meanwhile
    try:
        assert viewer._controls._held.options[2:] == ("file 1: box.ply", "file 2: box.ply", "file 3: box.ply")
        viewer.hold("file 2: box.ply")
        np.testing.assert_allclose(viewer._held.pose, rigid_matrix((0, 0, 1)))
        pose = rigid_matrix((0.5, 0, 2), (0, 0, 1, 0))
        for let_go in (False, True):
            viewer._move(pose, let_go)
            assert viewer.session.settle()
            moved = viewer.session.drawn.scene.clouds
            np.testing.assert_allclose(moved[1].world_means(), [(0.5, 0, 2), (-1.5, 0, 2)], atol=1e-6)
            assert ("0.5" in path.read_text()) == let_go
        assert "scale = 2.0 # twice" in path.read_text()
        again = fs.Scene.load(path)
        for one, other in zip(again.clouds, moved, strict=True):
            np.testing.assert_allclose(one.world_means(), other.world_means(), atol=1e-6)
        viewer.hold("file 1: box.ply")  # which has no pose in the file
        viewer._move(rigid_matrix((0, 3, 0)), True)
        assert viewer.session.settle()
        np.testing.assert_allclose(fs.Scene.load(path).clouds[0].world_means()[0], (0, 3, 0))
        viewer.hold("file 3: box.ply")
        assert viewer._held is None
        assert "moves by keyframes" in viewer._controls.status.content
        # what cannot be written stays where the file says that it is
        viewer.hold("file 2: box.ply")
        before = path.read_text()
        path.write_text(before + "# edited\n")
        viewer._move(rigid_matrix((9, 9, 9)), True)
        assert viewer.session.settle()
        assert "nothing was written" in viewer._controls.status.content
        np.testing.assert_allclose(
            viewer.session.drawn.scene.clouds[1].world_means()[0], (0.5, 0, 2), atol=1e-6
        )
        assert path.read_text() == before + "# edited\n"
        viewer.hold("file 9: none")
        viewer._move(np.eye(4), True)
    finally:
        viewer.close()


def test_large_splat_files_move_once_they_are_let_go(monkeypatch):
    from fidsplat.viewer import held

    cloud = fs.SplatCloud([[0, 0, 0]], [[1, 0, 0, 0]], [[0.1, 0.1]], [1], colors=[[1, 0, 0]])
    taken = held.held_by(fs.Scene([cloud]), [Body(0, "a.ply", np.eye(4))], "file 1: a.ply")
    assert taken.light
    monkeypatch.setattr(held, "LIGHT", 0)
    assert not taken.light


def test_a_file_that_is_edited_is_shown(viewer, tmp_path):
    text = (tmp_path / "scene.toml").read_text()
    (tmp_path / "scene.toml").write_text(text.replace("0.4\n", "0.2\n", 1))
    assert until(lambda: viewer.session.drawn.scene.markers[0].marker.size == 0.2)
    (tmp_path / "scene.toml").write_text(text.replace("size", "sise"))
    assert until(lambda: "what was read before is shown" in viewer._controls.status.content)
    assert "did you mean 'size'" in viewer._controls.status.content
    assert viewer.session.drawn.scene.markers[0].marker.size == 0.2


def test_what_an_edit_changes_is_taken_and_the_controls_follow(viewer, tmp_path):
    """What it leaves stays as the controls have it."""
    path, sliders = tmp_path / "scene.toml", viewer._controls._sliders
    sliders["exposure"].value = 2.0
    assert viewer.session.settle()
    edited = (
        path.read_text()
        + "[fog]\ndensity = 3\n[camera]\nwidth = 48\nheight = 36\nfov_x_deg = 60\n"
        + "position = [0, 0, -1]\nlook_at = [0, 0, 0]\n[camera.distortion]\nk1 = -0.1\n"
    )
    path.write_text(edited)
    assert until(lambda: viewer._controls._lens.value == "scene")
    assert until(lambda: not viewer._controls._session._working)
    settings = viewer.session.drawn.settings
    assert (settings.fog, settings.lens, settings.exposure) == (3.0, "scene", 2.0)
    assert (sliders["fog"].value, sliders["exposure"].value) == (3.0, 2.0)
    assert sliders["fog"].max >= 3.0
    path.write_text(edited.partition("[camera.distortion]")[0])
    assert until(lambda: "scene" not in viewer._controls._lens.options)
    assert viewer.session.settle()
    settings = viewer.session.drawn.settings
    assert (settings.fog, settings.lens, settings.exposure) == (3.0, "pinhole", 2.0)


def test_a_marker_is_not_written_into_a_file_that_cannot_be_shown(viewer, tmp_path):
    """Its tables may be those of other markers."""
    file, table = tmp_path / "scene.toml", '[[markers]]\nspec = "aruco:4x4_50:8"\nsize = 0.4\n'
    edited = table.replace("0.4", "-1") + file.read_text()
    viewer.hold("1: aruco:4x4_50:7")
    file.write_text(edited)
    assert until(lambda: "what was read before is shown" in viewer._controls.status.content)
    viewer._move(rigid_matrix((0.1, 0.0, 0.2)), True)
    assert viewer.session.settle()
    assert file.read_text() == edited
    assert "nothing was written" in viewer._controls.status.content
    file.write_text(edited.replace("-1", "0.4"))
    assert until(lambda: len(viewer._controls._held.options) == 3)
    assert viewer._controls._held.options[2] == "2: aruco:4x4_50:7"
    viewer._move(np.eye(4), True)  # nothing is held any more
    assert "position" not in file.read_text()
    viewer.hold("2: aruco:4x4_50:7")
    viewer._move(rigid_matrix((0.1, 0.0, 0.2)), True)
    assert viewer.session.settle()
    np.testing.assert_allclose(fs.Scene.load(file).markers[1].pose[:3, 3], (0.1, 0, 0.2))
    viewer.hold("9: nobody")
    viewer._move(np.eye(4), True)


def test_a_browser_that_left_keeps_nothing(viewer):
    client = Client(5)
    viewer._send_exact(client, HERE)
    assert viewer._views == {}


def test_keyframes_become_a_trajectory(viewer, tmp_path):
    client = Client()
    viewer.save_keyframes(client)
    assert "no keyframe" in viewer._controls.status.content
    viewer.add_keyframe(client)
    client.camera.position = (0.5, 0, -1)
    viewer.add_keyframe(client)
    viewer.save_keyframes(client)
    path = fs.load_trajectory(tmp_path / "scene-trajectory.tum")
    assert path.times.tolist() == [0, 1]
    np.testing.assert_allclose(path.poses[:, :3, 3], [(0, 0, -1), (0.5, 0, -1)])
    viewer.clear_keyframes(client)
    assert viewer._keyframes == []


def test_keyframes_do_not_take_the_place_of_another_file(viewer, tmp_path):
    (tmp_path / "scene-trajectory.tum").write_text("0.5 0 0 0 0 0 0 1\n")
    client = Client()
    for count in (1, 2):
        viewer.add_keyframe(client)
        viewer.save_keyframes(client)
        assert len(fs.load_trajectory(tmp_path / "scene-trajectory-2.tum")) == count
    assert (tmp_path / "scene-trajectory.tum").read_text() == "0.5 0 0 0 0 0 0 1\n"
    assert len(list(tmp_path.glob("*.tum"))) == 2


def test_a_trajectory_stands_there_as_keyframes(tmp_path):
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from fidsplat.viewer.server import Viewer

    path = fs.Trajectory(range(100), [rigid_matrix((k, 0, 0)) for k in range(100)])
    viewer = Viewer(scene(), None, "reference", port=0, keyframes=path)
    try:
        assert len(viewer._keyframes) == 100
        assert len(viewer._nodes._frusta) == 50  # not all of many
        viewer.add_keyframe(Client())
        assert len(viewer._keyframes) == 101
    finally:
        viewer.close()


# who may speak to it


@pytest.mark.parametrize(
    ("origin", "host", "listens", "words"),
    [
        (None, "localhost:8080", "127.0.0.1", ""),  # no browser
        ("http://localhost:8080", "localhost:8080", "127.0.0.1", ""),
        ("http://127.0.0.1:9", "127.0.0.1:9", "127.0.0.1", ""),  # a tunnel has a port of its own
        ("http://[::1]:8080", "[::1]:8080", "::1", ""),
        ("https://LOCALHOST", "localhost", "localhost", ""),
        ("http://evil.test", "localhost:8080", "127.0.0.1", "of another site"),
        ("http://localhost:3000", "localhost:8080", "127.0.0.1", "of another site"),
        ("null", "localhost:8080", "127.0.0.1", "of another site"),
        ("http://localhost:8080", None, "127.0.0.1", "of another site"),
        ("null", None, "127.0.0.1", "another name"),
        ("http://[x", "localhost:8080", "127.0.0.1", "no address"),
        # a name of theirs that was made to point here
        ("http://evil.test:8080", "evil.test:8080", "127.0.0.1", "another name"),
        ("http://evil.test:8080", "evil.test:8080", "0.0.0.0", "another name"),
        ("http://10.0.0.7:8080", "10.0.0.7:8080", "127.0.0.1", "another name"),
        ("http://10.0.0.7:8080", "10.0.0.7:8080", "0.0.0.0", ""),
        ("http://lab.test:8080", "lab.test:8080", "lab.test", ""),
        (f"http://{socket.gethostname()}:1", f"{socket.gethostname()}:1", "0.0.0.0", ""),
    ],
)
def test_pages_of_others_are_refused(origin, host, listens, words):
    found = refused(origin, host, listens)
    assert words in found
    assert bool(words) == bool(found)


def test_a_page_of_another_site_gets_no_socket(viewer):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    port = viewer.server.get_port()
    for words in (
        {"origin": "http://evil.test"},
        {"origin": f"http://evil.test:{port}", "host": "evil.test"},  # a name that was made to point here
    ):
        host = words.pop("host", "127.0.0.1")
        with (
            socket.create_connection(("127.0.0.1", port)) as line,
            pytest.raises(InvalidStatus, match="403") as found,
        ):
            connect(f"ws://{host}:{port}", sock=line, **words)
        assert b"this" in found.value.response.body
    assert not viewer._streams
    connect(f"ws://127.0.0.1:{port}", origin=f"http://127.0.0.1:{port}").close()


def test_a_server_that_is_not_guarded_is_stopped():
    pytest.importorskip("websockets", reason="the extra viewer is not installed")
    stopped = []
    with pytest.raises(fs.FidsplatError, match="cannot guard"):
        guarded(lambda: SimpleNamespace(stop=lambda: stopped.append(True)), "127.0.0.1")
    assert stopped == [True]


def test_a_port_in_use_is_said():
    from fidsplat.viewer.server import check_port

    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(fs.InputError, match=rf"cannot listen on 127.0.0.1, port {port}: .*in use; give"):
            check_port("127.0.0.1", port)
    check_port("127.0.0.1", port)
    with pytest.raises(fs.InputError, match="port 70000"):
        check_port("127.0.0.1", 70000)


@pytest.mark.parametrize(
    ("host", "words"),
    [
        ("", "--host is empty"),  # which would let the whole network in
        ("192.0.2.1", "--host must be an address of this machine"),
        ("a..b", "--host must be an address of this machine"),
    ],
)
def test_a_host_that_is_none_of_ours_is_said(host, words):
    from fidsplat.viewer.server import check_port

    with pytest.raises(fs.InputError, match=words):
        check_port(host, 0)


@pytest.mark.parametrize(
    ("host", "address"), [("127.0.0.1", "http://127.0.0.1:80"), ("::1", "http://[::1]:80")]
)
def test_the_address_can_be_opened(host, address):
    from fidsplat.viewer.server import Viewer

    server = SimpleNamespace(get_host=lambda: host, get_port=lambda: 80)
    assert Viewer.address.fget(SimpleNamespace(server=server)) == address
