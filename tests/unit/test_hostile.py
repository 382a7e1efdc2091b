"""Hostile input: damaged files of every kind, Python arguments and command lines.

Every input is used, or refused in one line, within limits of time and memory. A longer run:

    FIDSPLAT_HOSTILE=1000 python -m pytest -m "" -n 0 tests/unit/test_hostile.py --hypothesis-seed=33
"""

import contextlib
import json
import os
import shutil
import warnings
import zipfile
import zlib

import cv2
import numpy as np
import pytest
from hostile import JUNK, NUMBERS, TEXTS, damaged, limits
from hostile_calls import CALLS, DATASET, RENDERER, SETTINGS, _image_folder
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from test_formats_sog import sog
from test_sim_description import ROVER, URDF, WORLD

import fidsplat as fs
from fidsplat import cli
from fidsplat.formats.sog_streamed import save_streamed
from fidsplat.formats.spz import save_spz
from fidsplat.images.files import read_bits, read_image, write_png
from fidsplat.sim import read_description
from fidsplat.store.layout import NPY_HEADER, checksum, header_crc
from fidsplat.train import Trainer, load_dataset
from fidsplat.train.checkpoint import splats_of
from fidsplat.vision.detect import detect

COUNT = int(os.environ.get("FIDSPLAT_HOSTILE", "0"))
"""examples of each kind; 0: a few, the same in every run"""
AWAY = np.eye(4) + 4.5e6 * np.eye(4, k=3)
CAMERA = fs.Camera.look_at(24, 16, 1.0, (0.0, 0.0, -9.0), (0.0, 0.0, 0.0))


def examples(few):
    return settings(
        max_examples=COUNT or few,
        deadline=None,
        derandomize=not COUNT,
        database=None,
        phases=[Phase.generate, Phase.shrink] if COUNT else [Phase.generate],
        suppress_health_check=list(HealthCheck),
    )


def cloud(count=12):
    r = np.random.default_rng(count)
    shapes = r.normal(size=(count, 3)), r.normal(size=(count, 4)), r.uniform(0.1, 1, (count, 2))
    return fs.SplatCloud(*shapes, r.random(count), sh=r.normal(size=(count, 4, 3)))


# --- files that are good


def splats(suffix):
    def make(folder):
        fs.save_splats(cloud(), folder / f"a{suffix}")

    return make


def marked(folder):
    """Labels, coplanar groups and an origin."""
    groups = np.arange(12) % 4 - 1
    moved = cloud().with_labels(np.arange(12) - 3).with_coplanar_groups(groups).transformed(AWAY)
    fs.save_ply(moved, folder / "a.ply", native_2dgs=True)


def trained(folder):
    """A 3DGS file of SH degree 3, as from training: three scales."""
    r, two = np.random.default_rng(3), cloud()
    scales = r.uniform(0.1, 1, (12, 3))
    thick = fs.SplatCloud(two.means, two.quats, scales, two.opacities, sh=r.normal(size=(12, 16, 3)))
    fs.save_ply(thick, folder / "a.ply", native_2dgs=False)


def splats_folder(folder):
    fs.save_splats(cloud(), folder / "meta.json")


def streamed(folder):
    part = [cloud()]
    save_streamed(folder / "lod-meta.json", [(np.array(cloud().bounds()), [part, part])], 2)


def gltf(folder):
    """The same splats as a glTF file, with its buffer in a separate file."""
    fs.save_splats(cloud(), folder / "a.glb")
    data = (folder / "a.glb").read_bytes()
    (folder / "a.glb").unlink()
    size = int.from_bytes(data[12:16], "little")
    printed = json.loads(data[20 : 20 + size])
    printed["buffers"][0]["uri"] = "a.bin"
    (folder / "a.bin").write_bytes(data[28 + size :])
    (folder / "a.gltf").write_text(json.dumps(printed))


def packed_sog(folder):
    sog(folder / "a.sog")


