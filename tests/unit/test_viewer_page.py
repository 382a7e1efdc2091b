"""The viewer's page, with a client instead of a browser."""

import base64
import hashlib
import html
import re
import socket
import urllib.request
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from viewing import HERE, Client, scene, until

import fidsplat as fs
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.viewer.scene_file import SplatFile
from fidsplat.viewer.session import StillImage
from fidsplat.viewer.settings import Settings
from fidsplat.viewer.stream import Stream


@pytest.fixture
def viewer(tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from fidsplat.viewer import server
    from fidsplat.viewer.server import Viewer

    monkeypatch.setattr(server, "POLL_INTERVAL", 0.1)
    (tmp_path / "scene.toml").write_text(
        '[[markers]]\nspec = "aruco:4x4_50:7"\nsize = 0.4\n[render]\nbackground = [0.2, 0.3, 0.4]\n'
    )
    path = tmp_path / "scene.toml"
    running_viewer = Viewer(fs.Scene.load(path), path, "reference", port=0)
    yield running_viewer
    running_viewer.close()


def edit(path, text):
    """Replace a file at once: a viewer that reads it after its truncation shows a part of it."""
    path.with_suffix(".new").write_text(text)
    path.with_suffix(".new").replace(path)


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
    viewer.save_image(client)
    assert client.files[0][0] == "fidsplat.png"
    assert client.files[0][1].startswith(b"\x89PNG")
    client.camera.image_width, client.camera.image_height = 320, 240
    count = len(client.sent)
    client.turned(client.camera)
    assert until(lambda: client.sent[count:] and client.sent[-1][0].shape == (240, 320, 3))
    assert until(lambda: viewer._views[1].frame["rgb"].shape == (240, 320, 3))
    viewer.detect_markers(client)
    assert "| aruco:4x4_50:7 | 0." in client.said.content
    viewer._leave(client)
    viewer._leave(client)
    viewer.detect_markers(client)


def test_a_marker_that_moves_is_read_where_it_is_at_the_time_of_the_image(viewer):
    def slide(time):
        return rigid_matrix((0.1 * time, 0, 0))

    (still,) = scene().markers
    moving = fs.Scene(markers=[replace(still, motion=slide)], background=(0.2, 0.3, 0.4))
    state = replace(viewer.session.state, scene=moving, settings=replace(Settings.of(moving), time=1.0))
    capture = state.settings.capture(moving, replace(HERE, width=320, height=240).camera(moving, "scene"))
    client = Client()
    viewer._messages[1] = client.said
    viewer._views[1] = StillImage(state.renderer.render(moving, capture), state, HERE)
    viewer.detect_markers(client)
    assert "| aruco:4x4_50:7 | 0." in client.said.content  # millimetres, not 100 of them


def test_texts_of_a_scene_are_no_markup(viewer, monkeypatch):
    """viser's Markdown holds raw HTML, and images by the server's own files: a marker's text, which scene
    files and photographs bring, could run scripts and read files."""
    hostile = "qr:<iframe srcdoc='<script>x</script>'>![a](/etc/passwd)[b](javascript:x) | &lt;\n\n<b>"
    shown = " ".join(hostile.split())
    client, box = Client(), viewer.session
    state = box.state
    marker = replace(state.scene.markers[0].marker, spec=hostile)
    placed = replace(state.scene.markers[0], marker=marker)
    viewer._enter(client)
    assert until(lambda: 1 in viewer._views)
    view = viewer._views[1]
    scene = replace(state.scene, markers=(placed,))
    viewer._views[1] = replace(view, state=replace(view.state, scene=scene))

    def is_text(content, text):
        assert text in html.unescape(content)
        assert not re.search(r"[<\[\]!]|&(?!#\d+;)", content), content

    viewer._click(SimpleNamespace(client_id=1, screen_pos=(0.5, 0.5)))
    is_text(client.said.content, f"marker {shown}")
    reading = SimpleNamespace(
        as_dict=lambda: {"marker": hostile, "position_error_mm": 1.0, "angle_error_deg": 2.0}
    )
    code = SimpleNamespace(name=hostile)
    monkeypatch.setattr("fidsplat.viewer.server.read_back", lambda *_: ([reading], [code]))
    viewer.detect_markers(client)
    is_text(client.said.content, f"| {shown} | 1.00 | 2.00 |")
    is_text(client.said.content, f"not in the scene: {shown}")
    assert client.said.content.count("|") == 12  # three cells a row

    def fails(*_):
        raise fs.InputError(hostile)

    monkeypatch.setattr("fidsplat.viewer.server.read_back", fails)
    viewer.detect_markers(client)
    is_text(client.said.content, shown)
    viewer._controls.show_status(hostile)
    is_text(viewer._controls.status.content, f"**{shown}**")


def test_the_page_runs_its_own_scripts_only(viewer):
    with urllib.request.urlopen(viewer.address) as answer:
        policy, page = answer.headers["Content-Security-Policy"], answer.read().decode()
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["frame-src"] == rules["object-src"] == rules["base-uri"] == "'none'"
    scripts = rules["script-src"].split()
    assert "'unsafe-inline'" not in scripts
    (loader,) = re.findall(r"<script [^>]*>(.*?)</script>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(loader.encode()).digest()).decode()
    assert f"'sha256-{digest}'" in scripts
    assert len([word for word in scripts if word.startswith("'sha256-")]) == 2  # and the packed program


def test_a_camera_that_is_none_does_not_end_a_stream(viewer):
    client = Client()
    viewer._enter(client)
    assert until(lambda: 1 in viewer._views)
    before, near = dict(vars(client.camera)), viewer._views[1].frame["label"] == 1
    for changes in (
        {"fov": 0.0},
        {"fov": np.nan},
        {"fov": 3.2},
        {"position": (np.nan, 0, 0)},
        {"wxyz": (0, 0, 0, 0)},
        {"look_at": (np.inf, 0, 0)},
        {"image_width": 10**6},
    ):
        vars(client.camera).update(before | changes)
        viewer._controls.show_status("")
        client.turned(client.camera)
        assert "the page" in viewer._controls.status.content
        viewer.add_keyframe(client)
        viewer.save_image(client)
        assert viewer._keyframes == client.files == []
    vars(client.camera).update(before | {"position": (0, 0, -2)})
    client.turned(client.camera)
    assert until(lambda: viewer._views[1].viewpoint.position == (0, 0, -2))
    far = viewer._views[1].frame["label"] == 1
    assert 0.15 < far.sum() / near.sum() < 0.35, "the image after the move: a quarter of the area"


def test_what_a_button_cannot_do_is_reported(viewer, monkeypatch):
    client = Client()
    viewer._messages[1] = client.said
    viewer.detect_markers(client)
    assert client.said.content == "Wait for the exact image, then detect again."
    viewer.save_image(client)  # of a browser that has left
    viewer._streams[1] = Stream(lambda *_: None, lambda *_: None)

    def fails(viewpoint):
        raise MemoryError

    monkeypatch.setattr(viewer.session, "render", fails)
    viewer.save_image(client)
    assert "**not enough memory for this image**" in viewer._controls.status.content
    assert client.files == []


def test_a_gizmo_moves_a_marker_and_its_file(viewer, tmp_path):
    viewer.select_target("1: aruco:4x4_50:7")
    pose = rigid_matrix((0.1, 0.0, 0.2))
    viewer._move(pose, False)
    assert viewer.session.settle()
    np.testing.assert_allclose(viewer.session.state.scene.markers[0].pose, pose)
    assert "position" not in (tmp_path / "scene.toml").read_text()
    viewer._move(pose, True)
    assert viewer.session.settle()
    again = fs.Scene.load(tmp_path / "scene.toml")
    np.testing.assert_allclose(again.markers[0].pose, pose, atol=1e-8)
    viewer.select_target("none")
    viewer._move(np.eye(4), True)
    np.testing.assert_allclose(fs.Scene.load(tmp_path / "scene.toml").markers[0].pose, pose, atol=1e-8)


def test_a_gizmo_moves_a_splat_file(viewer, tmp_path):
    """The scale is unchanged, and the controls show the content of the file."""
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
    viewer._closed.set()  # the file is not polled
    try:
        assert viewer._controls._targets.options[2:] == (
            "file 1: box.ply",
            "file 2: box.ply",
            "file 3: box.ply",
        )
        viewer.select_target("file 2: box.ply")
        np.testing.assert_allclose(viewer._target.pose, rigid_matrix((0, 0, 1)))
        pose = rigid_matrix((0.5, 0, 2), (0, 0, 1, 0))
        for released in (False, True):
            viewer._move(pose, released)
            assert viewer.session.settle()
            moved = viewer.session.state.scene.clouds
            np.testing.assert_allclose(moved[1].world_means(), [(0.5, 0, 2), (-1.5, 0, 2)], atol=1e-6)
            assert ("0.5" in path.read_text()) == released
        assert "scale = 2.0 # twice" in path.read_text()
        again = fs.Scene.load(path)
        for one, other in zip(again.clouds, moved, strict=True):
            np.testing.assert_allclose(one.world_means(), other.world_means(), atol=1e-6)
        viewer.select_target("file 1: box.ply")  # which has no pose in the file
        viewer._move(rigid_matrix((0, 3, 0)), True)
        assert viewer.session.settle()
        np.testing.assert_allclose(fs.Scene.load(path).clouds[0].world_means()[0], (0, 3, 0))
        viewer.select_target("file 3: box.ply")
        assert viewer._target is None
        assert "is moved by keyframes" in viewer._controls.status.content
        # what cannot be written stays where the file says that it is
        viewer.select_target("file 2: box.ply")
        before = path.read_text()
        path.write_text(before + "# edited\n")
        viewer._move(rigid_matrix((9, 9, 9)), True)
        assert viewer.session.settle()
        assert "nothing was written" in viewer._controls.status.content
        np.testing.assert_allclose(
            viewer.session.state.scene.clouds[1].world_means()[0], (0.5, 0, 2), atol=1e-6
        )
        assert path.read_text() == before + "# edited\n"
        viewer.select_target("file 9: none")
        viewer._move(np.eye(4), True)
    finally:
        viewer.close()


def test_large_splat_files_move_once_they_are_let_go(monkeypatch):
    from fidsplat.viewer import nodes

    cloud = fs.SplatCloud([[0, 0, 0]], [[1, 0, 0, 0]], [[0.1, 0.1]], [1], colors=[[1, 0, 0]])
    target = nodes.find_target(fs.Scene([cloud]), [SplatFile(0, "a.ply", np.eye(4))], "file 1: a.ply")
    assert target.live
    monkeypatch.setattr(nodes, "LIVE_LIMIT", 0)
    assert not target.live


def test_a_file_that_is_edited_is_shown(viewer, tmp_path):
    text = (tmp_path / "scene.toml").read_text()
    edit(tmp_path / "scene.toml", text.replace("0.4\n", "0.2\n", 1))
    assert until(lambda: viewer.session.state.scene.markers[0].marker.size == 0.2)
    edit(tmp_path / "scene.toml", text.replace("size", "sise"))
    assert until(lambda: "the previous scene is shown" in viewer._controls.status.content)
    assert "did you mean 'size'" in viewer._controls.status.content
    assert viewer.session.state.scene.markers[0].marker.size == 0.2


def test_what_an_edit_changes_is_taken_and_the_controls_follow(viewer, tmp_path):
    """Settings that the edit omits keep the values of the controls."""
    path, sliders = tmp_path / "scene.toml", viewer._controls._sliders
    sliders["exposure"].value = 2.0
    assert viewer.session.settle()
    edited = (
        path.read_text()
        + "[fog]\ndensity = 3\n[camera]\nwidth = 48\nheight = 36\nfov_x_deg = 60\n"
        + "position = [0, 0, -1]\nlook_at = [0, 0, 0]\n[camera.distortion]\nk1 = -0.1\n"
    )
    edit(path, edited)
    assert until(lambda: viewer._controls._lens.value == "scene")
    assert until(lambda: not viewer._controls._session._working)
    settings = viewer.session.state.settings
    assert (settings.fog, settings.lens, settings.exposure) == (3.0, "scene", 2.0)
    assert (sliders["fog"].value, sliders["exposure"].value) == (3.0, 2.0)
    assert sliders["fog"].max >= 3.0
    edit(path, edited.partition("[camera.distortion]")[0])
    assert until(lambda: "scene" not in viewer._controls._lens.options)
    assert viewer.session.settle()
    settings = viewer.session.state.settings
    assert (settings.fog, settings.lens, settings.exposure) == (3.0, "pinhole", 2.0)


def test_a_scene_that_begins_to_move_gets_a_clock(viewer, tmp_path):
    path, sliders = tmp_path / "scene.toml", viewer._controls._sliders
    still, shown = path.read_text(), viewer.server.gui._gui_input_handle_from_uuid
    before, place = len(shown), "position = [0, 0, 0], quaternion = [1, 0, 0, 0]"

    def moving(end):
        keys = f"{{time = 0.5, {place}}}, {{time = {end}, {place.replace('[0, 0, 0]', '[0.3, 0, 0]')}}}"
        return still.replace("size = 0.4\n", f"size = 0.4\nmotion = [{keys}]\n")

    def write(text):
        """At once: a viewer that looks while a file is written sees an empty scene, without a clock."""
        (tmp_path / "next.toml").write_text(text)
        (tmp_path / "next.toml").replace(path)

    assert "time" not in sliders
    write(moving(2.5))
    assert until(lambda: "readout_ms" in sliders and len(shown) == before + 3)
    assert (sliders["time"].min, sliders["time"].max) == (0.0, 2.5), "of keyframes, and where the clock is"
    sliders["time"].value = 2.5
    assert until(lambda: viewer.session.state.settings.time == 2.5)
    write(moving(4.0))
    assert until(lambda: sliders["time"].max == 4.0)
    assert (sliders["time"].min, sliders["time"].value, len(shown)) == (0.5, 2.5, before + 3)
    write(still)
    assert until(lambda: not sliders.keys() & {"time", "exposure_ms", "readout_ms"})
    assert until(lambda: len(shown) == before)
    write(moving(2.5))
    assert until(lambda: "time" in sliders)


def test_a_marker_is_not_written_into_a_file_that_cannot_be_shown(viewer, tmp_path):
    """Its tables may be those of other markers."""
    file, table = tmp_path / "scene.toml", '[[markers]]\nspec = "aruco:4x4_50:8"\nsize = 0.4\n'
    edited = table.replace("0.4", "-1") + file.read_text()
    viewer.select_target("1: aruco:4x4_50:7")
    edit(file, edited)
    assert until(lambda: "the previous scene is shown" in viewer._controls.status.content)
    viewer._move(rigid_matrix((0.1, 0.0, 0.2)), True)
    assert viewer.session.settle()
    assert file.read_text() == edited
    assert "nothing was written" in viewer._controls.status.content
    edit(file, edited.replace("-1", "0.4"))
    assert until(lambda: len(viewer._controls._targets.options) == 3)
    assert viewer._controls._targets.options[2] == "2: aruco:4x4_50:7"
    viewer._move(np.eye(4), True)  # no target is selected
    assert "position" not in file.read_text()
    viewer.select_target("2: aruco:4x4_50:7")
    viewer._move(rigid_matrix((0.1, 0.0, 0.2)), True)
    assert viewer.session.settle()
    np.testing.assert_allclose(fs.Scene.load(file).markers[1].pose[:3, 3], (0.1, 0, 0.2))
    viewer.select_target("9: nobody")
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


def test_a_trajectory_is_shown_as_keyframes(tmp_path):
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
            pytest.raises(InvalidStatus, match="403") as error,
        ):
            connect(f"ws://{host}:{port}", sock=line, **words)
        assert b"this" in error.value.response.body
    assert not viewer._streams
    connect(f"ws://127.0.0.1:{port}", origin=f"http://127.0.0.1:{port}").close()
