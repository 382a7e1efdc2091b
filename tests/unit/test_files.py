"""Files are written atomically."""

import ctypes
import json
import os
import subprocess
import sys
import threading

import cv2
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.experiments.charts import bars, chart
from fidsplat.experiments.summary import read_summary
from fidsplat.experiments.sweep import read_records
from fidsplat.formats import load_splats, save_splats
from fidsplat.formats.colmap import save_colmap
from fidsplat.images.files import read_image, read_images, write_png
from fidsplat.render.gallery import GalleryScene, write_gallery
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.sim import read_description
from fidsplat.store.build import build_store
from fidsplat.store.store import Store
from fidsplat.train import splats_of
from fidsplat.train.dataset_files import load_dataset
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write, writable_folder
from fidsplat.util.npy import load_npy


def test_a_file_takes_the_place_of_the_old_one_only_when_it_is_whole(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def write_half():
        with atomic_write(path) as stream:
            stream.write(b"half")
            raise KeyError

    with pytest.raises(KeyError):
        write_half()
    assert path.read_bytes() == b"old"
    with atomic_write(path) as stream:
        stream.write(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


def test_permissions_are_those_of_any_new_file(tmp_path):
    with atomic_write(tmp_path / "a") as stream:
        stream.write(b"x")
    (tmp_path / "b").write_bytes(b"x")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


def test_folders_are_made_and_proved(tmp_path):
    folder = writable_folder(tmp_path / "a" / "b")
    assert folder.is_dir()
    assert list(folder.iterdir()) == []
    (tmp_path / "file").write_bytes(b"")
    for bad in (tmp_path / "file", tmp_path / "file" / "below", "/proc/nowhere"):
        with pytest.raises(InputError, match="another output folder"):
            writable_folder(bad)


def test_a_folder_that_is_missing_or_full_is_an_input_error(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="cannot write"), atomic_write(tmp_path / "none" / "a"):
        pass

    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match="No space left"), atomic_write(tmp_path / "a") as stream:
        stream.write(b"x")
    assert list(tmp_path.iterdir()) == []


def test_only_regular_files_are_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match="must be a regular file"), atomic_write(pipe):
        pass
    assert pipe.is_fifo()


def test_tables_in_a_hundred_thousand_tables_are_no_data_set(tmp_path):
    (tmp_path / "transforms.json").write_text("[" * 100_000)
    with pytest.raises(InputError, match="nests too deeply"):
        load_dataset(tmp_path)


def test_a_damaged_header_is_a_damaged_array(tmp_path):
    """Whatever NumPy makes of it: its Python may end within a bracket."""
    np.save(tmp_path / "a.npy", np.zeros(3))
    contents = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(contents.replace(b"(3,)", b"(3, "))
    with pytest.raises(ValueError, match="header"):
        load_npy(tmp_path / "a.npy")


def put_scene(folder, pipe, name):
    (folder / "scene.toml").write_text(
        f'[background]\nimage = "{pipe}"\n' if name == "panorama" else f'[[splats]]\nfile = "{pipe}"\n'
    )
    return fs.Scene.load(folder / "scene.toml")


def put_gltf(folder, pipe):
    save_splats(CLOUD, folder / "a.gltf")
    document = json.loads((folder / "a.gltf").read_text())
    document["buffers"][0]["uri"] = pipe.name
    (folder / "a.gltf").write_text(json.dumps(document))
    return load_splats(folder / "a.gltf")


def put_transforms(folder, pipe, **facts):
    matrix = np.eye(4).tolist()
    write_png(folder / "a.png", np.zeros((4, 4)))
    frame = {"file_path": "a.png", "transform_matrix": matrix, "fl_x": 4.0} | facts.pop("frame", {})
    (folder / "transforms.json").write_text(json.dumps({"frames": [frame]} | facts))
    return load_dataset(folder)


def put_bag(folder, pipe, name):
    from fidsplat.logs import log_images

    (folder / "bag").mkdir()
    if name != "metadata.yaml":
        facts = f"rosbag2_bagfile_information: {{relative_file_paths: [{name}]}}\n"
        (folder / "bag" / "metadata.yaml").write_text(facts)
    pipe.rename(folder / "bag" / name)
    return next(log_images(folder / "bag"))


