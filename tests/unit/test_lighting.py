"""Light of markers: closed forms of irradiance, shadows and reflections, scene files, and errors."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.render.irradiance import LightField, cosine_weights, panorama_directions
from fidsplat.render.reflection import (
    GlossyBrdf,
    fit_harmonics,
    fresnel,
    view_directions,
)
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.harmonics import sh_basis
from fidsplat.util.response import linear_light, to_colors

TAG = fs.marker("aruco:4x4_50:7", size=0.16)
UP = np.array([0.0, 0.0, 1.0])
SUN = fs.Sun(direction=(0, 0, 1), intensity=math.pi, angle=0)


@cache
def renderer():
    return fs.Renderer("opencl")


def lit(scene):
    """Linear light (n, 3) and splats of the first marker of a lit scene."""
    cloud = renderer().lit(scene).markers[0].marker.cloud
    return linear_light(cloud.colors, "srgb"), cloud


def of_lights(*lights, clouds=(), pose=None, **light):
    pose = np.eye(4) if pose is None else pose
    placed = PlacedMarker(TAG, pose, light=fs.Lighting("lights", **light))
    return fs.Scene(clouds, markers=[placed], lights=lights)


def screen(x, y, z, half_x, half_y):
    """Opaque rectangle across the z axis."""
    return fs.SplatCloud(
        [[x, y, z]], [[1, 0, 0, 0]], [[half_x, half_y]], [1.0], colors=[[0.2, 0, 0]]
    ).with_boxes()


def test_a_uniform_panorama_returns_the_reflectance():
    radiance = linear_light(np.array([0.5, 0.6, 0.7]), "srgb")
    placed = PlacedMarker(TAG, light="scene")
    light, cloud = lit(fs.Scene(markers=[placed], background=(0.5, 0.6, 0.7)))
    dark = TAG.is_dark
    assert len(cloud) == len(TAG.cloud)  # nothing to split
    assert np.allclose(light[dark], 0.05 * radiance, rtol=1e-5)
    assert np.allclose(light[~dark], 0.85 * radiance, rtol=1e-5)


@pytest.mark.parametrize("degrees", [0, 30, 75])
def test_half_of_a_panorama_returns_the_cosine_integral(degrees):
    """The edge of the bright half is tilted by an angle from the surface: E = pi L (1 + cos) / 2."""
    directions, angles = panorama_directions(64)
    assert angles.sum() == pytest.approx(4 * math.pi)
    angle = math.radians(degrees)
    bright = directions @ [math.sin(angle), 0, math.cos(angle)] > 0
    weight_sum = cosine_weights(UP, directions, angles)[bright].sum()
    assert weight_sum == pytest.approx(math.pi * (1 + math.cos(angle)) / 2, rel=0.02)


def test_light_is_measured_where_the_marker_is():
    """Under half of a sky, a marker whose normal is turned away from it receives the complementary share."""
    sky = fs.Gradient(top=(1.0, 1.0, 1.0), bottom=(0.0, 0.0, 0.0))
    pose = np.eye(4)
    lying = pose.copy()
    lying[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # its -z, towards the viewer, is up: -y
    light = [lit(fs.Scene(markers=[PlacedMarker(TAG, p, light="scene")], background=sky))[0].max(0)
             for p in (lying, pose)]  # fmt: skip
    direction, angles = panorama_directions(64)
    radiance = linear_light((1 - direction[:, 1]) / 2, "srgb")
    for actual, normal in zip(light, ([0, -1, 0], [0, 0, -1]), strict=True):
        expected = 0.85 / math.pi * cosine_weights(np.array(normal), direction, angles) @ radiance
        assert np.allclose(actual, expected, rtol=0.01)


@pytest.mark.parametrize(("row", "column"), [(300, 200), (251, 77)])
def test_a_small_bright_source_in_the_background_has_its_irradiance(row, column):
    """One pixel of a panorama that is finer than those at the marker, in linear light."""
    image = np.full((512, 1024, 3), 0.1, np.float32)
    image[row, column] = 3e4
    latitude, longitude = np.pi * (row + 0.5) / 512 - np.pi / 2, 2 * np.pi * (column + 0.5) / 1024 - np.pi
    cosine = -math.cos(latitude) * math.cos(longitude)
    expected = 0.1 + 3e4 * cosine * math.cos(latitude) * (math.pi / 512) ** 2 / math.pi
    placed = PlacedMarker(TAG, light=fs.Lighting(response="linear"))
    _, cloud = lit(fs.Scene(markers=[placed], background=fs.Panorama(image)))
    assert cloud.colors.max() == pytest.approx(0.85 * expected, rel=0.05)


@pytest.mark.parametrize("x", [0.13, 0.7])
def test_a_small_lamp_of_a_gaussian_has_its_irradiance(x):
    """Half a degree wide, a fifth of a pixel of the panorama."""
    lamp = fs.SplatCloud([[x, 0.4, -5]], [[1, 0, 0, 0]], [[0.022, 0.022]], [1.0], colors=[[1e3] * 3])
    light = fs.Lighting(response="linear", ambient=(0, 0, 0), panoramas=1)
    _, cloud = lit(fs.Scene((lamp,), markers=[PlacedMarker(TAG, light=light)]))
    distance = x**2 + 0.4**2 + 25
    expected = 1e3 * 2 * math.pi * 0.022**2 * 25 / distance**2 / math.pi
    assert cloud.colors.max() == pytest.approx(0.85 * expected, rel=0.12)


@pytest.mark.parametrize("degrees", [0, 40, 80, 100])
def test_a_sun_follows_the_cosine(degrees):
    angle = math.radians(degrees)
    sun = replace(SUN, direction=(math.sin(angle), 0, math.cos(angle)), color=(1, 0.5, 0.25))
    light, _ = lit(of_lights(sun))
    assert np.allclose(light.max(0), 0.85 * max(math.cos(angle), 0) * np.array([1, 0.5, 0.25]), rtol=1e-5)


def test_ambient_light_replaces_the_colour_of_fog():
    placed = PlacedMarker(TAG, light=fs.Lighting(response="linear", ambient=(1, 1, 1)))
    cloud = (
        renderer().lit(fs.Scene(markers=[placed], fog=fs.Fog(1e-9, (0.5, 0.5, 0.5)))).markers[0].marker.cloud
    )
    assert np.allclose(cloud.colors.max(0), 0.85, rtol=1e-5)


@pytest.mark.parametrize("z", [0.0, 0.3])
def test_a_light_behind_the_marker_is_reported(z):
    lamp = fs.PointLight(position=(0, 0, z))
    with pytest.warns(UserWarning, match=r"lights\[1\] must reach a marker with light"):
        light, _ = lit(of_lights(SUN, lamp))
    assert light.max() == pytest.approx(0.85, rel=1e-5)


def test_a_wide_sun_has_its_intensity_on_a_surface_that_faces_it():
    light, _ = lit(of_lights(replace(SUN, angle=3.0, samples=64)))
    assert light.max() == pytest.approx(0.85, rel=1e-5)


def test_shadows_are_where_moving_objects_are_at_time_0():
    """As in panoramas: a wall that moves in front of the marker, and one that leaves."""
    here, away = np.eye(4), np.eye(4)
    away[0, 3] = 5
    for wall, pose, expected in ((screen(5, 0, -0.2, 1, 1), np.linalg.inv(away), 0.0),
                                 (screen(0, 0, -0.2, 1, 1), away, 0.85)):  # fmt: skip
        scene = replace(of_lights(SUN, clouds=[wall]), cloud_motions={0: lambda time, pose=pose: pose})
        assert lit(scene)[0].max() == pytest.approx(expected, rel=1e-3)
        assert lit(replace(scene, cloud_motions={0: lambda time: here}))[0].max() != pytest.approx(expected)


def test_light_beyond_the_largest_colour_is_clamped():
    _, cloud = lit(of_lights(replace(SUN, intensity=1e15), exposure=1e15, response=0.01))
    assert cloud.colors.max() == pytest.approx(1e15)


def test_point_and_spot_fall_with_the_square_of_the_distance():
    small = replace(TAG, cloud=TAG.cloud.transformed(np.diag([0.01, 0.01, 0.01, 1.0])))
    for lamp, share in (
        (fs.PointLight(position=(0, 0, -2), intensity=4 * math.pi), 1.0),
        (fs.SpotLight(position=(0, 0, -2), direction=(0, 0, 1), intensity=4 * math.pi), 1.0),
        (fs.SpotLight(position=(0, 0, -2), direction=(1, 0, 1), outer=0.7, intensity=1), 0.0),
        (fs.SpotLight(position=(0, 0, -2), direction=(0.5, 0, math.sqrt(0.75)), inner=0.1, outer=1,
                      intensity=4 * math.pi),
         ((math.cos(math.pi / 6) - math.cos(1)) / (math.cos(0.1) - math.cos(1))) ** 2),
    ):  # fmt: skip
        scene = of_lights(lamp)
        scene = replace(scene, markers=[replace(scene.markers[0], marker=small)])
        assert lit(scene)[0].max() == pytest.approx(0.85 * share, rel=2e-3)


def test_rectangles_of_ink_and_paper_are_within_the_step_of_their_light():
    """Light of a near lamp in the corners of each rectangle, in closed form."""
    lamp = fs.PointLight(position=(0.05, -0.02, -0.1), intensity=0.05)
    light, cloud = lit(of_lights(lamp, step=0.05))
    for corner in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
        at = np.array(lamp.position) - cloud.world_means()
        at[:, :2] -= (cloud.scales[:, :2] - TAG.module / 16) * corner  # the outer sample points
        expected = 0.05 / math.pi * -at[:, 2] / (at**2).sum(1) ** 1.5
        dark = light[:, 0] < 0.3 * expected
        assert 0 < dark.sum() < len(dark)
        error = np.abs(light[:, 0] - expected * np.where(dark, 0.05, 0.85)) / light[:, 0]
        assert error.max() < 0.051


@pytest.mark.parametrize("quaternion", [(1, 0, 0, 0), (0.9, 0.2, -0.3, 0.1)])
def test_a_shadow_has_its_edge_at_the_computed_place(quaternion):
    """A half plane before the marker, in the marker's frame; the sun has a slope of 0.5 along x."""
    from fidsplat.splats.rotations import rigid_matrix

    pose = rigid_matrix((0.3, -2.0, 5.0), quaternion)
    direction = pose[:3, :3] @ (0.5, 0, 1)
    wall = screen(0.5, 0, -0.2, 0.5, 1).transformed(pose)  # x above 0; its shadow is moved by 0.1
    edge, finest = 0.1, TAG.module / 8
    scene = of_lights(replace(SUN, direction=tuple(direction)), clouds=[wall], pose=pose)
    _, cloud = lit(scene)
    light = linear_light(cloud.colors, "srgb")[:, 0]
    left, right = cloud.means[:, 0] - cloud.scales[:, 0], cloud.means[:, 0] + cloud.scales[:, 0]
    bright, black = light > 0.04 * math.cos(math.atan(0.5)), light < 1e-5
    assert bright.any()
    assert left.max() > edge
    assert black[left > edge + 1.5 * finest].all()
    assert bright[right < edge - 1.5 * finest].all()