SCENE = """[camera]
width = 24
height = 16
fov_x_deg = 60.0
near = 0.1
[camera.distortion]
k1 = 0.1
[camera.shutter]
exposure_time_ms = 5.0
sub_poses = 2
readout_ms = 3.0
rows_per_band = 8
[[camera.motion]]
time = 0.0
position = [0.0, 0.0, -1.0]
look_at = [0.0, 0.0, 0.0]
[[splats]]
file = "good.ply"
position = [0.0, 0.0, 1.0]
quaternion = [1.0, 0.0, 0.0, 0.0]
scale = 1.0
[[markers]]
spec = "aruco:4x4_50:7"
size = 0.1
[[markers]]
spec = "svg-9:good.svg"
size = 0.1
quiet_zone = 1
mixture = "exact"
[sensor]
exposure = 1.5
full_well = 1000.0
read_noise = 2.0
response = 2.2
bits = 8
[fog]
density = 0.1
color = [0.5, 0.5, 0.5]
[background]
top = [0.0, 0.0, 1.0]
bottom = [1.0, 1.0, 1.0]
[render]
outputs = ["rgb", "depth"]
device = "reference"
[quality]
preset = "fast"
samples = 2
alpha_cutoff = 1e-3
[quality.marker]
template = 9
"""
DRAWING = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 10 10">
<rect x="1" y="2" width="3" height="4" fill="#123456"/>
<circle cx="5" cy="5" r="3" fill="rgb(255, 0, 9)"/>
<ellipse cx="5" cy="5" rx="3" ry="2"/>
<polygon points="0,0 9,0 9,9" fill-rule="evenodd"/>
<path d="M 1 1 h 5 v 5 l -1 1 C 1 2 3 4 5 6 S 1 2 3 4 Q 1 2 3 4 T 5 6 A 2 3 10 0 1 4 4 z" style="fill:navy"/>
<g transform="translate(1, 2) rotate(30) scale(0.5)"><rect width="4" height="4"/></g>
<g fill="none"><title>a</title><rect width="9" height="9" fill="lime"/></g>
</svg>
"""


def ground(folder):
    """Files for scenes and command lines to name."""
    fs.save_ply(cloud(), folder / "good.ply")
    random = np.random.default_rng(0)
    write_png(folder / "good.png", random.integers(0, 255, (8, 16, 3)).astype(np.uint8))
    write_png(folder / "bits.png", random.integers(0, 2, (6, 6)).astype(np.uint8) * 255)
    (folder / "good.svg").write_text(DRAWING)


def scene(folder):
    ground(folder)
    (folder / "a.toml").write_text(SCENE)


def drawing(folder):
    (folder / "a.svg").write_text(DRAWING)


def pictures(folder):
    random = np.random.default_rng(1)
    colors = random.integers(0, 255, (9, 12, 3)).astype(np.uint8)
    for suffix in (".png", ".jpg", ".tiff", ".bmp", ".webp", ".hdr", ".ppm"):
        image = colors if suffix != ".hdr" else colors.astype(np.float32)
        (folder / f"a{suffix}").write_bytes(cv2.imencode(suffix, image)[1].tobytes())
    write_png(folder / "deep.png", colors.astype(np.uint16) * 257)


def world(folder):
    (folder / "rover").mkdir()
    (folder / "rover/model.sdf").write_text(ROVER)
    (folder / "world.sdf").write_text(WORLD)


def robot(folder):
    (folder / "a.urdf").write_text(URDF)


def log(name):
    def make(folder):
        logs = pytest.importorskip("fidsplat.logs", reason="pip install 'fidsplat[logs]'")
        with logs.RobotLog(folder / name) as log:
            for time in (0.5, 1.0):
                log.image(time, "eye", np.zeros((4, 6, 3)))
                log.image(time, "eye", np.zeros((4, 6, 3)), compress="png")
                log.transform(time, "eye", np.eye(4))

    return make


def store(folder):
    fs.save_ply(cloud(400), folder / "a.ply")
    fs.build_store([folder / "a.ply"], folder / "a.fss", chunk=64)
    (folder / "a.ply").unlink()


def checkpoint(folder):
    trainer = Trainer(DATASET, RENDERER, SETTINGS, folder / "a.npz")
    trainer.run()


def views(folder):
    _image_folder(folder)


COLMAP = {
    "cameras": "1 OPENCV 12 8 10 11 6 4 0.1 0.01 0 0\n",
    "images": "1 1 0 0 0 0 0 4 1 0.png\n1 2 1\n2 0.9 0.1 0 0 0 0 4 1 1.png\n\n",
    "points3D": "1 0 0 1 255 0 9 0.5 1 0\n2 0 1 1 255 0 9 0.5 1 0 2 0\n",
}


def colmap_text(folder):
    (folder / "sparse/0").mkdir(parents=True)
    (folder / "images").mkdir()
    for name, text in COLMAP.items():
        (folder / f"sparse/0/{name}.txt").write_text(text)
    for k in range(2):
        write_png(folder / f"images/{k}.png", np.full((8, 12, 3), 90, np.uint8))


def path_file(name):
    def make(folder):
        path = fs.Trajectory([0.0, 1.0], np.stack([np.eye(4)] * 2))
        fs.save_trajectory(path, folder / name, CAMERA, ["a.png", "b.png"])

    return make


RUN = {"run": {"device": None, "seed": 0, "versions": {}, "code": "", "points": 1}}
PART = {"dark": 3, "light": 4}
POINT = {
    "key": {"category": "apriltag", "index": 0, "repeats": 2},
    "result": {key: PART for key in ("cells", "runs", "rectangles", "components")}
    | {"gaussians": {"exact": {"rectangles": 7, "cells": 8}}, "seconds": {"exact": [0.1, 0.2]}},
}


def results(folder):
    (folder / "counts.jsonl").write_text(f"{json.dumps(RUN)}\n{json.dumps(POINT)}\n")


# --- their use


def render(made):
    if 0 < len(made) < 1000:
        RENDERER.render(made, CAMERA, ["rgb", "depth"])


def assert_valid(made):
    """All splats of a loaded cloud can be rendered; those that could not were left out."""
    for name in ("means", "quats", "scales", "opacities", "sh"):
        array = getattr(made, name)
        assert len(array) == len(made) == len(made.labels)
        assert np.isfinite(array).all(), name
    assert (made.scales > 0).all()
    assert ((made.opacities >= 0) & (made.opacities <= 1)).all()
    np.testing.assert_allclose((made.quats.astype(float) ** 2).sum(1), 1, atol=1e-6)
    assert made.coplanar_groups is None or (made.coplanar_groups >= -1).all()
    assert np.isfinite(made.origin).all()


def use_splats(file):
    made = fs.load_splats(file)
    assert_valid(made)
    render(made)
    fs.save_ply(made, file.with_name("again.ply"))


def use_scene(file):
    written_scene = fs.Scene.load(file)
    camera = written_scene.camera
    if camera is not None and camera.width * camera.height < 10_000 and len(written_scene.cloud()) < 10_000:
        RENDERER.render(written_scene)
    written_scene.save(file.with_name("again.toml"))
    fs.Scene.load(file.with_name("again.toml"))


def use_drawing(file):
    for spec in ("svg", "svg-16"):
        render(fs.marker(f"{spec}:{file}", size=0.1, mixture="exact").cloud)


def use_picture(file):
    ways = (
        lambda: detect(read_image(file)),
        lambda: read_image(file, deep=True),
        lambda: read_bits(file),
        lambda: fs.Panorama.load(file),
        lambda: fs.marker(f"image:{file}", size=0.1),
    )
    for way in ways:
        with limits():
            way()


def use_log(path):
    from fidsplat.logs import log_images, log_poses

    for _ in log_images(path):
        pass
    log_poses(path)


def use_store(path):
    made = fs.Store(path)
    made.summary(), made.labels(), made.verify()
    if len(made) < 1000:
        with np.errstate(all="ignore"):  # values of splats are not read before they are rendered
            RENDERER.render(fs.Scene([], CAMERA, stores=(made,)), outputs=["alpha"])


def use_checkpoint(file):
    with contextlib.suppress(fs.FidsplatError):
        render(splats_of(file)[0])
    Trainer(DATASET, RENDERER, SETTINGS, file, restart=False).run()


def use_views(path):
    load_dataset(path, random_points=3)


def use_path(file):
    trajectory = fs.load_trajectory(file)
    trajectory(trajectory.times[0])


def use_results(file):
    from paper_targets import targets

    targets([file.parent])


def signed(folder):
    """Set the checksums of a damaged store to match its content, as an attacker could."""
    with contextlib.suppress(Exception):
        header, nodes = json.loads((folder / "store.json").read_text()), np.load(folder / "nodes.npy")
        with contextlib.suppress(Exception):
            columns = {
                name: np.memmap(folder / f"{name}.npy", kind, "r", NPY_HEADER).reshape(header["rows"], -1)
                for name, kind in header["columns"].items()
            }
            for node in nodes:
                part = slice(node["first"], node["first"] + node["count"])
                node["crc"] = checksum({name: array[part] for name, array in columns.items()})
        np.save(folder / "nodes.npy", nodes)
        header["nodes_crc"] = zlib.crc32(nodes.tobytes())
        (folder / "store.json").write_text(json.dumps(header | {"crc": header_crc(header)}))


INPUTS = {
    ".ply": (splats(".ply"), use_splats, "a.ply", 100),
    ".ply with labels, groups and an origin": (marked, use_splats, "a.ply", 100),
    ".ply of 3DGS": (trained, use_splats, "a.ply", 100),
    ".compressed.ply": (splats(".compressed.ply"), use_splats, "a.compressed.ply", 100),
    ".splat": (splats(".splat"), use_splats, "a.splat", 20),
    ".spz": (splats(".spz"), use_splats, "a.spz", 40),
    "SPZ 3": (lambda folder: save_spz(cloud(), folder / "a.spz", version=3), use_splats, "a.spz", 20),
    ".glb": (splats(".glb"), use_splats, "a.glb", 40),
    ".gltf": (gltf, use_splats, "a.gltf", 40),
    ".sog": (packed_sog, use_splats, "a.sog", 40),
    "SOG folder": (splats_folder, use_splats, "meta.json", 30),
    "streamed SOG": (streamed, use_splats, "lod-meta.json", 30),
    ".usda": (splats(".usda"), use_splats, "a.usda", 3),
    ".usdc": (splats(".usdc"), use_splats, "a.usdc", 3),
    "scene": (scene, use_scene, "a.toml", 40),
    "drawing": (drawing, use_drawing, "a.svg", 30),
    "pictures": (pictures, use_picture, "*", 30),
    "SDF": (world, read_description, "world.sdf", 30),
    "URDF": (robot, read_description, "a.urdf", 30),
    "MCAP": (log("a.mcap"), use_log, "a.mcap", 30),
    "bag": (log("a"), use_log, "a", 30),
    "store": (store, use_store, "a.fss", 40),
    "checkpoint": (checkpoint, use_checkpoint, "a.npz", 20),
    "transforms.json": (views, use_views, ".", 30),
    "COLMAP": (colmap_text, use_views, ".", 30),
    ".tum": (path_file("a.tum"), use_path, "a.tum", 20),
    ".kitti": (path_file("a.kitti"), use_path, "a.kitti", 20),
    ".json": (path_file("a.json"), use_path, "a.json", 20),
    "results": (results, use_results, "counts.jsonl", 30),
}
"""kind: (maker of good files in a folder, use of one, its name or a pattern, examples of a short run)"""


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Folder of good files of a kind, which must be used."""
    arguments = {}

    def of(kind):
        if kind not in arguments:
            make, use, name, _ = INPUTS[kind]
            folder = tmp_path_factory.mktemp("good")
            make(folder)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                for path in [folder] if name == "." else sorted(folder.glob(name)):
                    copy = tmp_path_factory.mktemp("used") / "copy"
                    shutil.copytree(folder, copy)
                    use(copy if name == "." else copy / path.name)
            arguments[kind] = folder
        return arguments[kind]

    return of


