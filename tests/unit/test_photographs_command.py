"""`fidsplat capture` on small photographs of two textured walls with two tags, whose cameras are known."""

import contextlib
import shutil
import sqlite3
from itertools import combinations

import cv2
import numpy as np
import pytest
from command_line import fails, prints_json

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.images.files import read_image
from fidsplat.photographs.mapping import match
from fidsplat.train import load_dataset

pycolmap = pytest.importorskip(
    "pycolmap", reason="pycolmap finds the cameras of photographs; pip install pycolmap"
)

PER_METRE = 300
TAGS = {"apriltag:36h11:5": (0.5, 0.5), "apriltag:36h11:9": (1.2, 0.7)}
"""centres on the wall, metres from its upper left corner"""
SIZE = 0.2
ARGUMENTS = [word for tag in TAGS for word in ("--tag", f"{tag}={SIZE}")]


def walls():
    """Textures (h, w, 3) of two walls of 1.6 x 1.2 m at a right angle, and their world from metres (4, 4)."""
    rng = np.random.default_rng(3)
    textures = []
    for _ in range(2):
        fine, coarse = (
            cv2.resize(
                rng.integers(0, 255, (n * 3, n * 4, 3), np.uint8), (480, 360), interpolation=cv2.INTER_CUBIC
            )
            for n in (24, 8)
        )
        textures.append(cv2.addWeighted(fine, 0.5, coarse, 0.5, 0))
    for tag, (x, y) in TAGS.items():
        bits = np.pad(fs.marker(tag).bits, 1)
        edge = round(SIZE * PER_METRE / 8 * 10)
        modules = cv2.resize(
            np.where(bits, 0, 255).astype(np.uint8), (edge, edge), interpolation=cv2.INTER_NEAREST
        )
        top, left = (round(v * PER_METRE - edge / 2) for v in (y, x))
        textures[0][top : top + edge, left : left + edge] = modules[..., None]
    # x right, y down; the second wall continues the first one towards the cameras
    second = np.array([[0, 0, 1, 1.6], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])
    return list(zip(textures, (np.eye(4), second), strict=True))


def cameras(count=5):
    rng = np.random.default_rng(1)
    for share in np.linspace(0, 1, count):
        position = np.array([0.3 + 1.0 * share, 0.5, -1.4]) + rng.normal(0, 0.1, 3)
        pose = fs.Camera.look_at(320, 240, 1.0, position, (1.0, 0.6, -0.1)).world_to_camera
        yield fs.Camera.pinhole(320, 240, 290, 291, 160, 120, pose)


def photograph(camera):
    image = np.zeros((240, 320, 3), np.uint8)
    for texture, wall in walls():
        plane = (camera.world_to_camera @ wall)[:3][:, [0, 1, 3]] @ np.diag([1 / PER_METRE, 1 / PER_METRE, 1])
        to_pixels = camera.matrix @ plane
        # OpenCV counts from the centre of the first pixel
        shift = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
        matrix = shift @ to_pixels @ np.linalg.inv(shift)
        part = cv2.warpPerspective(texture, matrix, (320, 240), flags=cv2.INTER_AREA)
        inside = cv2.warpPerspective(np.full(texture.shape[:2], 255, np.uint8), matrix, (320, 240)) > 127
        image[inside] = part[inside]
    return image


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    for i, camera in enumerate(cameras()):
        cv2.imwrite(str(folder / f"view {i}.png"), photograph(camera))
    return folder


@pytest.fixture(scope="module")
def captured(photos, tmp_path_factory):
    out = tmp_path_factory.mktemp("scene")
    words = [photos, "-o", out, *ARGUMENTS, "--up", "apriltag:36h11:9"]
    assert main(["capture", *map(str, words)]) == 0
    return out, words