def test_splats_that_cannot_cast_shadows_are_left_out_without_a_change():
    """With a motion, even of no distance, all splats are in the shadow maps."""
    lights = (
        replace(SUN, direction=(0.6, 0.2, 1), angle=0.3, samples=3),
        fs.PointLight(position=(0.1, 0.2, -0.6), radius=0.1, samples=3),
        fs.SpotLight(position=(-0.3, 0, -0.2), direction=(0.3, 0, 0.2)),
    )
    rng = np.random.default_rng(3)
    disks, boxes = (
        fs.SplatCloud(
            rng.uniform(-0.8, 0.8, (150, 3)), rng.normal(size=(150, 4)), rng.uniform(0.005, 0.06, (150, 2)),
            rng.uniform(0.2, 1, 150), colors=np.ones((150, 3)),
        )
        for _ in range(2)
    )  # fmt: skip
    scene = of_lights(*lights, clouds=[disks, boxes.with_boxes()])
    bent = fs.marker("aruco:4x4_50:7", 0.16, shape="cylinder,radius=0.1,deviation=0.001")
    scene = replace(scene, markers=[replace(scene.markers[0], marker=bent)])
    every = replace(scene, cloud_motions={0: lambda time: np.eye(4)})
    (found, _), (expected, _) = lit(scene), lit(every)
    assert np.ptp(expected) > 0.1
    assert np.allclose(found, expected, atol=1e-6)


