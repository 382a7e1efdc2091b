"""Markers bent to a surface: positions and normals of splats, true corners, and errors."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial import cKDTree

import fidsplat as fs
from fidsplat.images.files import to_uint8
from fidsplat.markers import BentSheet, BoxEdge, Cone, Crumpled, Cylinder
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.util.response import linear_light
from fidsplat.vision.detect import detect
from fidsplat.vision.readback import read_back
from fidsplat.vision.truth import truth_of

BACKEND = "opencl"  # for the fixture `renderer`
SPEC, SIZE, SHEET = "apriltag:36h11:5", 0.16, 0.2
SHAPES = (
    Cylinder(0.05),
    Cylinder(-0.06, axis=(1, 2)),
    Cone(0.09, 0.4),
    BentSheet(0.04, 0.12, axis="x"),
    BoxEdge(0.008, 0.03),
    Crumpled(0.006, 0.07, seed=4),
)
on_each = pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.kind)


def sheet_points(count: int) -> np.ndarray:
    return np.random.default_rng(3).uniform(-SHEET / 2, SHEET / 2, (count, 2))


def corners_of(cloud: fs.SplatCloud) -> np.ndarray:
    """Corners (n, 4, 3) of boxes."""
    rotation, scales = quaternion_to_matrix(cloud.quats), cloud.scales.astype(float)
    sides = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * scales[:, None]
    return cloud.world_means()[:, None] + sides @ rotation[:, :, :2].transpose(0, 2, 1)


@on_each
def test_splats_are_near_the_surface_with_its_normals(shape):
    """Random points of the boxes, against the nearest of a dense grid of points of the surface."""
    marker, cells = fs.marker(SPEC, SIZE, shape=shape), 300
    corners, rng = corners_of(marker.cloud), np.random.default_rng(0)
    some = rng.integers(0, len(corners), 400)
    a, b = rng.random((2, 400, 1))
    corner = corners[some]
    points = corner[:, 0] + a * (corner[:, 1] - corner[:, 0]) + b * (corner[:, 3] - corner[:, 0])
    at = (np.arange(cells) + 0.5) / cells * SHEET - SHEET / 2
    frames = shape.frames(np.stack(np.meshgrid(at, at), -1).reshape(-1, 2))
    step, sharpest = SHEET / cells, 0.008
    grid = cKDTree(frames.points)
    distance, near = grid.query(points)
    # nearest grid points are up to 0.7 steps aside; the distance along the normal is what counts there
    along_normal = np.abs(((points - frames.points[near]) * frames.normals[near]).sum(1))
    assert along_normal.max() < SIZE / 2500 + step**2 / 4 / sharpest
    assert along_normal.max() > SIZE / 25000
    assert distance.max() < SIZE / 2500 + step

    near = grid.query(marker.cloud.means)[1]
    cosine = (quaternion_to_matrix(marker.cloud.quats)[:, :, 2] * frames.normals[near]).sum(1)
    assert np.arccos(np.minimum(cosine, 1)).max() < 0.71 * step / sharpest + 1e-3
    area = (marker.cloud.scales.prod(1) * 4).sum()
    assert area > SHEET**2


@pytest.mark.parametrize("length", [0.05, 0.025])
def test_pieces_do_not_skip_waves(length):
    """Waves of a length that divides the sheet's: samples at equal distances are all at the same height."""
    shape, share = BentSheet(0.3, length), np.linspace(-1, 1, 21)[:, None, None]
    cloud = fs.marker(SPEC, SIZE, shape=shape).cloud
    along = quaternion_to_matrix(cloud.quats)[:, :, 0] * cloud.scales[:, :1]
    points = (cloud.world_means() + share * along).reshape(-1, 3)
    curve = shape.frames(np.column_stack([np.linspace(-0.1, 0.1, 20001), np.zeros(20001)])).points
    assert cKDTree(curve[:, ::2]).query(points[:, ::2])[0].max() < SIZE / 2500 + 1e-5


def test_shapes_with_a_list_or_an_array_as_axis_are_values():
    one, other = Cylinder(0.05, axis=[1, 2]), Cylinder(np.float32(0.05), axis=np.array([1.0, 2.0]))
    assert one.axis == other.axis == (1.0, 2.0)
    assert hash(one) == hash(Cylinder(0.05, axis=(1, 2)))
    assert type(other.radius) is float