def put_colmap(folder, pipe, name):
    model = folder / "sparse" / "0"
    camera = fs.Camera.pinhole(4, 4, 4, 4, 2, 2)
    save_colmap(model, ["a.png"], [camera], np.zeros((1, 3)), np.zeros((1, 3), np.uint8))
    place = folder / name
    place.parent.mkdir(exist_ok=True)
    place.unlink(missing_ok=True)
    pipe.rename(place)
    return load_dataset(folder)


def put_store(folder, pipe, name):
    fs.save_ply(CLOUD, folder / "a.ply")
    build_store([folder / "a.ply"], folder / "a.fss")
    (folder / "a.fss" / name).unlink()
    pipe.rename(folder / "a.fss" / name)
    return Store(folder / "a.fss")


def in_logs(folder, pipe):
    from fidsplat.logs import log_images

    return next(log_images(pipe))


def renamed(suffix, read):
    return lambda folder, pipe: read(pipe.rename(folder / f"pipe{suffix}"))


CLOUD = fs.SplatCloud([[0, 0, 1.0]], [[1.0, 0, 0, 0]], [[0.1, 0.1]], [0.5], colors=[[1.0, 0, 0]])
INPUTS = {
    **{
        suffix: renamed(suffix, load_splats) for suffix in (".ply", ".splat", ".spz", ".sog", ".glb", ".gltf")
    },
    "buffer of glTF": put_gltf,
    "scene": lambda folder, pipe: fs.Scene.load(pipe),
    "splats of a scene": lambda folder, pipe: put_scene(folder, pipe.rename(folder / "pipe.ply"), "splats"),
    "panorama": lambda folder, pipe: put_scene(folder, pipe, "panorama"),
    "image": lambda folder, pipe: read_image(pipe),
    "image of a folder": lambda folder, pipe: next(read_images(pipe.rename(folder / "pipe.png").parent)),
    "video": renamed(".mp4", lambda pipe: next(read_images(pipe))),
    "marker image": lambda folder, pipe: fs.marker(f"image:{pipe}", size=0.1),
    "drawing": lambda folder, pipe: fs.marker(f"svg:{pipe}", size=0.1),
    **{f"trajectory {suffix}": renamed(suffix, fs.load_trajectory) for suffix in (".tum", ".json")},
    "COLMAP trajectory": renamed(".bin", fs.load_trajectory),
    "points of transforms.json": lambda folder, pipe: put_transforms(folder, pipe, ply_file_path="pipe"),
    "mask": lambda folder, pipe: put_transforms(folder, pipe, frame={"mask_path": "pipe"}),
    "image of a data set": lambda folder, pipe: put_transforms(folder, pipe, frame={"file_path": "pipe"}),
    **{
        f"COLMAP {name}": lambda folder, pipe, name=name: put_colmap(folder, pipe, name)
        for name in ("sparse/0/images.bin", "sparse/0/points3D.bin", "images/a.png", "dataset.json")
    },
    "checkpoint": lambda folder, pipe: splats_of(pipe),
    "MCAP": in_logs,
    **{
        f"bag {name}": lambda folder, pipe, n=name: put_bag(folder, pipe, n)
        for name in ("metadata.yaml", "a.db3")
    },
    "SDF": lambda folder, pipe: read_description(pipe),
    **{
        f"store {name}": lambda folder, pipe, name=name: put_store(folder, pipe, name)
        for name in ("store.json", "nodes.npy", "means.npy")
    },
    "summary": lambda folder, pipe: read_summary(pipe),
    "records": lambda folder, pipe: read_records(pipe),
}


