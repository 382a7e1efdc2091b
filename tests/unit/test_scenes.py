"""Scenes: merging, scene files as the contract shows them, saving and loading again."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import fidsplat as fs
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.rotations import rigid_matrix

F32 = np.float32


def cloud_of(n=5, seed=0, **changes):
    r = np.random.default_rng(seed)
    fields = {
        "means": r.normal(size=(n, 3)).astype(F32),
        "quats": r.normal(size=(n, 4)).astype(F32),
        "scales": r.uniform(0.1, 1, (n, 2)).astype(F32),
        "opacities": r.random(n, dtype=F32),
        "sh": r.normal(size=(n, 4, 3)).astype(F32),
    }
    return fs.SplatCloud(**fields | changes)


def fake_marker(
    spec,
    size=1.0,
    mixture=None,
    quiet_zone=None,
    quality=None,
    max_splats=1_000_000,
    progress=None,
    **changes,
):
    """A minimal marker without partitioning: two splats and four corners."""
    if "unknown" in spec:
        raise fs.InputError(f"unknown spec {spec!r}")
    settings = replace(quality or fs.MarkerQuality(), **changes | ({"mixture": mixture} if mixture else {}))
    cloud = fs.SplatCloud(
        [[-size, 0, 0], [size, 0, 0]],
        [[1, 0, 0, 0]] * 2,
        [[size, size]] * 2,
        [1, 1],
        colors=[[0, 0, 0], [1, 1, 1]],
    )
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * size / 2
    quiet_zone = 1 if quiet_zone is None else quiet_zone
    return SimpleNamespace(
        spec=spec,
        size=size,
        mixture=settings.mixture,
        quality=settings,
        quiet_zone=quiet_zone,
        max_splats=max_splats,
        inks=None,
        shape=None,
        wear=None,
        cloud=cloud,
        corners=corners,
    )


@pytest.fixture(autouse=True)
def _fake_markers(monkeypatch):
    monkeypatch.setattr("fidsplat.markers.marker", fake_marker, raising=False)


CONTRACT = """
[camera]
width = 1280
height = 720
fov_x_deg = 60.0
position = [0.0, 0.0, -1.0]
look_at = [0.0, 0.0, 0.0]

[[splats]]
file = "greenhouse.ply"

[[markers]]
spec = "apriltag:36h11:5"
size = 0.16
position = [0.2, 0.0, 0.5]
quaternion = [1.0, 0.0, 0.0, 0.0]