@on_each
def test_rectangles_keep_their_area_and_tangents(shape):
    """Numerical derivatives of the map are the axes of splats; lengths are those of the flat sheet."""
    xy, step = sheet_points(400), 1e-7
    frames = shape.frames(xy)
    by_x, by_y = (
        (shape.frames(xy + offset).points - shape.frames(xy - offset).points) / (2 * step)
        for offset in (np.array([step, 0]), np.array([0, step]))
    )
    stretch = 0.02 if shape.kind == "crumpled" else 1e-6
    for derivative, tangent in ((by_x, frames.along_x), (by_y, frames.along_y)):
        assert np.abs(np.linalg.norm(derivative, axis=1) - 1).max() < stretch
        assert np.abs((derivative * frames.normals).sum(1)).max() < 1e-5
        assert (derivative * tangent).sum(1).min() > 1 - stretch
    assert np.abs((frames.along_x * frames.along_y).sum(1)).max() < 1e-12


def test_a_cylinder_in_closed_form():
    radius = 0.07
    marker = fs.marker(SPEC, SIZE, shape=Cylinder(radius))
    angle = SIZE / 2 / radius
    x, z = radius * math.sin(angle), radius * (1 - math.cos(angle))
    y = SIZE / 2
    assert np.allclose(marker.corners, [[-x, -y, z], [x, -y, z], [x, y, z], [-x, y, z]], atol=1e-15)
    # the arc between the outer edges of the splats is the width of the flat sheet
    corners = corners_of(marker.cloud)
    angles = np.arctan2(corners[..., 0], radius - corners[..., 2])
    assert radius * (angles.max() - angles.min()) == pytest.approx(SHEET, abs=4 * SIZE / 2500)
    inside = fs.marker(SPEC, SIZE, shape=Cylinder(-radius, axis="x"))
    assert np.allclose(inside.corners, [[-y, -x, -z], [y, -x, -z], [y, x, -z], [-y, x, -z]], atol=1e-15)


def test_other_shapes_in_closed_form():
    half = SIZE / 2
    bent = fs.marker(SPEC, SIZE, shape=BentSheet(0.05, 0.13)).corners
    turn = 0.13 / (2 * math.pi * 0.05)
    parts = [
        quad(lambda s, f=f: f(turn * math.sin(2 * math.pi * s / 0.13)), 0, half)[0]
        for f in (math.cos, math.sin)
    ]
    assert np.allclose(bent[2], [parts[0], half, parts[1]], atol=1e-12)
    assert np.allclose(bent[0], [-parts[0], -half, parts[1]], atol=1e-12)

    # a box edge far from the corners: two planes at a right angle
    edge = fs.marker(SPEC, SIZE, shape=BoxEdge(0.01)).corners
    length = half - 0.01 * math.pi / 4  # of the plane, to the corner of the code
    c = math.sqrt(0.5)
    arc = np.array([0.01 * c, 0.01 * (1 - c)])
    assert np.allclose(edge[2, [0, 2]], arc + c * length, atol=1e-12)
    assert np.allclose(edge[0, [0, 2]], (arc + c * length) * [-1, 1], atol=1e-12)

    # a cone: all points of a circle around the apex of the flat sheet have one radius
    cone = Cone(0.09, 0.4)
    sine = 0.4 / math.hypot(1, 0.4)
    apex = np.array([0, -0.09 / sine, 0])
    points = cone.frames(sheet_points(50)).points
    flat = np.linalg.norm(sheet_points(50) + np.array([0, 0.09 / sine]), axis=1)
    assert np.allclose(np.linalg.norm(points - apex, axis=1), flat, atol=1e-12)
    axis = np.array([0, math.sqrt(1 - sine**2), sine])
    assert np.allclose((points - apex) @ axis, flat * math.sqrt(1 - sine**2), atol=1e-12)


def test_no_light_passes_between_the_pieces(renderer):
    camera = fs.Camera.look_at(64, 48, 0.25, (0.02, -0.05, -0.2), (0, 0, 0))
    for shape in SHAPES[:1] + SHAPES[2:]:
        marker = fs.marker(SPEC, SIZE, shape=shape)
        frame = renderer.render(marker.cloud, fs.Capture(camera, ("rgb", "alpha")))
        assert frame["alpha"].min() > 0.99, shape


def test_a_detector_reads_wide_cylinders_and_its_truth_follows_the_shape(renderer):
    camera = fs.Camera.look_at(200, 200, 0.7, (0, 0, -0.35), (0, 0, 0))
    results = {}
    for radius in (2.0, 0.04):
        placed = PlacedMarker(fs.marker(SPEC, SIZE, shape=Cylinder(radius)))
        scene = fs.Scene(markers=[placed], camera=camera, background=(0.5, 0.5, 0.5))
        frame = renderer.render(scene, outputs=("rgb", "label", "depth"))
        expected = truth_of(frame, scene).markers[0]
        results[radius] = read_back(frame, scene).readings[0]
        assert np.allclose(expected.corners, camera.project(placed.corners))
        # depth at the centre is that of the flat marker, and grows with the distance from the axis
        depth = frame["depth"]
        assert depth[100, 100] == pytest.approx(0.35, abs=2e-4)
        mask = frame["label"] == 1
        assert expected.box is not None
        x0, _, x1, _ = expected.box
        assert np.flatnonzero(mask.any(0))[[0, -1]] == pytest.approx([x0, x1 - 1], abs=1.5)
    assert results[2.0].corner_error is not None
    assert results[2.0].corner_error < 0.4
    assert results[0.04].detection is None
    assert 0 < results[0.04].visible < 1.0001


