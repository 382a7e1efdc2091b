"""The viewer by the images that a browser gets: after moves of the camera, of sliders and of gizmos; clicks
on them, and the overlays that must match them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from viewing import Client, until

import fidsplat as fs
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.rotations import matrix_to_quaternion, rigid_matrix
from fidsplat.viewer.session import Session
from fidsplat.viewer.settings import Viewpoint

SCENE = """[[markers]]
spec = "aruco:4x4_50:7"
size = 0.4
position = [0.3, -0.2, 0.5]
quaternion = [0.95, 0.1, -0.2, 0.05]
[[markers]]
spec = "aruco:4x4_50:3"
size = 0.3
position = [-0.4, 0.25, 0.3]
[camera]
width = 48
height = 36
fx = 40.0
fy = 55.0
position = [0.1, -0.2, -1.4]
look_at = [0.0, 0.0, 0.2]
[render]
background = [0.2, 0.3, 0.4]
"""
ASIDE = rigid_matrix((0.35, -0.3, -1.3), (0.99, -0.08, -0.09, 0.12))
"""camera to world, off the origin, turned about all axes"""


@pytest.fixture
def viewer(tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from fidsplat.viewer import server

    monkeypatch.setattr(server, "POLL_INTERVAL", 0.1)
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    running_viewer = server.Viewer(fs.Scene.load(path), path, "reference", port=0)
    yield running_viewer
    running_viewer.close()


def put(client, pose, width=64, height=40, fov=0.9):
    """Move a browser's camera."""
    camera = client.camera
    camera.position, camera.wxyz = tuple(pose[:3, 3]), tuple(matrix_to_quaternion(pose[:3, :3]))
    camera.fov, camera.image_width, camera.image_height = fov, width, height
    client.turned(camera)


def camera_of(pose, width=64, height=40, fov=0.9):
    focal = height / 2 / np.tan(fov / 2)
    return fs.Camera.pinhole(width, height, focal, focal, width / 2, height / 2, np.linalg.inv(pose), 0.01)


def rendered(scene, camera, **parts):
    capture = replace(scene.capture, camera=camera, outputs=("rgb",), **parts)
    return fs.Renderer("reference").render(scene, capture).to_uint8()


def shows(client, image):
    """Whether the newest exact image is this one, but for roundings."""

    def same():
        exact = [shown for shown, kind in list(client.sent) if kind == "png"]
        if not exact or exact[-1].shape != image.shape:
            return False
        off = np.abs(exact[-1].astype(int) - image.astype(int)).max(axis=2)
        return (off > 1).mean() < 0.005

    return until(same)


@pytest.fixture
def client(viewer):
    page_client = Client()
    viewer._enter(page_client)
    put(page_client, ASIDE)
    return page_client


def test_a_moved_camera_shows_the_scene_from_there(viewer, client):
    scene = viewer.session.state.scene
    assert shows(client, rendered(scene, camera_of(ASIDE)))
    other = rigid_matrix((-0.5, 0.4, -0.9), (0.9, -0.2, 0.3, 0.1))
    put(client, other, 50, 62, 1.2)
    expected = rendered(scene, camera_of(other, 50, 62, 1.2))
    assert expected.std() > 5
    assert shows(client, expected)


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (0.8, 0.3, -0.5)])
def test_a_browser_starts_with_the_image_of_the_scenes_camera(viewer, up, monkeypatch):
    """The page looks from `position` at `look_at`, `up` is up in its window, and `fov` is its height."""
    camera = fs.Camera.look_at(48, 36, 0.9, (0.3, -0.2, -1.1), (0.1, 0.05, 0.0), up)
    axes = []
    monkeypatch.setattr(viewer.server.scene, "set_up_direction", axes.append)
    viewer._start_camera(fs.Scene(camera=camera))
    start = viewer.server.initial_camera
    # drags of the mouse rotate about it: the vertical, or with a roll the camera's own up direction
    np.testing.assert_allclose(axes, [up if np.count_nonzero(up) == 1 else -camera.world_to_camera[1, :3]])
    across = 2 * np.arctan(np.tan(start.fov / 2) * 48 / 36)
    seen = fs.Camera.look_at(48, 36, across, start.position, start.look_at, start.up)
    np.testing.assert_allclose(seen.world_to_camera, camera.world_to_camera, atol=1e-9)
    np.testing.assert_allclose([seen.fx, seen.fy], [camera.fx, camera.fy], rtol=1e-9)


