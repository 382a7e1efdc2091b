"""Meshes of scenes with closed forms, read back by trimesh and MuJoCo."""

import math

import numpy as np
import pytest
import trimesh
from analytic_surfaces import leaves, plane, sphere
from command_line import fails, prints_json

import fidsplat as fs
from fidsplat.formats.convex_parts import convex_parts
from fidsplat.formats.meshes import TriangleMesh, save_mesh
from fidsplat.render import mesh
from fidsplat.render.mesh import scene_mesh
from fidsplat.render.tsdf import DistanceField

AT, RADIUS, VOXEL = np.array([5.0, -3.0, 7.0]), 0.5, 0.05
BOX = TriangleMesh(
    np.array([[x, y, z] for x in (0, 1) for y in (0, 2) for z in (0, 3)], float),
    np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
         [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]], np.int32
    ),
)  # fmt: skip


def foreign(made: TriangleMesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(made.vertices, made.faces, process=False)


@pytest.fixture(scope="module")
def ball():
    """A sphere with a red half, of 24 views of 112 x 112 pixels."""
    cloud = sphere(AT, RADIUS, 1500)
    red = np.where((cloud.means + cloud.origin)[:, :1] > AT[0], [0.9, 0.1, 0.1], [0.2, 0.2, 0.2])
    cloud = fs.SplatCloud(
        cloud.means, cloud.quats, cloud.scales, cloud.opacities, colors=red, origin=cloud.origin
    )
    with pytest.MonkeyPatch.context() as small:
        small.setattr(mesh, "VIEWS", 24)
        small.setattr(mesh, "IMAGE_SIDE", 112)
        return scene_mesh(fs.Scene([cloud]), voxel=VOXEL, renderer=fs.Renderer("opencl"))


def test_area_and_volume_of_a_sphere_are_the_closed_forms(ball):
    distance = np.linalg.norm(ball.vertices - AT, axis=1) - RADIUS
    assert np.abs(distance).max() < VOXEL / 2
    assert math.sqrt(np.mean(distance**2)) < VOXEL / 10
    assert ball.area == pytest.approx(4 * math.pi * RADIUS**2, rel=0.03)
    assert ball.volume == pytest.approx(4 / 3 * math.pi * RADIUS**3, rel=0.03)
    assert foreign(ball).is_watertight
    assert foreign(ball).volume == pytest.approx(ball.volume)  # positive: faces are turned outwards


def test_colours_of_a_sphere_are_those_of_its_splats(ball):
    x = ball.vertices[:, 0] - AT[0]
    np.testing.assert_allclose(ball.colors[x > 0.2].mean(0), (0.9, 0.1, 0.1), atol=0.05)
    np.testing.assert_allclose(ball.colors[x < -0.2].mean(0), (0.2, 0.2, 0.2), atol=0.05)


def test_an_oblique_plane_behind_leaves():
    """Of unequal focal lengths, off the origin; cameras aside, so that each sees behind another's leaves."""
    normal = np.array([0.5, 0.2, -1.0]) / math.sqrt(1.29)
    scene = fs.Scene([plane(AT, normal, 0.6), leaves(AT + 0.6 * normal, 0.1, 20)])
    cameras = [
        fs.Camera.pinhole(
            128, 96, 110.0, 90.0, 60.0, 50.0,
            fs.Camera.look_at(8, 8, 1.0, AT + np.array([x, y, -2.0]), AT).world_to_camera,
        )
        for x in (-1.0, 0.0, 1.0) for y in (-0.7, 0.7)
    ]  # fmt: skip
    made = scene_mesh(scene, cameras, 0.03, fs.Renderer("opencl"))
    local = made.vertices - AT
    away = local @ normal
    on_wall = np.abs(away) < 0.1
    assert np.abs(away[on_wall]).max() < 0.03 / 2
    within = np.linalg.norm(local[on_wall] - away[on_wall, None] * normal, axis=1) < 0.5
    centers = made.vertices[made.faces].mean(1) - AT
    middle = (np.abs(centers @ normal) < 0.1) & (np.linalg.norm(centers, axis=1) < 0.5)
    crosses = made._crosses[middle]
    assert within.sum() > 500
    assert np.linalg.norm(crosses, axis=1).sum() / 2 == pytest.approx(math.pi * 0.25, rel=0.05)
    assert (crosses @ normal > 0).all()  # all faces are turned to the cameras


def test_a_field_of_known_distances():
    """A plane between voxels, exactly: every vertex is on it, at every fraction of a voxel."""
    for fraction in (0.1, 0.37, 0.5, 0.93):
        depth = np.full((64, 64), 2.0 + 0.1 * fraction, np.float32)
        camera = fs.Camera.orthographic(64, 64, 1.6)
        field = DistanceField(0.1, (0.0, 0.0, 0.0))
        field.allocate(depth, camera)
        field.integrate(depth, np.ones_like(depth), np.zeros((64, 64, 3)), camera)
        made = field.mesh()
        assert len(made.vertices) > 100
        np.testing.assert_allclose(made.vertices[:, 2], 2.0 + 0.1 * fraction, atol=1e-6)


@pytest.mark.parametrize("ending", ["glb", "ply", "obj", "stl"])
def test_files_are_read_by_trimesh(ball, tmp_path, ending):
    file = tmp_path / f"mesh.{ending}"
    assert save_mesh(ball, file) == []
    again = trimesh.load(file, force="mesh")
    assert again.volume == pytest.approx(ball.volume, rel=1e-4)
    assert len(again.faces) == len(ball.faces)
    rotation = np.array([-1, -1, 1]) if ending == "glb" else np.ones(3)  # y up
    np.testing.assert_allclose(
        np.sort(again.bounds, 0), np.sort(foreign(ball).bounds * rotation, 0), atol=1e-5
    )
    if ending == "ply":
        np.testing.assert_allclose(again.visual.vertex_colors[:, :3] / 255, ball.colors, atol=0.003)


def test_area_and_volume_are_those_of_a_box():
    assert BOX.area == pytest.approx(22.0)
    assert BOX.volume == pytest.approx(6.0)
    assert BOX.closed
    assert not TriangleMesh(BOX.vertices, BOX.faces[1:]).closed
    assert not TriangleMesh(BOX.vertices, np.concatenate([BOX.faces[1:], BOX.faces[:1, ::-1]])).closed


def test_fewer_faces(ball):
    pytest.importorskip("fast_simplification", reason="the extra mesh is not installed")
    simplified = ball.simplified(300)
    assert len(simplified.faces) <= 300
    assert simplified.volume == pytest.approx(ball.volume, rel=0.03)
    assert simplified.colors[simplified.vertices[:, 0] > AT[0] + 0.3].mean(0) == pytest.approx(
        (0.9, 0.1, 0.1), abs=0.05
    )
    assert ball.simplified(10**6) is ball
    with pytest.raises(fs.InputError, match="--faces must be at least 4, got 3"):
        ball.simplified(3)


def room_of_triangles(step=0.1):
    """A room of 4 x 3 x 2 m without a ceiling, with a door of 1 x 2 m in a wall; normals point inside."""
    points, faces = [], []
    for origin, across, up in (
        ((0, 0, 0), (4, 0, 0), (0, 3, 0)),
        ((0, 0, 0), (0, 3, 0), (0, 0, 2)),
        ((4, 3, 0), (0, -3, 0), (0, 0, 2)),
        ((0, 3, 0), (4, 0, 0), (0, 0, 2)),
        ((4, 0, 0), (-4, 0, 0), (0, 0, 2)),
    ):
        n, m = (round(max(np.abs(side)) / step) for side in (across, up))
        u, v = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
        door = (tuple(origin) == (0, 3, 0)) & (u >= 15) & (u < 25)
        for i, j in zip(u[~door], v[~door], strict=True):
            corners = [
                np.add(origin, np.multiply(across, a / n)) + np.multiply(up, b / m)
                for a, b in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
            ]
            at = len(points)
            points += corners
            faces += [(at, at + 1, at + 2), (at, at + 2, at + 3)]
    vertices, index = np.unique(np.round(points, 6), axis=0, return_inverse=True)
    return TriangleMesh(vertices, index[np.array(faces)].astype(np.int32))


def test_convex_parts_of_a_room_leave_its_inside_free(tmp_path):
    """The walls and the floor collide, the room and its door do not, in MuJoCo."""
    mujoco = pytest.importorskip("mujoco", reason="the extra sim is not installed")
    file = tmp_path / "room.xml"
    parts = save_mesh(room_of_triangles(), file, 40)
    assert 6 <= len(parts) <= 40
    assert max(part.gaps.max() for part in parts) < 0.05
    assert [path.name for path in tmp_path.iterdir()] == ["room.xml"]
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    def free(origin, ray):
        hit = np.zeros(1, np.int32)
        return mujoco.mj_ray(model, data, np.array(origin, float), np.array(ray, float), None, 1, -1, hit)

    middle = (1.2, 1.1, 1.0)
    assert free(middle, (-1, 0, 0)) == pytest.approx(1.2, abs=0.05)
    assert free(middle, (1, 0, 0)) == pytest.approx(2.8, abs=0.05)
    assert free(middle, (0, -1, 0)) == pytest.approx(1.1, abs=0.05)
    assert free(middle, (0, 1, 0)) == pytest.approx(1.9, abs=0.05)
    assert free(middle, (0, 0, -1)) == pytest.approx(1.0, abs=0.05)
    assert free((2.0, 1.5, 1.0), (0, 1, 0)) == -1  # through the door
    few = save_mesh(room_of_triangles(), file, 3)
    assert len(few) == 3
    assert max(part.gaps.max() for part in few) > 0.5  # and the gaps say so


def test_a_ball_and_a_box_are_one_part(ball):
    box = trimesh.creation.box((0.2, 0.4, 1.0))
    for solid in (ball, TriangleMesh(box.vertices + 7, box.faces.astype(np.int32))):
        (part,) = convex_parts(solid.vertices, solid.faces, 1)
        assert part.gaps.max() < 0.03 * np.ptp(solid.vertices, axis=0).max()
        np.testing.assert_allclose(np.ptp(part.vertices, axis=0), np.ptp(solid.vertices, axis=0), rtol=0.05)


def test_convex_parts_collide_in_mujoco(tmp_path):
    """A box that falls on the lower arm of an L rests on it."""
    mujoco = pytest.importorskip("mujoco", reason="the extra sim is not installed")
    tall, low = trimesh.creation.box((0.2, 0.4, 1.0)), trimesh.creation.box((0.8, 0.4, 0.2))
    low.apply_translation((0.5, 0.0, -0.4))
    both = trimesh.util.concatenate([tall, low])
    arms = TriangleMesh(both.vertices, both.faces.astype(np.int32))
    assert len(save_mesh(arms, tmp_path / "l.xml")) == 2
    spec = mujoco.MjSpec.from_file(str(tmp_path / "l.xml"))
    body = spec.worldbody.add_body(pos=[0.5, 0, 0.5])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.1])
    model = spec.compile()
    data = mujoco.MjData(model)
    while data.time < 1.0:
        mujoco.mj_step(model, data)
    assert data.body(2).xpos[2] == pytest.approx(-0.2, abs=0.02)