@pytest.fixture
def pipe(tmp_path):
    """A pipe that a thread writes nothing into, whenever it is opened, so that reading ends immediately."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # later names lead to the same pipe
    done = threading.Event()

    def write():
        while not done.is_set():
            os.close(os.open(f"/proc/self/fd/{descriptor}", os.O_WRONLY))
            done.wait(0.01)

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    yield path
    done.set()
    writer.join()
    os.close(descriptor)


@pytest.mark.parametrize("name", INPUTS)
def test_a_pipe_in_place_of_an_input_is_refused_and_not_waited_for(name, tmp_path, pipe):
    with pytest.raises(InputError, match="must be a regular file, got a pipe"):
        INPUTS[name](tmp_path, pipe)


ODD = "a\udcff$x$"  # a byte that is not UTF-8, and matplotlib's marks of mathematics


@pytest.mark.parametrize("suffix", [".splat", ".spz", ".glb", ".gltf", ".usda", ".usdc", ".fss"])
def test_splat_files_with_names_that_are_not_utf8(tmp_path, suffix):
    if suffix.startswith(".usd"):
        pytest.importorskip("pxr.UsdVol", reason="pip install 'fidsplat[usd]'")
    folder = tmp_path / ODD
    folder.mkdir()
    file = folder / f"{ODD}{suffix}"
    if suffix == ".fss":
        fs.save_ply(CLOUD, folder / f"{ODD}.ply")
        build_store([folder / f"{ODD}.ply"], file)
        assert Store(file).header.splats == 1
        return
    save_splats(CLOUD, file)
    assert not file.is_symlink()
    assert len(load_splats(file)) == 1


def test_a_video_with_a_name_that_is_not_utf8_is_read(tmp_path):
    file = tmp_path / f"{ODD}.avi"
    write_avi(tmp_path / "a.avi").rename(file)
    assert [image.shape for _, image in read_images(file)] == [(48, 64, 3)] * 3


def write_avi(file):
    video = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for k in range(3):
        video.write(np.full((48, 64, 3), 80 * k, np.uint8))
    video.release()
    return file


def test_a_bag_with_a_name_that_is_not_utf8(tmp_path):
    from fidsplat.logs import RobotLog, log_images

    with RobotLog(tmp_path / ODD) as log:
        log.image(0.5, "front", np.zeros((4, 5, 3)))
    assert [one.image.shape for one in log_images(tmp_path / ODD)] == [(4, 5, 3)]


def test_pages_and_charts_of_names_that_are_not_utf8(tmp_path):
    with chart(tmp_path / f"{ODD}.svg") as (_, (axes,)):
        bars(axes, [ODD, "a$\\frac$"], {ODD: [1, 2], "b": [2, 3]})
    assert "$x$" in (tmp_path / f"{ODD}.svg").read_text()
    camera = fs.Camera.look_at(8, 6, 1.0, (0, 0, -1), (0, 0, 0))
    entry = GalleryScene(ODD, ODD, fs.Scene([CLOUD], camera=camera), "")
    *_, page = write_gallery(tmp_path / ODD, [entry], "reference")
    assert "a%FF%24x%24-rgb" in page.read_text()


def test_a_script_of_ffmpeg_is_not_a_video_and_opens_no_other_file(tmp_path):
    """FFmpeg recognises videos by their content, with any name."""
    write_avi(tmp_path / "secret.avi")
    for text in ("ffconcat version 1.0\nfile secret.avi\n", "#EXTM3U\n#EXTINF:1,\nsecret.avi\n"):
        (tmp_path / "a.mp4").write_text(text)
        with pytest.raises(InputError, match="as a video with OpenCV"):
            next(read_images(tmp_path / "a.mp4"))


def test_damaged_images_and_videos_are_one_line(tmp_path, capfd):
    """libpng and FFmpeg write to stderr by themselves."""
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    write_png(tmp_path / "a.png", noise)
    write_avi(tmp_path / "a.avi")
    for name, size in (("a.png", 4000), ("a.avi", 300)):
        os.truncate(tmp_path / name, size)
        assert main(["detect", str(tmp_path / name)]) == 2
    (tmp_path / "a.mp4").write_bytes(b"\0\0\0\x18ftypisom" + bytes(90))
    assert main(["detect", str(tmp_path / "a.mp4")]) == 2
    out, err = capfd.readouterr()
    assert [line[:9] for line in (out + err).splitlines()] == ["fidsplat:"] * 3


def test_a_durable_file_is_on_the_disk_before_it_takes_its_place(tmp_path, monkeypatch):
    done, sync, replace = [], os.fsync, os.replace

    def synced(descriptor):
        done.append("folder" if os.path.isdir(f"/proc/self/fd/{descriptor}") else "file")
        sync(descriptor)

    def replaced(*names):
        done.append("replace")
        replace(*names)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", replaced)
    with atomic_write(tmp_path / "a", durable=True) as stream:
        stream.write(b"x")
    assert done == ["file", "replace", "folder"]


@pytest.mark.parametrize("value", ["1" + "0" * 400, "1e999"])
def test_a_pose_beyond_all_numbers_is_an_input_error(tmp_path, value):
    matrix = [[1, 0, 0, 7], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    text = json.dumps({"frames": [{"file_path": "a.png", "transform_matrix": matrix}]})
    (tmp_path / "transforms.json").write_text(text.replace("7", value))
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(InputError, match="transform_matrix must be 4 x 4 finite numbers"):
        load_dataset(tmp_path)


def test_an_array_of_usd_that_is_damaged_is_an_input_error(tmp_path):
    """USD reads arrays late, when they are requested."""
    pytest.importorskip("pxr.UsdVol", reason="pip install 'fidsplat[usd]'")
    means = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    ones = np.ones((50, 4))
    cloud = fs.SplatCloud(means, ones, ones[:, :2], ones[:, 0], colors=ones[:, :3])
    save_splats(cloud, tmp_path / "a.usdc")
    data = bytearray((tmp_path / "a.usdc").read_bytes())
    count = data.index(cloud.means.tobytes()) - 8
    assert int.from_bytes(data[count : count + 8], "little") == 50
    data[count : count + 8] = (2**60).to_bytes(8, "little")
    (tmp_path / "a.usdc").write_bytes(data)
    with pytest.raises(InputError, match="not a USD file that usd-core can read"):
        load_splats(tmp_path / "a.usdc")


def test_a_bag_that_names_a_file_outside_of_it(tmp_path):
    """The file of that name within the bag is meant, or none."""
    from fidsplat.logs import RobotLog, log_images

    for name in ("bag", "other"):
        with RobotLog(tmp_path / name) as log:
            log.image(0.5, "front", np.zeros((4, 5, 3)))
    (tmp_path / "other" / "other.db3").rename(tmp_path / "other.db3")
    note = tmp_path / "bag" / "metadata.yaml"
    note.write_text(note.read_text().replace("bag.db3", "../other.db3"))
    with pytest.raises(InputError, match=r"cannot read .*bag/other\.db3"):
        next(log_images(tmp_path / "bag"))


DROP = 24
"""prctl's operation that removes a capability from those of later programs"""
LINES = [
    "info DIR/a.ply",
    "convert DIR/a.spz out.ply",
    "convert good.ply DIR/out.ply",
    "detect DIR/a.png",
    "store info DIR",
    "store verify DIR/a.fss",
    "train DIR -o out.ply",
    "marker qr:a -o DIR/a.ply",
    "experiment report DIR -o out",
]


@pytest.mark.skipif(sys.platform != "linux", reason="root has Linux's capabilities")
def test_paths_without_permission_are_one_line(tmp_path):
    """As a user other than root, who may access all folders."""
    library = ctypes.CDLL(None)
    save_splats(random_splats(3, 0), tmp_path / "good.ply")
    (tmp_path / "closed").mkdir(mode=0)
    code = "import sys; from fidsplat import cli; [print(cli.main(line.split())) for line in sys.argv[1:]]"
    done = subprocess.run(
        [sys.executable, "-c", code, *(line.replace("DIR", "closed") for line in LINES)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        preexec_fn=lambda: [library.prctl(DROP, capability, 0, 0, 0) for capability in (1, 2)],
    )
    assert set(done.stdout.split()) <= {"1", "2"}
    errors = [line for line in done.stderr.splitlines() if "warning" not in line]
    assert len(errors) == len(LINES)
    for line in errors:
        assert "Permission denied" in line, errors
        assert "a fault of fidsplat" not in line, errors