@pytest.mark.parametrize(
    ("slider", "value", "parts"),
    [
        ("fog", 0.7, {"fog": fs.Fog(0.7, (0.5, 0.5, 0.5))}),
        ("exposure", 2.0, {"sensor": fs.Sensor(exposure=2.0)}),
        ("noise", 0.1, {"sensor": fs.Sensor(full_well=100.0)}),
    ],
)
def test_sliders_change_the_image(viewer, client, slider, value, parts):
    from fidsplat.viewer.settings import _FOG_COLOR

    if "fog" in parts:
        parts = {"fog": fs.Fog(value, _FOG_COLOR)}
    scene = viewer.session.state.scene
    before = rendered(scene, camera_of(ASIDE))
    assert shows(client, before)
    viewer._controls._sliders[slider].value = value
    expected = rendered(scene, camera_of(ASIDE), **parts)
    assert (np.abs(expected.astype(int) - before) > 5).mean() > 0.3
    assert shows(client, expected)
    viewer._controls._sliders[slider].value = float(getattr(type(viewer.session.state.settings)(), slider))
    assert shows(client, before)


@pytest.mark.parametrize("lens", ["fisheye", "panorama", "parallel"])
def test_lenses_change_the_image(viewer, client, lens):
    scene = viewer.session.state.scene
    assert shows(client, rendered(scene, camera_of(ASIDE)))
    viewer._controls._lens.value = lens
    place = np.linalg.inv(ASIDE)
    if lens == "fisheye":
        camera = fs.Camera.fisheye(64, 40, np.pi, place, near=0.01)
    elif lens == "panorama":
        camera = fs.Camera.equirectangular(64, 40, place, 0.01)
    else:
        distance = np.linalg.norm(ASIDE[:3, 3] - client.camera.look_at)
        camera = fs.Camera.orthographic(64, 40, distance * 2 * np.tan(0.45) * 64 / 40, place, 0.01)
    assert shows(client, rendered(scene, camera))


def test_gizmos_move_what_the_image_shows(viewer, client):
    scene = viewer.session.state.scene
    before = rendered(scene, camera_of(ASIDE))
    assert shows(client, before)
    viewer.select_target("2: aruco:4x4_50:3")
    pose = rigid_matrix((-0.1, 0.2, 0.6), (0.9, 0.2, 0.1, -0.1))
    viewer._move(pose, False)
    one, other = scene.markers
    moved = replace(scene, markers=(one, replace(other, pose=pose)))
    expected = rendered(moved, camera_of(ASIDE))
    assert (expected != before).any(axis=2).mean() > 0.05
    assert shows(client, expected)


def test_clicks_name_what_is_at_their_pixel(viewer, client):
    """Two markers aside from the middle, to the left and to the right, above and below."""
    scene = viewer.session.state.scene
    assert shows(client, rendered(scene, camera_of(ASIDE)))
    assert until(lambda: 1 in viewer._views and viewer._views[1].frame["rgb"].shape == (40, 64, 3))
    camera = camera_of(ASIDE)
    for placed in scene.markers:
        (x, y), *_ = camera.project(placed.pose[None, :3, 3])
        assert abs(x - 32) > 3
        assert abs(y - 20) > 2
        viewer._click(SimpleNamespace(client_id=1, screen_pos=(x / 64, y / 40)))
        message = client.said.content
        assert f"marker {placed.marker.spec}" in message
        assert f"label {placed.label}" in message
        assert f"pixel ({int(x)}, {int(y)})" in message
        depth = float(message.partition("depth ")[2].split()[0])
        assert depth == pytest.approx((np.linalg.inv(ASIDE) @ placed.pose)[2, 3], abs=0.03)
    for corner in ((0.0, 0.0), (0.999, 0.999)):
        viewer._click(SimpleNamespace(client_id=1, screen_pos=corner))
        assert "depth nothing" in client.said.content
        assert "marker -" in client.said.content
        assert f"pixel ({int(corner[0] * 64)}, {int(corner[1] * 40)})" in client.said.content


class Page:
    """Records what is added to a page of viser."""

    def __init__(self):
        self.added = {}

    def __getattr__(self, kind):
        def add(name, *values, **given):
            node = SimpleNamespace(
                **given, remove=lambda: self.added.pop(name, None), kind=kind, values=values
            )
            node.on_update = lambda callback: setattr(node, "update", callback)
            self.added[name] = node
            return node

        return add


def corners_of(node):
    """World positions of the far corners of a frustum at distance 1 along its axis, as viser renders it."""
    tall = np.tan(node.fov / 2)
    wide = tall * node.aspect
    ends = np.array([[x * wide, y * tall, 1.0] for x in (-1, 1) for y in (-1, 1)])
    return ends @ rigid_matrix((0, 0, 0), node.wxyz)[:3, :3].T + node.position