@pytest.mark.sweep
@pytest.mark.parametrize("kind", list(INPUTS))
def test_damaged_files_are_used_or_refused(kind, good, tmp_path):
    if kind.startswith(".usd"):
        pytest.importorskip("pxr.UsdVol", reason="pip install 'fidsplat[usd]'")
    folder, (_, use, name, few) = good(kind), INPUTS[kind]
    files = sorted(file.relative_to(folder) for file in folder.rglob("*") if file.is_file())
    contents = {file: (folder / file).read_bytes() for file in files}
    copy = tmp_path / "copy"

    @examples(few)
    @given(st.data())
    def check(data):
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(folder, copy)
        file = data.draw(st.sampled_from(files))
        (copy / file).write_bytes(data.draw(damaged(file, contents[file])))
        if kind == "store" and data.draw(st.booleans()):
            signed(copy / name)
        with limits():
            use(copy / file if name == "*" else copy if name == "." else copy / name)

    check()


def test_a_gltf_buffer_view_of_more_bytes_than_there_are(tmp_path):
    gltf(tmp_path)
    printed = json.loads((tmp_path / "a.gltf").read_text())
    for length in (2**53, 2**62, 10**300):
        printed["bufferViews"][0]["byteLength"] = length
        (tmp_path / "a.gltf").write_text(json.dumps(printed))
        with limits():
            fs.load_splats(tmp_path / "a.gltf")