def test_a_large_light_has_a_penumbra_of_its_size():
    """A sun of the angular diameter 0.4 behind an edge at 0.2 m: 0.2 tan(0.2) on both sides."""
    wall = screen(0.5, 0, -0.2, 0.5, 1)
    _, cloud = lit(of_lights(replace(SUN, angle=0.4), clouds=[wall], step=0.01))
    white = linear_light(cloud.colors, "srgb")[:, 0] / 0.85
    at, wide = cloud.means[:, 0], 0.2 * math.tan(0.2)
    paper = white > 0.06  # ink is below
    inside = paper & (np.abs(at) < 0.9 * wide)
    # the visible share of a disk that is cut by a line
    cut = np.clip(-at / wide, -1, 1)
    share = 0.5 + (cut * np.sqrt(1 - cut**2) + np.arcsin(cut)) / math.pi
    assert inside.sum() > 20
    assert np.abs(white - share)[inside].max() < 0.08


def test_translucent_splats_transmit_their_share():
    wall = fs.SplatCloud([[0, 0, -0.2]], [[1, 0, 0, 0]], [[1.0, 1.0]], [0.75], colors=[[1, 0, 0]])
    light, _ = lit(of_lights(SUN, clouds=[wall.with_boxes()]))
    assert np.allclose(light.max(0), 0.85 * 0.25, rtol=1e-3)


