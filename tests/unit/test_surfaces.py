"""Surfaces of scenes with closed forms, and markers that are placed on them."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from analytic_surfaces import leaves, plane, sphere
from command_line import fails, prints_json

import fidsplat as fs
from fidsplat.cameras.lenses import BrownConrady, Fisheye, Orthographic
from fidsplat.cli import main
from fidsplat.render.surface import surface_from_depth
from fidsplat.scenes.surface import fit_surface
from fidsplat.vision import read_back

AT = np.array([5.0, -3.0, 7.0])
NORMAL = np.array([0.5, 0.2, -1.0]) / math.sqrt(1.29)
POSE = fs.Camera.look_at(8, 8, 1.0, AT + np.array((0.3, -0.2, -2.0)), AT).world_to_camera


def camera(lens=None, **changes) -> fs.Camera:
    """Off the origin, of unequal focal lengths, its principal point off the middle."""
    arguments = {"fx": 150.0, "fy": 110.0, "cx": 70.0, "cy": 63.0} | changes
    return fs.Camera.pinhole(160, 120, **arguments, world_to_camera=POSE, lens=lens)


@pytest.fixture(scope="module")
def renderer():
    return fs.Renderer("opencl")


@pytest.fixture(scope="module")
def wall():
    return fs.Scene([plane(AT, NORMAL), leaves(AT + 0.3 * NORMAL, 0.2, 60)], camera=camera())


def angle(a, b) -> float:
    return math.degrees(math.acos(min(1.0, float(np.dot(a, b)))))


LENSES = {
    "pinhole": {},
    "distorted": {"lens": BrownConrady(k1=-0.1, p1=0.01)},
    "fisheye": {"lens": Fisheye(k1=0.02), "fx": 60.0, "fy": 50.0},
    "orthographic": {"lens": Orthographic(), "fx": 60.0, "fy": 50.0},
}


@pytest.mark.parametrize("lens", LENSES)
def test_unproject_inverts_project(lens):
    view, rng = camera(**LENSES[lens]), np.random.default_rng(0)
    pixels, depths = rng.uniform((0, 0), (160, 120), (50, 2)), rng.uniform(0.5, 4.0, 50)
    points = view.unproject(pixels, depths)
    np.testing.assert_allclose(view.project(points), pixels, atol=1e-8)
    local = (points - view.position) @ view.world_to_camera[:3, :3].T
    actual = np.linalg.norm(local, axis=1) if lens == "fisheye" else local[:, 2]
    np.testing.assert_allclose(actual, depths, rtol=1e-12)


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
@pytest.mark.parametrize("radius", [None, 0.15])
def test_a_wall_behind_leaves(wall, renderer, lens, radius):
    """Two kinds of pixels: a leaf at the pixel itself, and none."""
    view = camera(**LENSES[lens])
    center = view.project(AT[None])[0]
    for pixel in (center, center + np.array((18.0, -13.0))):
        surface = wall.surface_at(view, pixel, radius=radius, renderer=renderer)
        assert abs((surface.position - AT) @ NORMAL) < 1e-5
        assert angle(surface.normal, NORMAL) < 0.02
        np.testing.assert_allclose(view.project(surface.position[None])[0], pixel, atol=1e-6)
        assert 0.5 <= surface.inlier_fraction <= 1
        assert surface.roughness < 1e-5
        if radius is not None:
            assert surface.radius == pytest.approx(radius, rel=0.15)


def test_shares_count_the_leaves(wall, renderer):
    """The share of inliers is that of the pixels whose depth is the closed form of the plane."""
    view = camera()
    pixel = tuple(view.project(AT[None])[0])
    depth = renderer.render(wall, outputs=("depth_first",), quality="first_hit=0.5")["depth_first"]
    surface = surface_from_depth(depth, view, pixel, 20.0)
    y, x = np.mgrid[:120, :160] + 0.5
    rays = np.stack([(x - 70.0) / 150.0, (y - 63.0) / 110.0, np.ones_like(x)], 2) @ POSE[:3, :3]
    plane_depth = ((AT - view.position) @ NORMAL) / (rays @ NORMAL)
    of_wall = np.abs(depth - plane_depth) < 0.01
    inside = (x - pixel[0]) ** 2 + (y - pixel[1]) ** 2 <= 20.0**2
    assert 0.55 < of_wall[inside].mean() < 0.95
    assert surface.inlier_fraction == pytest.approx(of_wall[inside].mean(), abs=0.01)
    assert angle(surface.normal, NORMAL) < 0.02


def test_a_sphere(renderer):
    """The plane of a patch of radius a is within a^2 / R of the sphere, and parallel to it at the middle."""
    scene, view = fs.Scene([sphere(AT, 0.5, 4000)], camera=camera()), camera()
    for x, y in ((70.0, 60.0), (55.0, 50.0), (85.0, 66.0)):
        surface = scene.surface_at(view, (x, y), radius=0.05, renderer=renderer)
        outwards = surface.position - AT
        assert np.linalg.norm(outwards) == pytest.approx(0.5, abs=0.005)
        assert angle(surface.normal, outwards / np.linalg.norm(outwards)) < 1.5


def test_a_ray_and_a_pixel_agree(wall, renderer):
    view = camera()
    by_pixel = wall.surface_at(view, (100.0, 40.0), renderer=renderer)
    ray = (view.position, by_pixel.position - view.position)
    by_ray = fs.surface_at(wall, ray=ray, renderer=renderer)
    np.testing.assert_allclose(by_ray.position, by_pixel.position, atol=1e-5)
    assert angle(by_ray.normal, by_pixel.normal) < 0.02


def test_the_scenes_camera_is_at_the_time_of_the_shutter(renderer):
    later = np.linalg.inv(POSE)
    later[:3, 3] += (0.4, 0.0, -0.5)
    motion = fs.Trajectory([0.0, 1.0], [POSE, np.linalg.inv(later)])
    moving = fs.Scene(
        [plane(AT, NORMAL)], camera=camera(), camera_motion=motion, shutter=fs.Shutter(time=1.0)
    )
    surface = moving.surface_at(pixel=(60.0, 60.0), renderer=renderer)
    there = camera().with_pose(np.linalg.inv(later))
    np.testing.assert_allclose(there.project(surface.position[None])[0], (60.0, 60.0), atol=1e-6)
    assert abs((surface.position - AT) @ NORMAL) < 1e-5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"pixel": (159.0, 1.0)}, "must have an opacity of .*got"),
        ({"pixel": (161.0, 1.0)}, r"pixel must be \(x, y\) in the image, 0 to 160"),
        (
            {"pixel": (80.0, 60.0), "ray": (AT, NORMAL)},
            "exactly one of pixel and ray must be given, got both",
        ),
        ({}, "exactly one of pixel and ray must be given, got neither"),
        ({"pixel": (80.0, 60.0), "radius": -1.0}, "radius must be a positive length"),
        ({"pixel": (80.0, 60.0), "radius": "1"}, "radius must be a positive length"),
        ({"ray": (AT, (0.0, 0.0, 0.0))}, r"a finite non-zero direction \(3,\)"),
        ({"ray": (AT, (0.0, math.nan, 0.0))}, "ray must be a finite origin"),
        ({"ray": 3}, "ray must be an origin"),
        ({"camera": (AT, NORMAL)}, r"camera must be a Camera, .* give a ray as ray=\(origin, direction\)"),
    ],
)
def test_what_has_no_surface_is_refused(renderer, arguments, words):
    scene = fs.Scene([plane(AT, NORMAL, 0.3)], camera=camera())
    with pytest.raises(fs.InputError, match=words):
        scene.surface_at(renderer=renderer, **arguments)


def test_haze_is_no_surface(renderer):
    haze = plane(AT, NORMAL)
    thin = fs.SplatCloud(haze.means, haze.quats, haze.scales, np.full(len(haze), 0.05), colors=haze.colors)
    with pytest.raises(fs.InputError, match=r"must have an opacity of at least 0\.5"):
        fs.Scene([thin], camera=camera()).surface_at(pixel=(70.0, 60.0), renderer=renderer)


def test_a_bush_is_no_surface(renderer):
    bush = fs.Scene([leaves(AT, 0.3, 800)], camera=camera())
    pixel = tuple(camera().project(AT[None])[0])
    with pytest.raises(fs.InputError, match=r"one plane in at least 50 % of the patch, got \d+ %"):
        bush.surface_at(pixel=pixel, radius=0.3, renderer=renderer)


def test_a_grazing_ray_is_refused_with_its_angle():
    points = np.random.default_rng(0).uniform((-1, -1, 0), (1, 1, 0), (200, 3))
    for degrees, refused in ((0.6, True), (1.5, False)):
        ray = np.array([math.cos(math.radians(degrees)), 0, -math.sin(math.radians(degrees))])
        if refused:
            with pytest.raises(fs.InputError, match=r"at an angle of at least 1\.1 degrees, got 0\.6; give"):
                fit_surface(points, -10 * ray, ray, 1.0)
        else:
            np.testing.assert_allclose(fit_surface(points, -10 * ray, ray, 1.0).position, 0, atol=1e-9)


def test_a_marker_on_a_wall_is_upright_and_readable(wall, renderer):
    tag = fs.marker("apriltag:36h11:5", size=0.35)
    pixel = tuple(camera().project((AT + np.array((0.35, 0.2, 0.2)))[None])[0])
    scene = wall.place(tag, pixel=pixel, lift=0.01, bundle="wall", renderer=renderer)
    (placed,) = scene.markers
    assert placed.bundle == "wall"
    assert angle(-placed.pose[:3, 2], NORMAL) < 0.02
    assert (placed.pose[:3, 3] - AT) @ NORMAL == pytest.approx(0.01, abs=1e-5)
    assert placed.pose[1, 0] == pytest.approx(0.0, abs=1e-9)  # its edge is level, y being vertical
    assert placed.pose[1, 1] > 0.9
    assert np.linalg.det(placed.pose[:3, :3]) == pytest.approx(1.0)
    frame = renderer.render(scene, camera().with_size(640, 480))
    (reading,) = read_back(frame, scene).readings
    assert reading.detection is not None
    assert reading.position_error < 0.02
    turned = wall.place(tag, pixel=pixel, up=(1.0, 0.0, 0.0), renderer=renderer).markers[0].pose
    assert turned[0, 1] < -0.8
    with pytest.warns(UserWarning, match="apriltag:36h11:5 is already in the scene.*do not determine a pose"):
        assert len(scene.place(tag, pixel=(40.0, 60.0), renderer=renderer).markers) == 2


@pytest.mark.parametrize("how", ["pixel", "ray"])
def test_a_marker_on_a_floor_has_its_top_away_from_the_camera(renderer, how):
    """y is vertical and down; the camera looks along z, and down."""
    floor = fs.Scene([plane(np.array([0.0, 1.0, 3.0]), (0.0, -1.0, 0.0), 2.0)])
    view = fs.Camera.look_at(160, 120, 1.0, (0.0, -0.5, 0.0), (0.0, 1.0, 3.0))
    arguments = (
        {"camera": view, "pixel": (80, 60)} if how == "pixel" else {"ray": ((0, -0.5, 0), (0, 1.5, 3))}
    )
    tag = fs.marker("apriltag:36h11:5", size=0.3)
    pose = floor.place(tag, up=(0.0, -1.0, 0.0), renderer=renderer, **arguments).markers[0].pose
    expected = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    np.testing.assert_allclose(pose[:3, :3], expected, atol=1e-4)
    np.testing.assert_allclose(pose[:3, 3], (0.0, 0.999, 3.0), atol=1e-3)


@pytest.mark.parametrize("arguments", [{"up": (0, 0, 0)}, {"up": (1, 2)}, {"lift": math.nan}])
def test_a_pose_of_invalid_numbers_is_refused(wall, renderer, arguments):
    tag = fs.marker("apriltag:36h11:5", size=0.1)
    with pytest.raises(fs.InputError, match=rf"{next(iter(arguments))} must be"):
        wall.place(tag, pixel=(70.0, 60.0), renderer=renderer, **arguments)


def test_the_command_places_a_marker(wall, tmp_path, capsys):
    file = tmp_path / "scene.toml"
    wall.save(file)
    text = f"# mine\n{file.read_text()}"
    file.write_text(text)
    words = ["marker", "apriltag:36h11:5", "--size", "0.2", "--scene", str(file), "--at-pixel", "100", "45"]
    words += ["--light", "lights,response=2.2,ambient=0.4 0.4 0.5"]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert file.read_text() == text
    facts = prints_json(capsys, *words, "--append")["placed"]
    assert file.read_text().startswith(text.rstrip())
    assert printed.partition("[[markers]]")[2].strip() == file.read_text().partition("[[markers]]")[2].strip()
    (placed,) = fs.Scene.load(file).markers
    assert placed.light == fs.Lighting("lights", response=2.2, ambient=(0.4, 0.4, 0.5))
    np.testing.assert_allclose(placed.pose[:3, 3], facts["position"])
    assert angle(facts["normal"], NORMAL) < 0.02
    assert angle(-placed.pose[:3, 2], NORMAL) < 0.02
    file.write_text(f'markers = [{{spec = "aruco:4x4_50:1", size = 0.1}}]\n{text}')
    assert "must be [[markers]] tables" in fails(capsys, *words, "--append")[1]
    for light, expected in (("ambient=red", "must be numbers separated by spaces"), ("scen", "'scene'?")):
        assert expected in fails(capsys, *words, "--light", light)[1]


@pytest.mark.parametrize(
    "words",
    [
        ["--at-pixel", "3", "4"],
        ["--lift", "0.1"],
        ["--light", "scene"],
        ["--append"],
        ["--scene", "a.ply", "--at-pixel", "3", "4", "--append"],
    ],
)
def test_options_of_a_place_need_each_other(words, capsys):
    status, output = fails(capsys, "marker", "apriltag:36h11:5", *words)
    assert status == 2
    assert "--scene" in output or "--append must" in output


def test_a_click_places_a_marker(tmp_path):
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from viewing import Client, until

    from fidsplat.viewer.server import Viewer

    fs.Scene([plane((0.0, 0.0, 1.0), (0.3, 0.0, -1.0), 0.4, 0.1)]).save(tmp_path / "scene.toml")
    viewer = Viewer(fs.Scene.load(tmp_path / "scene.toml"), tmp_path / "scene.toml", "opencl", port=0)
    try:
        client = Client()
        viewer._enter(client)
        assert until(lambda: 1 in viewer._views)
        viewer._controls._places.value = True
        viewer._controls._spec.value = "apriltag:36h11:9"
        viewer._click(SimpleNamespace(client_id=1, screen_pos=(0.01, 0.5)))
        assert "must have an opacity" in client.said.content
        assert not fs.Scene.load(tmp_path / "scene.toml").markers
        viewer._click(SimpleNamespace(client_id=1, screen_pos=(0.6, 0.4)))
        assert "Appended to scene.toml" in client.said.content
        assert viewer.session.settle()
        (placed,) = fs.Scene.load(tmp_path / "scene.toml").markers
        assert placed.marker.spec == "apriltag:36h11:9"
        assert placed.marker.size == 0.16
        np.testing.assert_allclose(placed.pose, viewer.session.state.scene.markers[0].pose, atol=1e-8)
        seen_by = viewer._views[1].viewpoint.camera(viewer.session.state.scene)
        pixel = seen_by.project(placed.pose[None, :3, 3])[0]
        np.testing.assert_allclose(pixel, (28.8, 14.4), atol=0.1)
        viewer._click(SimpleNamespace(client_id=1, screen_pos=(0.5, 0.5)))  # reads the pixel again
        assert "depth 2." in client.said.content
    finally:
        viewer.close()