def test_a_lens_whose_center_is_far_beyond_float32(tmp_path):
    colmap_text(tmp_path)
    for center in ("2147483648", "1e30", "-1e300"):
        text = COLMAP["cameras"].replace("11 6 4", f"11 {center} 4")
        (tmp_path / "sparse/0/cameras.txt").write_text(text)
        with limits():
            use_views(tmp_path)


@pytest.mark.parametrize("color", ["256", "-1", "2222222222", "nan", "1e300"])
def test_points_whose_colors_are_no_bytes(tmp_path, color):
    colmap_text(tmp_path)
    text = COLMAP["points3D"].replace("255 0 9", f"{color} 0 9", 1)
    (tmp_path / "sparse/0/points3D.txt").write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(fs.InputError, match="must have colours from 0 to 255"):
            use_views(tmp_path)


def test_a_quaternion_of_about_zero(tmp_path):
    colmap_text(tmp_path)
    (tmp_path / "sparse/0/images.txt").write_text(COLMAP["images"].replace("1 1 0", "1 1e-320 0", 1))
    with limits(), pytest.raises(fs.InputError, match=r"image 0\.png"):
        use_views(tmp_path)


@pytest.mark.parametrize(
    ("part", "key", "value"), [("scales", "codebook", 1e300), ("means", "mins", 2.0**31)]
)
def test_numbers_of_sog_beyond_float32(tmp_path, part, key, value):
    packed_sog(tmp_path)
    file = tmp_path / "a.sog"
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(members["meta.json"])
    meta[part][key][0] = value
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in (members | {"meta.json": json.dumps(meta)}).items():
            archive.writestr(name, content)
    with limits():
        use_splats(file)