def test_splats_behind_and_very_near_do_not_occlude():
    clouds = [screen(0, 0, 0.01, 1, 1), screen(0, 0, -0.005, 1, 1)]
    assert lit(of_lights(SUN, clouds=clouds))[0].max() == pytest.approx(0.85, rel=1e-3)
    assert lit(of_lights(SUN, clouds=clouds, clearance=0.001))[0].max() < 1e-3


def test_an_obstacle_next_to_a_marker_darkens_its_half():
    """A wall at the right edge of the marker occludes half of the sky there."""
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
    pose[:3, 3] = (0.1, 0, -0.5)
    wall = fs.SplatCloud([[0, 0, 0]], [[1, 0, 0, 0]], [[0.5, 3.0]], [1.0], colors=[[0, 0, 0]])
    wall = wall.with_boxes().transformed(pose)
    scene = fs.Scene([wall], markers=[PlacedMarker(TAG, light="scene")], background=(1.0, 1.0, 1.0))
    light, cloud = lit(scene)
    away = 0.1 - cloud.means[:, 0]
    free = (1 + away / np.hypot(away, 1)) / 2  # form factor of a long wall, 1 m high
    paper = light[:, 0] > 0.2
    assert np.abs(light[paper, 0] / 0.85 - free[paper]).max() < 0.015
    assert np.ptp(light[paper, 0]) > 0.05
    one = replace(scene, markers=[PlacedMarker(TAG, light=fs.Lighting(panoramas=1))])
    assert np.ptp(lit(one)[0][TAG.is_dark == 0, 0]) < 1e-6
    assert len(cloud) > len(TAG.cloud)


def test_lights_and_panorama_add_up():
    placed = PlacedMarker(TAG, light="scene")
    scene = fs.Scene(markers=[placed], background=(0.5, 0.5, 0.5), lights=[SUN, SUN])
    expected = 0.85 * (2 + linear_light(np.array(0.5), "srgb"))
    assert lit(scene)[0].max() == pytest.approx(expected, rel=1e-4)
    assert lit(replace(scene, lights=[]))[0].max() == pytest.approx(expected - 1.7, rel=1e-4)


