"""Data sets from disk: reading, and errors for unusable ones."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from training_scene import BACKGROUND, scene, write

import fidsplat as fs
from fidsplat.formats.colmap import load_colmap, save_colmap
from fidsplat.images.files import read_rgba, write_png
from fidsplat.train import Dataset, TrainingView, load_dataset
from fidsplat.train.dataset import viewed_cube


@pytest.fixture(scope="module")
def original():
    return scene(count=6)


@pytest.fixture
def folder(original, tmp_path):
    """The data set as fidsplat writes one."""
    write(original, tmp_path / "set")
    return tmp_path / "set"


def transforms(original, folder, **more):
    folder.mkdir()
    frames = []
    for view in original.views:
        write_png(folder / view.name, view.image)
        pose = np.linalg.inv(view.camera.world_to_camera) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"./{view.name}", "transform_matrix": pose.tolist()})
    camera = original.views[0].camera
    table = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(table | more))
    return folder


def same_views(actual, expected):
    assert [view.name.removeprefix("./") for view in actual] == [view.name for view in expected]
    for a, b in zip(actual, expected, strict=True):
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_allclose(a.camera.world_to_camera, b.camera.world_to_camera, atol=1e-12)
        assert (a.camera.fx, a.camera.cx) == (b.camera.fx, b.camera.cx)


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_colmap_as_binary_and_as_text(original, folder, suffix):
    for file in folder.rglob(f"sparse/0/*{'.txt' if suffix == '.bin' else '.bin'}"):
        file.unlink()
    dataset = load_dataset(folder)
    same_views(dataset.views, original.views)
    same_views(dataset.held_out, original.held_out)
    np.testing.assert_array_equal(dataset.points, original.points)
    np.testing.assert_array_equal(dataset.colors, original.colors)
    assert dataset.background == BACKGROUND


def test_a_model_of_pycolmap_is_read_as_pycolmap_reads_it(folder):
    pycolmap = pytest.importorskip("pycolmap", reason="of the extra test")
    theirs = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    again = folder / "again"
    again.mkdir()
    theirs.write(str(again))
    ours = load_colmap(again)
    for image in theirs.images.values():
        camera = ours.cameras[ours.names.index(image.name)]
        np.testing.assert_allclose(camera.world_to_camera[:3], image.cam_from_world().matrix(), atol=1e-12)
    assert len(ours.points) == len(theirs.points3D)


def test_colmaps_keypoints_are_skipped(folder):
    """Two points in each, which our own files have none of, as text and as binary."""
    model = folder / "sparse/0"
    before = load_colmap(model)
    lines = (model / "images.txt").read_text().splitlines()
    images = [line.split() for line in lines if line and not line.startswith("#")]
    (model / "images.bin").unlink()
    text = "".join(f"{' '.join(words)}\n9.5 8.5 1 7.5 6.5 -1\n" for words in images)
    (model / "images.txt").write_text(text)
    assert_same(load_colmap(model), before)
    packed = struct.pack("<Q", len(images))
    for number, *pose, camera, name in images:
        packed += struct.pack("<i7di", int(number), *map(float, pose), int(camera)) + name.encode() + b"\0"
        packed += struct.pack("<QddqddQ", 2, 9.5, 8.5, 1, 7.5, 6.5, 2**64 - 1)
    (model / "images.bin").write_bytes(packed)
    assert_same(load_colmap(model), before)


def assert_same(model, expected):
    assert model.names == expected.names
    for one, other in zip(model.cameras, expected.cameras, strict=True):
        np.testing.assert_array_equal(one.world_to_camera, other.world_to_camera)


def test_transforms_with_the_points_that_they_name(original, tmp_path):
    folder = transforms(original, tmp_path / "nerf", ply_file_path="points.ply")
    rows = np.zeros(6, [*((axis, "<f4") for axis in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))])
    for i, axis in enumerate("xyz"):
        rows[axis] = original.points[:, i]
    rows["green"] = 7
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 6\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    (folder / "points.ply").write_bytes(head.encode() + rows.tobytes())
    dataset = load_dataset(folder)
    same_views(dataset.views, original.views)
    np.testing.assert_allclose(dataset.points, original.points, atol=1e-6)
    assert dataset.colors.tolist() == [[0, 7, 0]] * 6


def test_alpha_and_masks(original, tmp_path):
    import cv2

    folder = transforms(original, tmp_path / "nerf")
    rgba = np.dstack([original.views[0].image[:, :, ::-1], np.full(original.views[0].image.shape[:2], 51)])
    cv2.imwrite(str(folder / "1.png"), rgba)
    table = json.loads((folder / "transforms.json").read_text())
    table["frames"][1]["mask_path"] = "mask.png"
    (folder / "transforms.json").write_text(json.dumps(table))
    mask = np.random.default_rng(0).uniform(size=rgba.shape[:2]) < 0.5
    write_png(folder / "mask.png", mask)
    dataset = load_dataset(folder, random_points=5)
    np.testing.assert_array_equal(dataset.views[0].image, np.rint(original.views[0].image / 5))
    np.testing.assert_array_equal(dataset.views[1].mask, mask)
    assert read_rgba(folder / "mask.png").shape == (*mask.shape, 4)
    people = np.random.default_rng(1).uniform(size=mask.shape) < 0.5
    for name in ("1.png", "2.png"):
        (tmp_path / "people").mkdir(exist_ok=True)
        write_png(tmp_path / "people" / f"{name}.png", people)
    dataset = load_dataset(folder, random_points=5, masks=tmp_path / "people", alpha_masks=True)
    assert not dataset.views[0].mask.any()  # all pixels of the image are transparent
    np.testing.assert_array_equal(dataset.views[1].mask, mask & people)
    write_png(tmp_path / "people" / "2.png.png", np.ones((96, 128)))
    with pytest.raises(
        fs.InputError, match=r"masks of .* must have the size.*and 128 x 96; draw the mask on"
    ):
        load_dataset(folder, random_points=5, masks=tmp_path / "people")


def test_points_as_text(original, tmp_path):
    """As nerfstudio writes them."""
    folder = transforms(original, tmp_path / "nerf", ply_file_path="points.ply", camera_model="OPENCV")
    head = "ply\nformat ascii 1.0\nelement vertex 6\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += "".join(f"property uint8 {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    lines = [f"{x:8f} {y:8f} {z:8f} 1 2 {255 - i}\n" for i, (x, y, z) in enumerate(original.points)]
    (folder / "points.ply").write_text(head + "".join(lines))
    dataset = load_dataset(folder)
    np.testing.assert_allclose(dataset.points, original.points, atol=1e-6)
    assert dataset.colors.tolist() == [[1, 2, 255 - i] for i in range(6)]
    for damaged, words in (
        (lines[:4], "truncated.* 6 rows of vertex, but the file has 4"),
        (["1 2\n"], "damaged"),
    ):
        (folder / "points.ply").write_text(head + "".join(damaged))
        with pytest.raises(fs.InputError, match=words):
            load_dataset(folder)


def test_images_of_colmap_are_read_as_they_are_stored(original, folder):
    """Not rotated by EXIF; transparent pixels show the background; 16 bits are truncated to 8."""
    import cv2

    images = folder / "images"
    picture = original.views[0].image
    turned = b"MM\0*\0\0\0\x08\0\1\x01\x12\0\3\0\0\0\1\0\3\0\0\0\0\0\0"  # orientation 3: upside down
    plain = cv2.imencode(".jpg", picture[:, :, ::-1])[1].tobytes()
    segment = b"Exif\0\0" + turned
    exif = plain[:2] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment + plain[2:]
    (images / "1.png").write_bytes(exif)
    clear = np.dstack([original.views[1].image[:, :, ::-1], np.full(picture.shape[:2], 51, np.uint8)])
    cv2.imwrite(str(images / "2.png"), clear)
    cv2.imwrite(str(images / "3.png"), original.views[2].image[:, :, ::-1].astype(np.uint16) * 257)
    loaded = [view.image.astype(int) for view in load_dataset(folder).views]
    assert np.abs(loaded[0] - picture).mean() < 0.6 * np.abs(loaded[0] - picture[::-1, ::-1]).mean()
    np.testing.assert_array_equal(
        loaded[1], np.rint(original.views[1].image * 0.2 + 255 * 0.8 * np.array(BACKGROUND))
    )
    np.testing.assert_array_equal(loaded[2], original.views[2].image)


def test_a_model_without_points_may_start_from_random_ones(folder):
    for file in folder.rglob("points3D.*"):
        file.unlink()
    assert len(load_dataset(folder, random_points=5).points) == 5
    with pytest.raises(fs.InputError, match="must have initial points, got none; give --random-points"):
        load_dataset(folder)


def test_cameras_of_a_model_that_cannot_be_used_are_named(folder):
    model = folder / "sparse" / "0"
    for file in model.glob("*.bin"):
        file.unlink()
    cameras, images = model / "cameras.txt", model / "images.txt"
    texts = cameras.read_text(), images.read_text()
    line = next(line for line in texts[0].splitlines() if line[:1].isdigit())
    number = line.split()[0]
    for other, words in (
        (
            f"{number} PINHOLE 24 18 20",
            "cannot read .*cameras.txt as COLMAP: camera 1 of model PINHOLE must have 4 parameters, got 1",
        ),
        (
            f"{number} FOV 24 18 20 20 12 9 0.1",
            r"image 1\.png: .*the camera model must be .*, got FOV; undistort the images",
        ),
        (f"{number} SIMPLE_RADIAL 24 18 20 12 9 -9", r"image 1\.png: .*must be invertible .*got k1 = -9"),
        (f"{number} PINHOLE 24 18 0 20 12 9", r"image 1\.png: "),
    ):
        cameras.write_text(texts[0].replace(line, other))
        with pytest.raises(fs.InputError, match=words):
            load_dataset(folder)
    cameras.write_text(texts[0])
    first = next(line for line in texts[1].splitlines() if line[:1].isdigit()).split()
    words = [first[0], "0", "0", "0", "0", *first[5:]]
    images.write_text(texts[1].replace(" ".join(first), " ".join(words)))
    with pytest.raises(fs.InputError, match=f"image {first[9]}: "):
        load_dataset(folder)


def test_views_that_are_held_out(original, folder):
    assert [len(load_dataset(folder, n).views) for n in (0, 2)] == [4, 2]
    assert [view.name for view in load_dataset(folder, 2).held_out] == ["1.png", "3.png", "0.png"]
    for count, held_out in ((15, 0), (16, 2), (17, 3)):
        names = [f"{number:02}.png" for number in range(count)]
        cameras = [original.views[k % 2].camera for k in range(count)]
        place = folder / f"{count}"
        (place / "images").mkdir(parents=True)
        for name in names:
            write_png(place / "images" / name, original.views[0].image)
        save_colmap(place / "sparse" / "0", names, cameras, original.points, original.colors)
        dataset = load_dataset(place)
        assert [view.name for view in dataset.held_out] == names[::8][:held_out]
        assert len(dataset.views) == count - held_out
    many = Dataset("many", original.views * 4, (), original.points, original.colors)
    assert many.digest != original.digest


def test_views_that_nerfstudio_holds_out(original, tmp_path):
    """Its lists name images with and without "./"."""
    for number, (lists, trained, held_out) in enumerate(
        [
            ({"test_filenames": ["2.png"]}, [1, 3, 4], [2]),
            ({"val_filenames": ["./2.png"], "test_filenames": ["4.png"]}, [1, 3], [2, 4]),
            ({"train_filenames": ["./1.png", "3.png"], "val_filenames": ["4.png"]}, [1, 3], [4]),
        ]
    ):
        folder = transforms(original, tmp_path / str(number), **lists)
        dataset = load_dataset(folder, random_points=9)
        for views, expected in ((dataset.views, trained), (dataset.held_out, held_out)):
            assert [view.name for view in views] == [f"./{name}.png" for name in expected]
    for wrong, message in (
        ({"test_filenames": "2.png"}, "test_filenames must be a list"),
        ({"val_filenames": ["no.png"]}, "val_filenames must be file_paths of frames, got no.png"),
    ):
        folder = transforms(original, tmp_path / next(iter(wrong)), **wrong)
        with pytest.raises(fs.InputError, match=message):
            load_dataset(folder, random_points=9)


def test_random_points_lie_where_the_cameras_look(original):
    low, high, faced = viewed_cube([view.camera for view in original.views])
    assert faced
    assert np.abs(low + high).max() < 1e-9  # all look at 0
    actual = original.with_random_points(500, 3)
    assert (actual.points > low).all()
    assert (actual.points < high).all()
    assert (original.with_random_points(500, 3).points == actual.points).all()
    assert (original.with_random_points(500, 4).points != actual.points).any()


@pytest.mark.parametrize("way", ["around", "ahead", "beside"])
def test_random_points_lie_before_cameras_that_look_at_no_one_place(original, way):
    """A room from its middle, a drive, a row of cameras that look the same way."""
    along = np.linspace(-1, 1, 8)
    around = [np.array([np.sin(3 * a), 0, np.cos(3 * a)]) for a in along]
    places = {
        "around": [(place, 9 * place) for place in around],
        "ahead": [((0, 0, a), (0, 0, 9)) for a in along],
        "beside": [((a, 0, 0), (a, 0, 9)) for a in along],
    }[way]
    cameras = [fs.Camera.look_at(24, 18, 0.9, *place) for place in places]
    views = tuple(replace(original.views[0], camera=camera) for camera in cameras)
    none = np.zeros((0, 3))
    actual = Dataset(way, views, (), none, none.astype(np.uint8)).with_random_points(400, 0)
    for number, camera in enumerate(cameras):
        at = camera.project(actual.points)
        assert ((at > 0) & (at < (24, 18))).all(axis=1)[number::8].all()
        depths = (actual.points - camera.position)[number::8] @ camera.world_to_camera[2, :3]
        assert 0 < depths.min() < 0.5 * actual.extent
        assert 2.5 * actual.extent < depths.max() < 3 * actual.extent


def test_scenes_far_from_the_origin_have_one_of_their_own(original):
    shift = np.array([5e5, -4e6, 0.0])

    def moved(view):
        matrix = view.camera.world_to_camera.copy()
        matrix[:3, 3] -= matrix[:3, :3] @ shift
        c = view.camera
        camera = fs.Camera.pinhole(c.width, c.height, c.fx, c.fy, c.cx, c.cy, matrix)
        return TrainingView(view.name, camera, view.image)

    far = Dataset("far", tuple(map(moved, original.views)), (), original.points + shift, original.colors)
    assert np.abs(far.origin - shift).max() < 10
    assert not original.origin.any()


def refusals(original):
    view, names = original.views[0], {}
    camera = view.camera
    names["got 2 x 2; give images of the size"] = lambda: TrainingView(
        "a.png", camera, np.zeros((2, 2, 3), np.uint8)
    )
    names["at least two training views, .* got 1"] = lambda: Dataset(
        "one", (view,), (), original.points, original.colors
    )
    names["cameras of still must be at different positions"] = lambda: Dataset(
        "still", (view, view), (), original.points, original.colors
    )
    turned = []
    for k in range(5):  # a tripod: the place is what rounding leaves of it
        other = fs.Camera.look_at(24, 18, 0.9, (-1.7, 0.3, -2.1), (0.1 * k, 0.07 * k, 0))
        pinhole = (24, 18, other.fx, other.fy, other.cx, other.cy, other.world_to_camera)
        turned.append(TrainingView(f"{k}.png", fs.Camera.pinhole(*pinhole), view.image))
    names["the 5 cameras of tripod must be at different positions"] = lambda: Dataset(
        "tripod", tuple(turned), (), original.points, original.colors
    )
    behind = 9 * camera.position + original.points
    names["points of back must be in front of the camera of .*, got all 6 behind"] = lambda: Dataset(
        "back", original.views, (), behind, original.colors
    )
    names["must be a pinhole camera, got a lens"] = lambda: TrainingView(
        "a.png", fs.Camera.fisheye(24, 18, 2.0), np.zeros((18, 24, 3), np.uint8)
    )
    return names


def test_data_sets_that_cannot_be_trained_on_are_refused(original):
    for words, make in refusals(original).items():
        with pytest.raises(fs.InputError, match=words):
            make()


def test_files_that_are_missing_or_damaged_are_named(original, folder, tmp_path):
    with pytest.raises(fs.InputError, match="path must be an existing data set"):
        load_dataset(tmp_path / "nothing")
    with pytest.raises(fs.InputError, match="must be a data set of COLMAP"):
        load_dataset(tmp_path)
    with pytest.raises(fs.InputError, match=r"--hold-out must be .*, got 1"):
        load_dataset(folder, 1)
    (folder / "images" / "2.png").unlink()
    with pytest.raises(fs.InputError, match=r"cannot read .*2\.png"):
        load_dataset(folder)
    for name in ("points3D", "images", "cameras"):
        file = folder / "sparse" / "0" / f"{name}.bin"
        contents = file.read_bytes()
        for data in (contents[:-3], contents[:11], b"\xff" * 40):
            file.write_bytes(data)
            with pytest.raises(fs.InputError, match=f"{name}.bin as COLMAP"):
                load_dataset(folder)
        file.write_bytes(contents)
    nerf = transforms(original, tmp_path / "nerf")
    with pytest.raises(fs.InputError, match="must have initial points, got none; give --random-points"):
        load_dataset(nerf)
    for change, words in (
        ({"frames": 3}, "frames must be a list"),
        ({"frames": [{"file_path": "a"}]}, "frame 0 must have"),
        ({"k1": "wide"}, "k1 must be a finite number"),
        (
            {"k4": 0.1},
            "of the camera_model PINHOLE must be .*, got k4 = 0.1; undistort the images",
        ),
        ({"fl_x": "far"}, "fl_x, or camera_angle_x, must be a finite"),
        ({"w": float("inf")}, "w and h must be the size of the images"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model must be one of .*, got 'EQUIRECTANGULAR'"),
    ):
        table = json.loads((nerf / "transforms.json").read_text())
        (tmp_path / "transforms.json").write_text(json.dumps(table | change))
        (nerf / "other.json").write_text(json.dumps(table | change))
        with pytest.raises(fs.InputError, match=words):
            load_dataset(nerf / "other.json", random_points=5)


@pytest.mark.parametrize(
    ("name", "line", "words"),
    [
        (
            "cameras",
            "1 PINHOLE 64 48 50",
            "cannot read .*cameras.txt as COLMAP: camera 1 of model PINHOLE must have 4 parameters, got 1",
        ),
        ("points3D", "1 0 0 0 9", "not enough"),
        ("images", "1 1 0 0 0 0", "must have 10 words, got '1 1 0 0 0 0'"),
    ],
)
def test_lines_of_a_colmap_model_that_end_early(folder, name, line, words):
    model = folder / "sparse/0"
    for file in model.glob("*.bin"):
        file.unlink()
    (model / f"{name}.txt").write_text(line + "\n")
    with pytest.raises(fs.InputError, match=words):
        load_colmap(model)