def test_the_command_writes_a_mesh(tmp_path, capsys):
    view = fs.Camera.look_at(96, 72, 1.0, (0, 0, 0), (0, 0, 1))
    fs.Scene([plane((0.0, 0.0, 2.0), (0.0, 0.0, -1.0), 0.5)], camera=view).save(tmp_path / "wall.toml")
    (tmp_path / "path.tum").write_text("0 0 0 0 0 0 0 1\n1 0.2 0 0 0 0 0 1\n")
    words = ["convert", tmp_path / "wall.toml", tmp_path / "wall.stl", "--mesh", "--voxel", "0.05"]
    facts = prints_json(capsys, *words, "--cameras", tmp_path / "path.tum")
    assert facts["target"] == str(tmp_path / "wall.stl")
    again = trimesh.load(tmp_path / "wall.stl")
    assert facts["area_m2"] == pytest.approx(again.area, rel=1e-4)
    assert np.abs(again.vertices[:, 2] - 2.0).max() < 0.025
    assert "already exists" in fails(capsys, *words)[1]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a.glb", "--voxel", "0.1"], "must be given with --mesh, got none"),
        (["a.spz", "--mesh"], "the suffix of a mesh must be .glb"),
        (["a.glb", "--mesh", "--voxel", "-1"], "voxel must be a positive length in metres, got -1"),
        (["a.glb", "--mesh", "--voxel", "1e-9"], "voxel must be at least"),
        (["a.glb", "--mesh", "--cameras", "none.tum"], "none.tum"),
        (["a.glb", "--mesh", "--parts", "0"], "--parts must be at least 1"),
    ],
)
def test_invalid_options_are_reported(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    fs.save_ply(plane((0.0, 0.0, 2.0), (0.0, 0.0, -1.0), 0.5), "wall.ply")
    assert message in fails(capsys, "convert", "wall.ply", *words)[1]