def test_exposure_and_response_are_parameters():
    bright = of_lights(SUN, exposure=4.0, response="linear", paper=0.5, ink=0.1)
    cloud = renderer().lit(bright).markers[0].marker.cloud
    assert np.allclose(np.unique(cloud.colors), [0.4, 2.0], rtol=1e-5)  # above 1 too


def test_gaussians_and_rotated_boxes_are_lit():
    fitted = fs.marker("aruco:4x4_50:7", size=0.16, mixture="fitted")
    wall = screen(0.5, 0, -0.2, 0.5, 1)
    scene = of_lights(SUN, clouds=[wall])
    _, cloud = lit(replace(scene, markers=[replace(scene.markers[0], marker=fitted)]))
    assert len(cloud) == len(fitted.cloud)
    light = linear_light(cloud.colors, "srgb").max(axis=1)
    assert (light[cloud.means[:, 0] > 0.005] < 1e-3).all()
    assert (light[cloud.means[:, 0] < -0.005] > 0.04).all()


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
def test_reflections_by_sampling_equal_the_integral(roughness):
    surface, rows = GlossyBrdf(roughness, 0.04), 128
    field = LightField(*panorama_directions(rows))
    toward = np.array([0.5, 0.0, math.sqrt(0.75)])
    light = 0.1 + 1.0 * (field.directions @ toward > math.cos(math.radians(25)))
    field.radiance = np.repeat(light[:, None], 3, 1)[None, None]
    views = view_directions(UP)[::16]
    directions, weights = surface.sample(views[None], UP[None])
    incoming = field.incoming_radiance(directions[0], np.zeros((len(views), 2)))[..., 0]
    sampled = (incoming * weights[0]).sum(-1)
    count = len(field.directions)
    for view, actual in zip(views, sampled, strict=True):
        reflected = surface.reflected(
            np.full((count, 1), view @ UP),
            np.broadcast_to(view, (count, 1, 3)),
            field.directions,
            np.broadcast_to(UP, (count, 3)),
        )[:, 0]
        assert actual == pytest.approx(reflected @ (field.angles * light), abs=0.0025)


def test_fresnel_by_polarisation():
    """A smooth surface of refractive index 1.5 under uniform light reflects 4 % at normal incidence, and the
    mean of s- and p-polarised light by Snell's law at 1.2 rad."""
    inner = math.asin(math.sin(1.2) / 1.5)
    s, p = math.sin(1.2 - inner) / math.sin(1.2 + inner), math.tan(1.2 - inner) / math.tan(1.2 + inner)
    expected = 0.04, (s**2 + p**2) / 2
    assert np.allclose(fresnel(np.cos([0, 1.2]), 0.04), expected)
    assert (fresnel(np.array([0.0, 0.3]), 0.0) == 0).all()
    assert fresnel(np.array([0.0, 0.5]), 1.0) == pytest.approx(1)
    views = np.array([[0, 0, 1.0], [math.sin(1.2), 0, math.cos(1.2)]])
    _, weights = GlossyBrdf(0.1, 0.04).sample(views[None], UP[None])
    assert np.allclose(weights[0].sum(-1), expected, rtol=0.03)


def test_a_glossy_marker_reflects_a_lamp_in_the_mirror_direction():
    """Camera and lamp are mirror images about the normal at x = 0.03."""
    pose = np.eye(4)
    lamp = fs.PointLight(position=(0.33, 0, -0.4), intensity=0.05)
    camera = fs.Camera.look_at(64, 48, 1.0, (-0.27, 0, -0.4), (0, 0, 0))
    shiny = fs.Lighting("lights", roughness=0.2, view="camera", ambient=(0.1, 0.1, 0.1))
    scene = fs.Scene(camera=camera, markers=[PlacedMarker(TAG, pose, light=shiny)], lights=[lamp])
    light, cloud = lit(scene)
    assert np.abs(cloud.means[light[:, 0].argmax(), :2] - (0.03, 0)).max() < TAG.module / 2
    matte = lit(replace(scene, markers=[PlacedMarker(TAG, pose, light="lights")]))[0]
    assert light.max() > 1.5 * matte.max()