@pytest.mark.parametrize("value", [[], {}, 5, None])
def test_a_camera_model_that_is_no_text(tmp_path, value):
    views(tmp_path)
    printed = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "transforms.json").write_text(json.dumps(printed | {"camera_model": value}))
    with limits(), pytest.raises(fs.InputError, match="camera_model must be one of"):
        use_views(tmp_path)


@pytest.mark.parametrize("name", ["x" * 300, "x/" * 3000])
def test_names_of_images_that_no_file_can_have(tmp_path, name):
    views(tmp_path)
    text = (tmp_path / "transforms.json").read_text()
    (tmp_path / "transforms.json").write_text(text.replace("1.png", name))
    colmap_text(tmp_path / "colmap")
    (tmp_path / "colmap/sparse/0/images.txt").write_text(COLMAP["images"].replace("1.png", name))
    for folder in (tmp_path, tmp_path / "colmap"):
        with pytest.raises(fs.InputError, match="a file name must have at most 255 bytes"):
            use_views(folder)


@pytest.mark.parametrize("link", [False, True])
def test_views_that_repeat_one_image(tmp_path, link):
    """Each would be a copy in memory."""
    views(tmp_path)
    text = (tmp_path / "transforms.json").read_text()
    if link:
        (tmp_path / "1.png").unlink()
        os.link(tmp_path / "0.png", tmp_path / "1.png")
    else:
        (tmp_path / "transforms.json").write_text(text.replace("1.png", "./0.png"))
    with pytest.raises(fs.InputError, match=r"views must have different images, got .* twice"):
        use_views(tmp_path)