def test_photographs_become_a_metric_data_set(captured, capsys):
    out, words = captured
    facts = prints_json(capsys, "capture", *words)
    assert (facts["registered"], facts["missing"]) == (5, {})
    assert facts["corner_rms_px"] < 0.4
    known = {f"view_{i}.png": camera for i, camera in enumerate(cameras())}
    loaded = fs.load_cameras(out / "sparse" / "0")
    assert loaded.keys() == known.keys()
    # distances between cameras, in metres
    lengths = [
        [np.linalg.norm(each["view_0.png"].position - each[f"view_{i}.png"].position) for i in (2, 3, 4)]
        for each in (loaded, known)
    ]
    np.testing.assert_allclose(*lengths, rtol=0.01)
    markers = fs.Scene.load(without_splats(out)).markers
    assert [tag.marker.spec for tag in markers] == list(TAGS)
    # the tag of --up is upright at the origin; x points right along the wall and y into it
    np.testing.assert_allclose(markers[1].pose[:3, :3], [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
    np.testing.assert_allclose(markers[1].pose[:3, 3], 0, atol=1e-12)
    np.testing.assert_allclose(markers[0].pose[:3, 3], (-0.7, 0, 0.2), atol=0.01)
    # other photographs are localised with the lens of these
    photographed = fs.Scene.load(without_splats(out, "photographs.toml")).camera
    assert (photographed.width, photographed.height) == (320, 240)
    assert photographed.lens is not None
    assert (
        abs(photographed.project([[-0.7, 0, 0.2]]) - loaded["view_0.png"].project([[-0.7, 0, 0.2]])).max() < 2
    )
    black, white = markers[0].marker.inks
    assert max(black) < 0.1 < 0.9 < min(white)


def without_splats(folder, name="scene.toml"):
    """The scene before training, in a file that names no splats."""
    file = folder / "tags.toml"
    file.write_text((folder / name).read_text().partition("[[splats]]")[0])
    return file


def test_training_reads_the_data_set_without_the_tags(captured):
    out, _ = captured
    dataset = load_dataset(out)
    assert len(dataset.views) == 5
    tags = fs.Scene.load(without_splats(out)).markers
    assert {view.background for view in dataset.views} == {(0, 0, 0), (1, 1, 1)}
    for view in dataset.views:
        for tag in tags:
            x, y = view.camera.project(tag.pose[None, :3, 3])[0].astype(int)
            # in place of the tag the image has the background's colour
            np.testing.assert_array_equal(view.image[y, x], np.multiply(view.background, 255))
            assert view.mask[y, x]
            # the masks for other trainers exclude it
            assert not read_image(out / "masks" / f"{view.name}.png")[y, x].any()
        assert view.mask.mean() > 0.9
    # neither initial points nor trained splats are in the tags
    assert len(dataset.boxes) == 2
    for tag, box in zip(tags, dataset.boxes, strict=True):
        np.testing.assert_allclose(box[:3, 3], tag.pose[:3, 3], atol=1e-12)
        assert not (np.linalg.norm(dataset.points - tag.pose[:3, 3], axis=1) < 0.02).any()
    file = out / "dataset.json"
    notes = file.read_text()
    file.write_text('{"boxes": [[1, 2]]}')
    with pytest.raises(fs.InputError, match=r'boxes of .* must be a list of ."matrix": invertible'):
        load_dataset(out)
    file.write_text(notes)


def test_the_same_command_resumes_with_other_tags(captured, capsys):
    out, words = captured
    before = (out / "work" / "model" / "images.bin").stat().st_mtime_ns
    (out / "images" / "mine.txt").write_text("mine")
    half = [word.replace("=0.2", "=0.1") if isinstance(word, str) else word for word in words]
    facts = prints_json(capsys, "capture", *half)
    assert (out / "work" / "model" / "images.bin").stat().st_mtime_ns == before
    assert (out / "images" / "mine.txt").read_text() == "mine"
    (out / "images" / "mine.txt").unlink()
    markers = fs.Scene.load(without_splats(out)).markers
    np.testing.assert_allclose(markers[0].pose[:3, 3], (-0.35, 0, 0.1), atol=0.005)
    assert facts["tags"].keys() == TAGS.keys()
    wrong = [word.replace("5=0.1", "5=0.2") if isinstance(word, str) else word for word in half]
    status, message = fails(capsys, "capture", *wrong)
    assert status == 2
    assert "sizes of tags must agree" in message


def test_too_few_or_unrelated_photographs_are_one_clear_line(photos, captured, tmp_path, capsys):
    two, unrelated = tmp_path / "two", tmp_path / "unrelated"
    rng = np.random.default_rng(0)
    for folder in (two, unrelated):
        folder.mkdir()
    for i in range(3):
        noise = cv2.resize(rng.integers(0, 255, (12, 16, 3), np.uint8), (160, 120))
        cv2.imwrite(str(unrelated / f"{i}.png"), noise)
        if i < 2:
            cv2.imwrite(str(two / f"{i}.png"), noise)
    status, message = fails(capsys, "capture", two, "-o", tmp_path / "a")
    assert (status, "at least 3 photographs, got 2" in message) == (2, True)
    status, message = fails(capsys, "capture", unrelated, "-o", tmp_path / "b")
    assert status == 2
    assert "photographs must overlap" in message
    assert "0.png: " in message
    status, message = fails(capsys, "capture", unrelated, "-o", captured[0])
    assert (status, "of the same photographs" in message) == (2, True)
    words = "--scale", "View 1.PNG:100:100,view 9.png:100:100=1"
    status, message = fails(capsys, "capture", photos, "-o", tmp_path / "c", *words)
    assert (status, "unknown photograph of --scale 'view 9.png'" in message) == (2, True)
    assert not (tmp_path / "c").exists()
    words = captured[1][1:-1], "--tag", "qr:a=0.1", "--up", "qr:a"
    status, message = fails(capsys, "capture", photos, *words[0][:-1], *words[1:])
    assert (status, f"detected are {', '.join(TAGS)}" in message) == (2, True)
    status, message = fails(capsys, "capture", photos, "-o", tmp_path / "c", "--up", "qr:a")
    assert (status, "--up must be a tag of --tag" in message) == (2, True)


def test_the_scale_of_picked_pixels_has_an_error_and_the_next_command_is_quoted(photos, tmp_path, capsys):
    out, length = tmp_path / "my bench", 0.7
    camera = list(cameras())[2]
    wall = np.array([[0.6, 0.85, 0], [0.6 + length, 0.85, 0]])
    (x, y), (u, v) = camera.project(wall)
    words = ["--scale", f"view 2.png:{x}:{y},view 2.png:{u}:{v}={length}"]
    facts = prints_json(capsys, "capture", photos, "-o", out, *words)
    assert facts["metric"]
    assert facts["scale_standard_error"] < 0.01
    known = list(cameras())
    loaded = fs.load_cameras(out / "sparse" / "0")
    apart = np.linalg.norm(loaded["view_0.png"].position - loaded["view_4.png"].position)
    true = np.linalg.norm(known[0].position - known[4].position)
    assert apart == pytest.approx(true, rel=0.01)
    assert main(["capture", *map(str, (photos, "-o", out, *ARGUMENTS))]) == 0
    assert f"fidsplat train '{out}'" in " ".join(capsys.readouterr().out.split())
    sizes = [word.replace("5=0.2", "5=0.206") for word in ARGUMENTS]
    assert main(["capture", *map(str, (photos, "-o", out, *sizes))]) == 0
    assert "disagree by" in capsys.readouterr().out


def test_a_capture_that_was_interrupted_at_its_start_resumes(photos, tmp_path, capsys):
    (tmp_path / "out" / "work").mkdir(parents=True)
    assert prints_json(capsys, "capture", photos, "-o", tmp_path / "out")["registered"] == 5


def test_edited_scene_files_and_splats_of_other_poses_are_renamed(photos, captured, tmp_path, capsys):
    out = tmp_path / "out"
    shutil.copytree(captured[0], out)
    words = [photos, "-o", out, *ARGUMENTS, "--up", "apriltag:36h11:9"]
    prints_json(capsys, "capture", *words)
    edited = (
        (out / "scene.toml").read_text().replace("background = [0.0, 0.0, 0.0]", "background = [1.0, 0, 0]")
    )
    (out / "scene.toml").write_text(edited)
    (out / "splats.ply").write_text("mine")
    assert main(["capture", *map(str, words)]) == 0  # with the same result
    assert "view it: " in (printed := capsys.readouterr().out)
    assert "train" not in printed
    assert (out / "scene.toml").read_text() == edited
    assert (out / "splats.ply").read_text() == "mine"
    for end in ("old", "old2"):
        words = [
            word.replace("=0.2", "=0.1" if end == "old" else "=0.3") if isinstance(word, str) else word
            for word in words
        ]
        (out / "scene.toml").write_text(edited)
        (out / "splats.ply").write_text(end)
        assert main(["capture", *map(str, words)]) == 0
        printed = " ".join(capsys.readouterr().out.split())
        assert f"scene.toml was edited and is now scene.{end}.toml" in printed
        assert f"splats.ply was trained at other poses and is now splats.{end}.ply" in printed
        assert (out / f"scene.{end}.toml").read_text() == edited
        assert (out / f"splats.{end}.ply").read_text() == end
        assert not (out / "splats.ply").exists()
        assert "background = [0.0, 0.0, 0.0]" in (out / "scene.toml").read_text()
        words = [word.replace("=0.1", "=0.2") if isinstance(word, str) else word for word in words]


def test_only_folders_of_an_earlier_capture_are_replaced(photos, tmp_path, capsys):
    garden = tmp_path / "garden"
    shutil.copytree(photos, garden / "images")
    before = {file: file.read_bytes() for file in (garden / "images").iterdir()}
    for more in ([], ["--overwrite"]):
        status, message = fails(capsys, "capture", garden / "images", "-o", garden, *more)
        assert (status, "photographs must be outside of" in message) == (2, True)
    (tmp_path / "link").symlink_to(garden / "images")
    status, message = fails(capsys, "capture", tmp_path / "link", "-o", garden, "--overwrite")
    assert (status, "photographs must be outside of" in message) == (2, True)
    status, message = fails(capsys, "capture", photos, "-o", garden)
    assert (status, "got images of something else" in message) == (2, True)
    assert before == {file: file.read_bytes() for file in garden.rglob("*") if file.is_file()}
    for name in ("masks/mine.png", "work/photos/mine.txt", "scene.toml"):
        file = tmp_path / name.replace("/", "-") / name
        file.parent.mkdir(parents=True)
        file.write_text("mine")
        status, message = fails(capsys, "capture", photos, "-o", tmp_path / name.replace("/", "-"))
        assert (status, "of something else; give another folder" in message) == (2, True)
        assert file.read_text() == "mine"


@pytest.mark.parametrize(
    ("damaged", "length"),
    [
        ("inputs.json", 0),
        ("database.db", 100),
        ("model/images.bin", 100),
        ("model/images.bin", None),
        ("photos/view_3.png", 0),
        ("photos/view_3.png", None),
    ],
)
def test_a_damaged_work_folder_is_one_clear_line(damaged, length, captured, photos, tmp_path, capsys):
    shutil.copytree(captured[0] / "work", tmp_path / "work")
    file = tmp_path / "work" / damaged
    if length is None:
        file.unlink()
    else:
        file.write_bytes(file.read_bytes()[:length])
    status, message = fails(capsys, "capture", photos, "-o", tmp_path)
    assert (status, "work is damaged" in message, "--overwrite restarts" in message) == (2, True, True)


def test_damaged_photographs_are_skipped_unless_too_few_are_left(photos, tmp_path, capsys):
    copies = tmp_path / "copies"
    shutil.copytree(photos, copies)
    files = [copies / f"view {i}.png" for i in range(5)]
    for file in (files[0], copies / "notes.jpg"):
        file.write_bytes(files[0].read_bytes()[:1000])
    (copies / "notes.jpg").write_text("mine")
    for _ in range(2):  # also when it resumes
        facts = prints_json(capsys, "capture", copies, "-o", tmp_path / "out", *ARGUMENTS)
        assert (facts["photographs"], facts["registered"]) == (6, 4)
        assert facts["missing"].keys() == {"view 0.png", "notes.jpg"}
        assert f"cannot read {files[0]}" in facts["missing"]["view 0.png"]
    for file in files[1:3]:
        file.write_bytes(file.read_bytes()[:1000])
    status, message = fails(capsys, "capture", copies, "-o", tmp_path / "few")
    assert (status, "photographs that can be read, got 2 of 6: cannot read" in message) == (2, True)
    files[2].write_bytes((photos / files[2].name).read_bytes())
    assert prints_json(capsys, "capture", copies, "-o", tmp_path / "few")["photographs"] == 6


def test_photographs_of_other_formats_and_in_subfolders_are_named(photos, tmp_path, capsys):
    phone = tmp_path / "phone"
    shutil.copytree(photos, phone / "album")
    for i in range(2):
        (phone / f"IMG_{i}.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    status, message = fails(capsys, "capture", phone, "-o", tmp_path / "out")
    assert (status, "put the photographs of its subfolders into one folder" in message) == (2, True)
    for file in (phone / "album").iterdir():
        file.rename(phone / file.name)
    facts = prints_json(capsys, "capture", phone, "-o", tmp_path / "out")
    assert (facts["photographs"], facts["registered"]) == (7, 5)
    assert facts["missing"]["IMG_0.HEIC"].endswith("IMG_0.HEIC as an image; convert it to JPEG")


def test_each_camera_of_the_photographs_has_a_scene_file(photos, tmp_path, capsys):
    mixed, out = tmp_path / "mixed", tmp_path / "out"
    mixed.mkdir()
    for i in range(5):
        image = cv2.imread(str(photos / f"view {i}.png"))
        cv2.imwrite(str(mixed / f"{i}.png"), np.ascontiguousarray(np.rot90(image)) if i == 0 else image)
    facts = prints_json(capsys, "capture", mixed, "-o", out, *ARGUMENTS)
    assert facts["registered"] == 5
    expected = {"photographs.toml": (320, 240), "photographs-2.toml": (240, 320)}
    assert [each["photographs"] for each in facts["cameras"]] == [4, 1]
    for name, size in expected.items():
        camera = fs.Scene.load(without_splats(out, name)).camera
        assert (camera.width, camera.height) == size
    assert main(["capture", *map(str, (mixed, "-o", out, *ARGUMENTS))]) == 0
    assert "photographs-2.toml: 240 x 320" in " ".join(capsys.readouterr().out.split())
    prints_json(capsys, "capture", photos, "-o", out, *ARGUMENTS, "--overwrite")
    assert not (out / "photographs-2.toml").exists()


def test_the_verification_of_matches_does_not_depend_on_earlier_pairs(tmp_path):
    """RANSAC has the same seed for each pair, so that the same photographs have the same matches."""
    rng, file, counts = np.random.default_rng(0), tmp_path / "database.db", []
    points = rng.uniform(-1, 1, (60, 3))
    with pycolmap.Database.open(file) as data:
        pinhole = {"model": "PINHOLE", "width": 640, "height": 480, "params": [500, 500, 320, 240]}
        camera = data.write_camera(pycolmap.Camera(**pinhole))
        for i in range(4):
            pixels = fs.Camera.look_at(640, 480, 1.0, (i / 2, 0, -4), (0, 0, 0)).project(points)
            image = data.write_image(pycolmap.Image(name=f"{i}.png", camera_id=camera))
            data.write_keypoints(image, (pixels + rng.normal(0, 2, (60, 2))).astype(np.float32))
        order = np.r_[:40, 59:39:-1]  # a third of the matches is wrong
        for pair in combinations(range(1, 5), 2):
            data.write_matches(*pair, np.stack([np.arange(60), order], 1).astype(np.uint32))
    for _ in range(2):
        match(file, False, lambda step, fraction: None)
        with contextlib.closing(sqlite3.connect(file)) as data:
            counts.append(data.execute("select pair_id, rows from two_view_geometries order by 1").fetchall())
            data.executescript("delete from two_view_geometries where pair_id % 2")  # 4 of 6
    assert len(counts[0]) == 6
    assert counts[0] == counts[1]


def test_a_rolling_shutter_and_a_still_video_are_one_clear_line(captured, tmp_path, monkeypatch, capsys):
    words = captured[1]
    monkeypatch.setattr("fidsplat.photographs.steps.readout_motion", lambda model: (0.1, 0.5))
    assert main(["capture", *map(str, words)]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "(rolling shutter), or the lens is not opencv: 0.50 px remain in the errors" in words
    video = cv2.VideoWriter(str(tmp_path / "still.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (160, 120))
    for _ in range(8):
        video.write(cv2.resize(walls()[0][0], (160, 120)))
    video.release()
    status, message = fails(capsys, "capture", tmp_path / "still.avi", "-o", tmp_path / "still")
    assert (status, "from different positions, got 1 different of 8 frames" in message) == (2, True)