def test_harmonics_of_a_glossy_marker_are_those_of_the_world():
    """A rotated marker under a one-sided sky: its harmonics return the colours of the view from a camera."""
    from fidsplat.splats.rotations import rigid_matrix

    pose = rigid_matrix((0.1, 0.2, 3.0), (0.9, 0.2, -0.3, 0.1))
    sky = fs.Gradient(top=(1.0, 0.9, 0.8), bottom=(0.1, 0.1, 0.3), up=(1.0, -0.5, 0.0))
    camera = fs.Camera.look_at(64, 48, 1.0, (0.5, 0.4, 2.0), (0.1, 0.2, 3.0))
    results = []
    for view in ("any", "camera"):
        light = fs.Lighting(roughness=0.6, view=view)
        scene = fs.Scene(camera=camera, markers=[PlacedMarker(TAG, pose, light=light)], background=sky)
        placed = renderer().lit(scene).markers[0]
        results.append(renderer().render(fs.Scene([placed.cloud()], camera))["rgb"])
    assert np.abs(results[0] - results[1]).max() < 0.02
    assert results[0].max() > 0.3


def test_the_error_of_harmonics_of_degree_3():
    """Reflections of a bright window, for the limit of roughness that docs/effects.md states."""
    directions, angles = panorama_directions(64)
    window = 0.3 + 9.7 * (directions @ [0.5, 0, math.sqrt(0.75)] > math.cos(math.radians(20)))
    field = LightField(directions, angles)
    field.radiance = np.repeat(window[:, None], 3, 1)[None, None]
    views = view_directions(UP)
    errors = []
    for roughness in (0.25, 0.5):
        weights = GlossyBrdf(roughness, 0.04).sample(views[None], UP[None])
        light = field.reflected(weights[0][0], weights[1][0])[0, 0] + 0.05
        colors = to_colors(light, "srgb")
        fitted = 0.5 + np.einsum("vk,kc->vc", sh_basis(3, -views), fit_harmonics(views, colors[None])[0])
        errors.append(np.sqrt(((fitted - colors) ** 2).mean()))
    assert errors[1] < 0.015 < 2 * errors[1] < errors[0]


@pytest.mark.parametrize("response", ["srgb", "linear", 2.2])
def test_responses_are_inverse_above_1_too(response):
    values = np.array([0.0, 0.001, 0.04, 0.5, 1.0, 7.0])
    assert np.allclose(to_colors(linear_light(values, response), response), values, rtol=1e-9)


def test_a_scene_is_computed_once_and_deterministic():
    scene, one = of_lights(SUN), renderer()
    assert one.lit(scene) is one.lit(scene)
    assert one.lit(plain := fs.Scene(markers=[PlacedMarker(TAG)], lights=[SUN])) is plain
    first, second = (renderer().lit(replace(scene)).markers[0].marker.cloud for _ in range(2))
    assert np.array_equal(first.colors, second.colors)
    assert np.array_equal(first.means, second.means)