@pytest.mark.parametrize("kind", ["scene", "keyframes"])
def test_corners_of_a_frustum_are_those_of_the_image(kind):
    """With pixels that are not square, at a camera off the origin."""
    from fidsplat.viewer.nodes import Nodes

    page = Page()
    camera = fs.Camera.pinhole(48, 36, 40.0, 55.0, 24.0, 18.0, np.linalg.inv(ASIDE))
    if kind == "scene":
        Nodes(page).show(fs.Scene([], camera), True)
        node = page.added["/scene camera"]
    else:
        Nodes(page).show_keyframes(camera, [np.eye(4), ASIDE])
        node = page.added["/keyframes/1"]
    projected = camera.project(corners_of(node))
    np.testing.assert_allclose(projected, [[0, 0], [0, 36], [48, 0], [48, 36]], atol=1e-9)


def test_outlines_are_where_the_image_has_the_markers(tmp_path):
    from fidsplat.viewer.nodes import Nodes

    (tmp_path / "scene.toml").write_text(SCENE)
    scene, page = fs.Scene.load(tmp_path / "scene.toml"), Page()
    Nodes(page).show(scene, True)
    for placed in scene.markers:
        node = page.added[f"/markers/{placed.label}"]
        rotation = rigid_matrix(node.position, node.wxyz)
        edges = node.values[0] @ rotation[:3, :3].T + rotation[:3, 3]
        np.testing.assert_allclose(edges[:, 0], placed.corners, atol=1e-12)
        np.testing.assert_allclose(edges[:, 1], np.roll(placed.corners, -1, axis=0), atol=1e-12)


def test_splats_occlude_outlines():
    """Edges on their own marker are in front of the depth that a browser receives, edges behind another are
    not."""
    back = fs.marker("aruco:4x4_50:7", size=0.4)
    front = PlacedMarker(fs.marker("aruco:4x4_50:3", size=0.3), ((-0.12, -0.12, -0.2), (1, 0, 0, 0)))
    session = Session(fs.Scene(markers=[PlacedMarker(back), front]), "reference")
    view = Viewpoint((0.0, 0.0, -1.0), (1.0, 0.0, 0.0, 0.0), 0.8, 64, 48)
    image = session.render(view)
    session.close()
    depth, camera = image.occluding_depth(), view.camera(image.state.scene)
    assert depth.shape == (48, 64)
    assert np.isinf(depth[0, 0])  # nothing occludes there
    for placed, occluded in zip(image.state.scene.markers, ((0,), ()), strict=True):
        x, y = camera.project(placed.corners).astype(int).T
        behind = placed.corners[:, 2] + 1.0 > depth[y, x]
        assert np.flatnonzero(behind).tolist() == list(occluded)


def test_the_depth_comes_with_the_exact_image_where_there_are_outlines(viewer, client):
    assert until(lambda: any(kind == "png" for _, kind in list(client.sent)))
    exact = [
        depth for depth, (_, kind) in zip(client.depths, list(client.sent), strict=False) if kind == "png"
    ]
    assert exact[-1].shape == (40, 64)
    viewer.overlay(False)
    assert until(lambda: client.depths[-1] is None and client.sent[-1][1] == "png")
    viewer.overlay(True)
    assert until(lambda: client.depths[-1] is not None)
    put(client, rigid_matrix((0, 0, -500)))  # too far for the encoding of depths
    assert until(lambda: client.sent[-1][1] == "png" and client.depths[-1] is None)


@pytest.mark.parametrize(
    ("position", "wxyz"),
    [
        ((np.nan, 0, 0), (1, 0, 0, 0)),
        ((0, 0, np.inf), (1, 0, 0, 0)),
        ((0, 0, 0), (np.nan, 0, 0, 1)),
        ((0, 0, 0), (1, 0, 0, -np.inf)),
        ((0, 0, 0), (0, 0, 0, 0)),
    ],
)
def test_gizmos_ignore_poses_that_are_none(position, wxyz):
    """Messages of a browser may have any numbers: one that is not finite is enough."""
    from fidsplat.viewer.nodes import Nodes

    page, moves = Page(), []
    Nodes(page).show_gizmo(ASIDE, 0.2, lambda pose, released: moves.append((pose, released)))
    gizmo = page.added["/gizmo"]
    for phase in ("update", "end"):
        gizmo.position, gizmo.wxyz = position, wxyz
        gizmo.update(SimpleNamespace(phase=phase))
        assert moves == []
    gizmo.position, gizmo.wxyz = (1.0, 2.0, 3.0), (0.0, 2.0, 0.0, 0.0)  # not of length 1
    for phase in ("update", "end"):
        gizmo.update(SimpleNamespace(phase=phase))
    assert [released for _, released in moves] == [False, True]
    np.testing.assert_allclose(moves[0][0], rigid_matrix((1, 2, 3), (0, 1, 0, 0)), atol=1e-12)