def test_a_scene_that_repeats_one_file_of_splats(tmp_path, monkeypatch):
    fs.save_ply(cloud(1000), tmp_path / "a.ply")
    text = '[[splats]]\nfile = "a.ply"\nposition = [0.0, 0.0, 1.0]\n'
    (tmp_path / "a.toml").write_text(text * 3)
    assert len(fs.Scene.load(tmp_path / "a.toml").cloud()) == 3000
    monkeypatch.setenv("FIDSPLAT_INPUT_LIMIT", str(300_000))
    (tmp_path / "a.toml").write_text(text * 5)
    with pytest.raises(fs.InputError, match=r"the splats of .* must take at most 293 KiB, got .*store build"):
        fs.Scene.load(tmp_path / "a.toml")


# --- Python


ODD = (object(), [10**400] * 3, np.float16(1), np.zeros((0, 3)), 10**400, "\ud800", float("nan"))


@pytest.mark.sweep
@pytest.mark.parametrize("name", sorted(CALLS))
def test_every_argument_is_validated(name, tmp_path, monkeypatch):
    """Each argument of a public function in turn has four unexpected values: the function works, or
    raises an error of fidsplat."""
    monkeypatch.chdir(tmp_path)
    ground(tmp_path)
    monkeypatch.setattr(warnings, "showwarning", lambda *_: None)
    for number, key in enumerate(CALLS[name](tmp_path)[1]):
        for odd in (*ODD[:3], ODD[3 + number % 4]):
            function, good, use = CALLS[name](tmp_path)
            with contextlib.suppress(fs.FidsplatError):
                value = function(**good | {key: odd})
                if use is not None:
                    use(value)


MISSING = {"read_description": "world.sdf", "load_trajectory": "a.tum", "Scene.load": "a.toml"}
"""calls whose good path names no file yet"""


@pytest.mark.sweep
@pytest.mark.parametrize("name", sorted(CALLS.keys() - {"Frame.device_array"}))  # the reference has none
def test_good_arguments_are_used(name, tmp_path, monkeypatch):
    """Otherwise odd ones next to them would be refused for another reason."""
    monkeypatch.chdir(tmp_path)
    scene(tmp_path)
    world(tmp_path)
    path_file("a.tum")(tmp_path)
    function, good, use = CALLS[name](tmp_path)
    if name in MISSING:
        good = good | {"path": tmp_path / MISSING[name]}
    arguments = function(**good)
    if use is not None:
        use(arguments)


@examples(40)
@given(st.data())
def test_unexpected_arguments(tmp_path, data):
    if not (tmp_path / "good.ply").exists():
        ground(tmp_path)
    function, arguments, use = CALLS[data.draw(st.sampled_from(sorted(CALLS)))](tmp_path)
    keys = st.lists(st.sampled_from(sorted(arguments)), min_size=1, max_size=2, unique=True)
    odd = {key: data.draw(st.sampled_from(JUNK)) for key in data.draw(keys)}
    with limits(), contextlib.chdir(tmp_path):
        value = function(**arguments | odd)
        if use is not None:
            use(value)


# --- command lines