def test_scene_files_have_lights(tmp_path):
    lights = (
        fs.Sun(direction=(0.3, 1, 0.5), color=(1, 0.9, 0.8), intensity=3, angle=math.radians(2)),
        fs.PointLight(position=(1, 2, 3), radius=0.05, samples=8),
        fs.SpotLight(position=(1, 2, 3), direction=(0, 1, 0), inner=math.radians(10), outer=math.radians(20)),
    )
    own = fs.Lighting("lights", paper=0.8, roughness=0.6, ambient=(0.1, 0.2, 0.3), response=2.2)
    markers = [PlacedMarker(TAG), PlacedMarker(TAG, light="scene"), PlacedMarker(TAG, light=own)]
    fs.Scene(markers=markers, lights=lights).save(tmp_path / "scene.toml")
    text = (tmp_path / "scene.toml").read_text()
    assert 'light = "scene"' in text
    assert "angle_deg" in text
    read = fs.Scene.load(tmp_path / "scene.toml")
    assert [placed.light for placed in read.markers] == [None, fs.Lighting("scene"), own]
    for one, other in zip(read.lights, lights, strict=True):
        assert type(one) is type(other)
        fields = [np.array(list(vars(light).values())[1:], object) for light in (one, other)]
        assert all(map(np.allclose, *fields))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[[lights]]\nkind = "moon"', "lights[0].kind must be sun, point, spot, got 'moon'"),
        ('[[lights]]\nkind = "sun"', "lights[0].direction is missing"),
        ('[[lights]]\nkind = "sun"\ndirection = [0, 0]', "scene.toml: lights[0].direction must be a list of"),
        ('[[lights]]\nkind = "sun"\nposition = [0, 0, 1]', "position"),
        ('[[lights]]\nkind = "sun"\ndirection = [0, 0, 0]', "three numbers, not all 0"),
        ('[[lights]]\nkind = "point"\nposition = [0, 0, 1]\nradius = -1', "radius must be a number from 0"),
        ('[[markers]]\nspec = "aruco:4x4_50:7"\nsize = 1\nlight = "moon"', "known: scene, lights"),
        ('[[markers]]\nspec = "aruco:4x4_50:7"\nsize = 1\nlight = { paper = 2 }', "paper must be"),
        ('[[markers]]\nspec = "aruco:4x4_50:7"\nsize = 1\nlight = { papr = 1 }', "did you mean 'paper'"),
    ],
)
def test_errors_of_scene_files(tmp_path, text, words):
    (tmp_path / "scene.toml").write_text(text)
    with pytest.raises(fs.InputError) as error:
        fs.Scene.load(tmp_path / "scene.toml")
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: fs.Lighting(ink=0.9), "ink must be a number from 0 to 0.85"),
        (lambda: fs.Lighting(roughness=0.01), "roughness must be a number from 0.1 to 1"),
        (lambda: fs.Lighting(response="log"), "response must be"),
        (lambda: fs.Lighting(ambient=(1, 1, -1)), "at least 0"),
        (lambda: fs.Lighting(panoramas=2.0), "panoramas must be 1, 2, 3, 5, 9, 17, got 2.0"),
        (lambda: fs.Lighting(panoramas=4), "panoramas must be 1, 2, 3, 5, 9, 17, got 4"),
        (lambda: fs.Sun(direction=(0, 0, math.nan)), "three finite numbers"),
        (
            lambda: fs.SpotLight(position=(0, 0, 0), direction=(0, 0, 1), inner=0.8),
            "inner, 45.8366 degrees, got 45 degrees",
        ),
        (lambda: PlacedMarker(TAG, light=1), "a marker's light must be"),
        (lambda: fs.Scene(lights=[{}]), r"lights must be a list of Light, got \{\}; write .*fs\.Sun\("),
    ],
)
def test_errors_of_values(make, words):
    with pytest.raises(fs.InputError, match=words):
        make()


def test_errors_of_light_that_cannot_be_computed():
    dark = fs.Scene(markers=[PlacedMarker(TAG, light="scene")])
    with pytest.raises(fs.InputError, match=r"must not be black, got no light; .*ambient"):
        lit(dark)
    named = fs.Lighting(ambient=(0.5, 0.5, 0.5))
    light, _ = lit(replace(dark, markers=[PlacedMarker(TAG, light=named)]))
    assert light.max() == pytest.approx(0.85 * 0.5, rel=1e-4)
    with pytest.raises(fs.InputError, match=r"at least 0\.5 with view='any'"):
        lit(of_lights(SUN, roughness=0.3))
    with pytest.raises(fs.InputError, match="the scene must have a camera"):
        lit(of_lights(SUN, roughness=0.3, view="camera"))
    with pytest.raises(fs.InputError, match=r"must have lights for marker 1 .*, got none; add"):
        lit(replace(dark, markers=[PlacedMarker(TAG, light="lights")]))


def test_a_light_inside_of_a_wall_is_an_error():
    walls = [screen(0, 0, z, 1, 1) for z in (-0.49, -0.51)]
    lamp = fs.PointLight(position=(0, 0, -0.5))
    with pytest.raises(fs.InputError, match=r"lights\[0\] must be outside of surfaces"):
        lit(of_lights(lamp, clouds=walls))
    # behind one wall it is only occluded
    assert not lit(of_lights(lamp, clouds=walls[:1]))[0].any()