def test_shapes_in_scene_files(tmp_path):
    for shape in SHAPES:
        scene = fs.Scene(markers=[PlacedMarker(fs.marker(SPEC, SIZE, shape=shape))])
        scene.save(tmp_path / "scene.toml")
        read = fs.Scene.load(tmp_path / "scene.toml").markers[0].marker
        assert read.shape == shape
        assert np.array_equal(read.cloud.means, scene.markers[0].marker.cloud.means)
    assert fs.marker(SPEC, SIZE, shape="cylinder,radius=0.05,axis=x").shape == Cylinder(0.05, axis="x")


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        (Cylinder(0.03), r"radius must be at least 0\.03183 m for a sheet of 0\.2 m"),
        (Cone(0.03, 0.4), "radius must be at least"),
        (BentSheet(0.01, 0.2), "radius must be at least"),
        ("cylinder", "radius must be given"),
        ("cylindre,radius=1", "did you mean 'cylinder'"),
        ("cylinder,radius=1,axis=z", "axis must be x, y or two numbers"),
        ("crumpled,height=0.02,length=0.1", "height must be 0 to a tenth of the length"),
        ("cylinder,radius=0.1,deviation=0", "deviation must be a positive length"),
        ("bent,radius=1,length=1e-9", "length must be at least 2e-05 m for this marker"),
        (3, "shape must be a shape, its text or None"),
    ],
)
def test_impossible_shapes_are_refused(shape, message):
    with pytest.raises(fs.InputError, match=message):
        fs.marker(SPEC, SIZE, shape=shape)


def test_a_flat_marker_has_the_same_splats_as_ever():
    flat, plain = fs.marker(SPEC, SIZE, shape=None, wear="fading=0"), fs.marker(SPEC, SIZE)
    assert flat.wear is None
    for name in ("means", "quats", "scales", "colors", "coplanar_groups"):
        assert np.array_equal(getattr(flat.cloud, name), getattr(plain.cloud, name))


def test_gaussians_of_a_bent_marker(renderer):
    """As Gaussians the marker has the same surface, and the facets of its mixture are refused."""
    marker = fs.marker("apriltag:16h5:3", SIZE, "fitted", template=5, shape=Cylinder(0.1))
    radii = np.hypot(marker.cloud.means[:, 0], 0.1 - marker.cloud.means[:, 2])
    assert np.abs(radii - 0.1).max() < SIZE / 2500
    camera = fs.Camera.look_at(160, 160, 0.7, (0, 0, -0.35), (0, 0, 0))
    image = renderer.render(marker.cloud, camera, background=(0.5, 0.5, 0.5))["rgb"]
    assert [code.name for code in detect(to_uint8(image), ["apriltag:16h5"])] == ["apriltag:16h5:3"]
    with pytest.raises(fs.InputError, match="got facets; use exact"):
        fs.marker(SPEC, SIZE, "facets", shape=Cylinder(0.1))


def test_light_of_a_worn_tag_on_a_cylinder_follows_its_normals(renderer):
    """Paper under a sun: 0.85 / pi times the irradiance times the cosine to the normal of the cylinder."""
    radius = 0.06
    marker = fs.marker(SPEC, SIZE, shape=Cylinder(radius), wear="dirt=0.1,seed=1")
    sun = fs.Sun(direction=(0.8, 0.0, 0.6), intensity=3.0)
    scene = fs.Scene(markers=[PlacedMarker(marker, light="lights")], lights=[sun])
    cloud = renderer.lit(scene).cloud()
    paper = (marker.cloud.colors == 1).all(1)
    assert len(cloud) == len(marker.cloud)
    turn = np.arctan2(cloud.means[paper, 0], radius - cloud.means[paper, 2])
    cosine = np.maximum(-(0.8 * np.sin(turn) - 0.6 * np.cos(turn)), 0)
    light = linear_light(cloud.plain_colors[paper, 0], "srgb")
    assert np.abs(light - 0.85 / math.pi * 3.0 * cosine).max() < 0.02
    assert (light == 0).any()