COMMANDS = [
    "marker aruco:4x4_50:7 --size 0.1 -o tag.ply --mixture fitted --quality marker.template=9",
    "marker qr:hello --json",
    "marker image:bits.png --mixture exact --native-2dgs -o tag.ply",
    "marker charuco:5x4:4x4_50 --json --max-splats 20000",
    "marker gridboard:2x3:4x4_50 -o board.ply",
    "marker aprilgrid:2x2:36h11 --size 0.4 --json",
    "marker svg-16:good.svg -o drawing.ply",
    "render a.toml -o frames --outputs rgb,label --device reference --quality fast,samples=2,order=pixel",
    "render none.ply -o a.png --device reference --json",
    "detect good.png --family 36h11 --scene a.toml --json",
    "detect . --json",
    "source a.toml --schedule group",
    "info good.ply --json",
    "convert good.ply out.spz --json",
    "devices --json",
]
SLOW = [
    "check --device nowhere",
    "bench --scenes nothing --json out.json",
    "tradeoff --scenes nothing -o out",
    "experiment nothing -o out",
    "experiment counts --markers 9 -o out",
    "experiment merge nowhere -o out",
    "experiment report nowhere -o out",
    "demo --out /proc/nowhere",
    "warm nothing --device nowhere",
]
"""commands that would work for minutes, were their words good after all"""
OPTIONS = ["--size", "--debugg", "--jsno", "-o", "--outputs", "--quality", "--seed"]


NAMED = [
    "info NAME",
    "info NAME.ply",
    "convert NAME.ply a.spz",
    "convert good.ply NAME.spz",
    "detect NAME",
    "detect NAME.mcap",
    "detect good.png --scene NAME",
    "render NAME -o a",
    "render a.toml -o NAME",
    "render NAME.toml -o a",
    "source NAME",
    "marker image:NAME",
    "marker qr:a -o NAME.ply",
    "train NAME -o a.ply",
    "view NAME",
    "store info NAME",
    "store verify NAME",
    "store build NAME.ply -o a.fss",
    "store build good.ply -o NAME",
    "fly a.toml NAME",
    "gallery NAME -o a",
    "experiment report NAME -o a",
]


@pytest.mark.parametrize("length", [251, 300, 5000])
def test_names_that_no_file_can_have(tmp_path, capsys, monkeypatch, length):
    """In place of each word of a command line that names a file."""
    monkeypatch.chdir(tmp_path)
    scene(tmp_path)
    long = "x" * length
    for line in NAMED:
        capsys.readouterr()
        with limits():
            status = cli.main(line.replace("NAME", long).split())
        errors = capsys.readouterr().err
        assert status in ((1, 2) if length > 255 else (0, 1, 2)), line
        assert "a fault of fidsplat" not in errors, (line, errors[-300:])
        assert "Traceback" not in errors, line


@st.composite
def command_lines(draw):
    slow = draw(st.integers(0, 3)) == 0
    words = draw(st.sampled_from(SLOW if slow else COMMANDS)).split()
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(1, max(len(words), 1)))
        match draw(st.integers(0, 1 if slow else 5)):
            case 0:
                words.insert(at, draw(st.sampled_from(TEXTS)))
            case 1:
                words.insert(at, draw(st.sampled_from(OPTIONS)))
            case 2:
                words[at - 1 : at] = [draw(st.sampled_from(TEXTS))]
            case 3:
                del words[at - 1 : at]
            case 4 if words:
                word = words[at - 1]
                cut = draw(st.integers(0, len(word)))
                words[at - 1] = word[:cut] + draw(st.sampled_from(TEXTS))[:9] + word[cut:]
            case _ if words:
                ending = draw(st.sampled_from(["", ",", "=", *NUMBERS]))
                words[at - 1] = words[at - 1].replace("=", draw(st.sampled_from("=,:"))) + ending
    return [word for word in words if word != "--debug"] + (["--debugg"] if slow else [])


@examples(40)
@given(words=command_lines())
def test_command_lines(tmp_path, capsys, words):
    if not (tmp_path / "a.toml").exists():
        scene(tmp_path)
    capsys.readouterr()
    with limits(), contextlib.chdir(tmp_path):
        status = cli.main(words)
        errors = capsys.readouterr().err
        if status:
            assert status in (1, 2)
            last = errors.rstrip("\n").rpartition("\n")[2]
            lines = [line for line in errors.splitlines() if line.startswith("fidsplat: ")]
            assert [line for line in lines if not line.startswith("fidsplat: warning: ")] == [last], errors
            assert "a fault of fidsplat" not in last
            assert "Traceback" not in errors