[render]
outputs = ["rgb", "depth"]
background = [0.0, 0.0, 0.0]
"""


@pytest.fixture
def load(tmp_path):
    fs.save_ply(cloud_of(), tmp_path / "greenhouse.ply")

    def from_text(text):
        (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
        return fs.Scene.load(tmp_path / "scene.toml")

    return from_text


def test_the_contracts_scene(load):
    scene = load(CONTRACT)
    camera = scene.camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (1280, 720, 640, 360)
    assert camera.fx == camera.fy == pytest.approx(640 / math.tan(math.radians(30)))
    np.testing.assert_allclose(camera.position, [0, 0, -1])
    assert (scene.outputs, scene.background, scene.quality, scene.device) == (
        ("rgb", "depth"),
        (0, 0, 0),
        None,
        None,
    )
    assert len(scene.clouds) == 1
    assert np.array_equal(scene.clouds[0].means, cloud_of().means)
    (placed,) = scene.markers
    assert (placed.label, placed.marker.spec, placed.marker.size) == (1, "apriltag:36h11:5", 0.16)
    np.testing.assert_allclose(placed.corners[0], [0.12, -0.08, 0.5])
    assert scene.cloud().labels.tolist() == [0] * 5 + [1] * 2


def test_all_keys_of_a_scene_file(load):
    scene = load("""
        markers = [{spec = "qr:a", size = 2, mixture = "paper", quiet_zone = 0}, {spec = "qr:b", size = 1}]
        [camera]
        width = 101
        height = 55
        fx = 80
        fy = 81.5
        cx = -3.5
        cy = 200
        near = 0.5
        far = inf
        world_to_camera = [[1, 0, 0, 0.5], [0, 0, -1, 0], [0, 1, 0, 3], [0, 0, 0, 1]]
        [[splats]]
        file = "greenhouse.ply"
        position = [1, 2, 3]
        quaternion = [0, 0, 3, 0]
        scale = 2
        [[splats]]
        file = "./greenhouse.ply"
        [render]
        outputs = ["rgb"]
        background = [1, 0.5, 0]
        quality = "fast"
        samples = 2
        lowpass = "pixel"
        first_hit = 0.25
        device = "reference"
    """)
    camera = scene.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.near) == (80, 81.5, -3.5, 200, 0.5)
    assert camera.world_to_camera[:, 3].tolist() == [0.5, 0, 3, 1]
    base = cloud_of().means
    np.testing.assert_allclose(scene.clouds[0].means, base * [-2, 2, -2] + [1, 2, 3], atol=1e-6)
    assert np.array_equal(scene.clouds[1].means, base)
    assert [(m.label, m.marker.mixture, m.marker.quiet_zone) for m in scene.markers] == [
        (1, "paper", 0),
        (2, "exact", 1),
    ]
    expected = fs.Quality.named("fast").with_(samples=2, lowpass="pixel", first_hit=0.25)
    assert fs.Quality.of(scene.quality) == expected
    assert (scene.background, scene.device) == ((1, 0.5, 0), "reference")
    assert scene.cloud().labels.tolist() == [0] * 10 + [1, 1, 2, 2]


def test_an_empty_file_is_an_empty_scene(load):
    scene = load("")
    assert (scene.camera, scene.clouds, scene.markers, scene.outputs) == (None, (), (), ("rgb",))
    assert len(scene.cloud()) == 0


def test_an_empty_cloud_is_a_scene(tmp_path, load):
    fs.save_ply(fs.SplatCloud.empty(), tmp_path / "empty.ply")
    assert len(load('[[splats]]\nfile = "empty.ply"\nscale = 2.0').cloud()) == 0


def test_images_of_markers_are_relative_to_the_scene_file(load, tmp_path):
    scene = load('[[markers]]\nspec = "image:art/tag.png"\nsize = 1.0')
    assert scene.markers[0].marker.spec == f"image:{tmp_path / 'art' / 'tag.png'}"
    (tmp_path / "deep").mkdir()
    scene.save(tmp_path / "deep" / "b.toml")
    assert 'spec = "image:../art/tag.png"' in (tmp_path / "deep" / "b.toml").read_text()


def test_merging_keeps_the_clouds_labels_and_numbers_the_markers():
    marker = fake_marker("qr:x", 0.5)
    scene = fs.Scene(
        [cloud_of(labels=9), cloud_of(2, 1)],
        markers=[PlacedMarker(marker, label=7), PlacedMarker(marker, rigid_matrix([1e6, 0, 0]))],
    )
    assert [m.label for m in scene.markers] == [1, 2]
    cloud = scene.cloud()
    assert cloud.labels.tolist() == [9] * 5 + [0, 0] + [1, 1, 2, 2]
    assert (cloud.sh_degree, cloud is scene.cloud()) == (1, True)
    np.testing.assert_allclose(cloud.world_means()[-2:, 0], [1e6 - 0.5, 1e6 + 0.5], atol=0.07)


def test_a_placed_markers_cloud_is_its_own():
    far = PlacedMarker(fake_marker("qr:x", 0.5), rigid_matrix([1e6, 0, 0]), 4).cloud()
    assert far.labels.tolist() == [4, 4]
    np.testing.assert_allclose(far.world_means()[:, 0], [1e6 - 0.5, 1e6 + 0.5], atol=1e-6)


@given(
    seed=st.integers(0, 2**32 - 1),
    turn=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    move=st.tuples(*[st.floats(-100, 100)] * 3),
    size=st.floats(1e-3, 1e3),
    text=st.text(st.characters(codec="utf-8"), max_size=20),
    quality=st.sampled_from([None, "fast", "gsplat", fs.Quality.named("surfel").with_(samples=3)]),
    origin=st.sampled_from([None, (5e5, 4.5e6, 300.0)]),
)
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_saving_and_loading(tmp_path, seed, turn, move, size, text, quality, origin):
    pose = rigid_matrix(move, turn)
    camera = fs.Camera.pinhole(33, 77, 50.1, 60.2, 1 / 3, 40.0, np.linalg.inv(pose), near=0.3)
    marker = fake_marker("qr:" + text + '"\\\x7f\n', size, "paper", 3)
    scene = fs.Scene(
        [cloud_of(4, seed, labels=range(4), origin=origin), cloud_of(3, seed)],
        camera=camera,
        markers=[PlacedMarker(marker, pose)],
        background=(0.1, 0.2, 1 / 3),
        outputs=("rgb", "label"),
        quality=quality,
        device="opencl:pocl",
    )
    scene.save(tmp_path / "a.toml")
    again = fs.Scene.load(tmp_path / "a.toml")
    for name in ("width", "height", "fx", "fy", "cx", "cy", "near", "far"):
        assert getattr(again.camera, name) == getattr(camera, name)
    assert np.array_equal(again.camera.world_to_camera, camera.world_to_camera)
    assert (again.background, again.outputs, again.device) == (scene.background, scene.outputs, scene.device)
    assert again.quality == quality
    old, new = marker, again.markers[0].marker
    assert (new.spec, new.size, new.mixture, new.quiet_zone) == (
        old.spec,
        old.size,
        old.mixture,
        old.quiet_zone,
    )
    np.testing.assert_allclose(again.markers[0].pose, pose, atol=1e-14)
    for a, b in zip(again.clouds, scene.clouds, strict=True):
        assert np.array_equal(a.means, b.means)
        assert np.array_equal(a.origin, b.origin)
        assert np.array_equal(a.labels, b.labels)
        assert np.array_equal(a.sh, b.sh)


def test_files_of_a_saved_scene(tmp_path):
    fs.Scene([cloud_of(), cloud_of(2, 1)]).save(tmp_path / "lab.toml")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["lab-splats-0.ply", "lab-splats-1.ply", "lab.toml"]
    loaded = fs.Scene.load(tmp_path / "lab.toml")
    loaded.save(tmp_path / "lab.toml")
    assert len(fs.Scene.load(tmp_path / "lab.toml").cloud()) == 7


BETWEEN = fs.Quality(
    alpha_cutoff=0.123,
    samples=2,
    arithmetic="precise",
    marker=fs.MarkerQuality("paper", levels=3, growth=0.25),
)


@pytest.mark.parametrize("quality", [BETWEEN, "fast,samples=2,marker.template=9"])
def test_a_quality_other_than_presets_is_saved(tmp_path, quality):
    fs.Scene(quality=quality).save(tmp_path / "a.toml")
    assert fs.Scene.load(tmp_path / "a.toml").quality == quality


@pytest.mark.parametrize("quality", [None, BETWEEN])
@pytest.mark.parametrize(
    "marker",
    [
        fs.MarkerQuality(),
        fs.MarkerQuality("fitted"),
        fs.MarkerQuality("fitted", template=9, growth=0.1),
        fs.MarkerQuality("paper", 2, 1, 0.5),
    ],
)
def test_markers_are_saved_as_they_were_made(tmp_path, marker, quality):
    placed = PlacedMarker(fake_marker("qr:a", quality=marker))
    fs.Scene(markers=[placed], quality=quality).save(tmp_path / "a.toml")
    again = fs.Scene.load(tmp_path / "a.toml").markers[0].marker.quality
    if marker.mixture == "paper":
        assert replace(again, template=marker.template) == marker
    else:
        assert (again.mixture, again.template) == (marker.mixture, marker.template)
    if marker.mixture == "fitted":
        assert again.growth in (marker.growth, 0.4)  # which the fitted templates were made with


def test_the_splat_limit_of_a_marker_is_saved(tmp_path):
    allowed = [1_000_000, 5_000_000]
    markers = [PlacedMarker(fake_marker("qr:a", max_splats=most)) for most in allowed]
    fs.Scene(markers=markers).save(tmp_path / "a.toml")
    assert (tmp_path / "a.toml").read_text().count("max_splats") == 1
    again = fs.Scene.load(tmp_path / "a.toml").markers
    assert [placed.marker.max_splats for placed in again] == allowed


def test_quality_settings_of_a_scene_file(tmp_path):
    file = tmp_path / "a.toml"
    file.write_text(
        """
        markers = [{spec = "qr:a", size = 1}, {spec = "qr:b", size = 1, template = 5}]
        [quality]
        preset = "fast"
        alpha_cutoff = 1e-3
        [quality.marker]
        template = 9
        """
    )
    scene = fs.Scene.load(file)
    assert scene.quality == fs.Quality.of("fast,alpha_cutoff=1e-3,marker.template=9")
    assert [placed.marker.quality.template for placed in scene.markers] == [9, 5]
    other = fs.Scene.load(file, "marker.template=13")
    assert [placed.marker.quality.template for placed in other.markers] == [13, 5]
    assert fs.Quality.of(other.quality).alpha_cutoff == fs.Quality().alpha_cutoff


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[quality]\npreset = 'fats'", "quality.preset: unknown quality 'fats'"),
        ("[quality]\nalpha_cutof = 1", "unknown key 'quality.alpha_cutof' (did you mean 'alpha_cutoff'"),
        ("[quality]\nalpha_cutoff = 2", "a.toml: quality: alpha_cutoff must be in (0, 1), got 2.0"),
        ("[quality]\nsamples = 'big'", "quality.samples must be a whole number"),
        (
            "[quality.marker]\ntemplate = 4",
            "quality: marker quality: template must be one of 1, 5, 9, 13, 25, 41,",
        ),
        (
            "[render]\nsamples = 2\n[quality]\npreset = 'fast'",
            "render.samples and the table [quality] exclude",
        ),
        (
            "markers = [{spec = 'qr:a', size = 1, template = 4}]",
            "markers[0]: marker quality: template must be one of 1, 5, 9, 13, 25,",
        ),
    ],
)
def test_invalid_quality_settings_of_a_scene_file(tmp_path, text, says):
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(fs.InputError) as caught:
        fs.Scene.load(tmp_path / "a.toml")
    assert says in str(caught.value)


def test_text_that_is_not_unicode_cannot_be_saved(tmp_path):
    with pytest.raises(fs.InputError, match="not Unicode"):
        fs.Scene(markers=[PlacedMarker(fake_marker("qr:\ud800"))]).save(tmp_path / "a.toml")


def test_a_folder_that_cannot_be_written(tmp_path):
    with pytest.raises(fs.InputError, match="cannot write"):
        fs.Scene([cloud_of()]).save(tmp_path / "missing" / "a.toml")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"clouds": [1]}, "clouds must be a list of SplatCloud, got 1"),
        ({"clouds": 1}, "clouds must be a list of SplatCloud, got 1"),
        (
            {"clouds": cloud_of()},
            r"a list of SplatCloud, got SplatCloud\(.*; put it into a list",
        ),
        (
            {"markers": [fs.marker("apriltag:36h11:5", 0.1)]},
            r"PlacedMarker, got .*; write markers=\[PlacedMarker\(marker",
        ),
        (
            {"clouds": fs.marker("apriltag:36h11:5", 0.1)},
            r"SplatCloud, got .*; write markers=\[PlacedMarker\(marker",
        ),
        ({"clouds": "room.toml"}, "SplatCloud, got 'room.toml'; Scene.load reads a scene file"),
        ({"camera": "front"}, "camera must be a Camera"),
        ({"background": (0, 0)}, "background must be three"),
        ({"background": (0, 0, math.nan)}, "background must be three"),
        ({"background": "black"}, "background must be three"),
        ({"outputs": ()}, r"outputs must have at least one name, e.g. 'rgb', got none"),
        ({"outputs": (1,)}, "outputs must be one or more names"),
    ],
)
def test_fields_of_the_wrong_type(arguments, words):
    with pytest.raises(fs.InputError, match=words):
        fs.Scene(**arguments)


def test_a_pose_must_be_rigid():
    with pytest.raises(fs.InputError, match="a marker's pose must be rigid"):
        PlacedMarker(fake_marker("qr:x"), np.diag([2.0, 2, 2, 1]))
