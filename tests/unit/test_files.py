"""Files appear whole or not at all."""

import json
import os
import threading

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.errors import InputError
from fidsplat.experiments.summary import read_summary
from fidsplat.experiments.sweep import read_records
from fidsplat.files import atomic_write, writable_folder
from fidsplat.formats import load_splats, save_splats
from fidsplat.formats.colmap import save_colmap
from fidsplat.sim import read_description
from fidsplat.store.build import build_store
from fidsplat.store.layout import load_array
from fidsplat.store.store import Store
from fidsplat.train import splats_of
from fidsplat.train.read import load_dataset
from fidsplat.vision.images import pictures, read_image, write_png
from fidsplat.vision.metrics import load_lpips


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


def test_what_is_no_ordinary_file_is_not_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match="not an ordinary file"), atomic_write(pipe):
        pass
    assert pipe.is_fifo()


def test_tables_in_a_hundred_thousand_tables_are_no_data_set(tmp_path):
    (tmp_path / "transforms.json").write_text("[" * 100_000)
    with pytest.raises(InputError, match="nests too deeply"):
        load_dataset(tmp_path)


def test_a_damaged_header_is_a_damaged_array(tmp_path):
    """Whatever NumPy makes of it: its Python may end within a bracket."""
    np.save(tmp_path / "a.npy", np.zeros(3))
    whole = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(whole.replace(b"(3,)", b"(3, "))
    with pytest.raises(ValueError, match="header"):
        load_array(tmp_path / "a.npy")


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
    from fidsplat.logs import log_pictures

    (folder / "bag").mkdir()
    pipe.rename(folder / "bag" / name)
    return next(log_pictures(folder / "bag"))


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
    from fidsplat.logs import log_pictures

    return next(log_pictures(pipe))


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
    "picture": lambda folder, pipe: read_image(pipe),
    "picture of a folder": lambda folder, pipe: next(pictures(pipe.rename(folder / "pipe.png").parent)),
    "video": renamed(".mp4", lambda pipe: next(pictures(pipe))),
    "marker image": lambda folder, pipe: fs.marker(f"image:{pipe}", size=0.1),
    "drawing": lambda folder, pipe: fs.marker(f"svg:{pipe}", size=0.1),
    **{f"trajectory {suffix}": renamed(suffix, fs.load_trajectory) for suffix in (".tum", ".json")},
    "COLMAP trajectory": renamed(".bin", fs.load_trajectory),
    "points of transforms.json": lambda folder, pipe: put_transforms(folder, pipe, ply_file_path="pipe"),
    "mask": lambda folder, pipe: put_transforms(folder, pipe, frame={"mask_path": "pipe"}),
    "picture of a data set": lambda folder, pipe: put_transforms(folder, pipe, frame={"file_path": "pipe"}),
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
    "weights": lambda folder, pipe: load_lpips(pipe),
    "summary": lambda folder, pipe: read_summary(pipe),
    "records": lambda folder, pipe: read_records(pipe),
}


@pytest.fixture
def pipe(tmp_path):
    """A pipe that a thread writes nothing into, as often as somebody opens it: to read it ends, at once."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    kept = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # later names lead to the same pipe
    done = threading.Event()

    def write():
        while not done.is_set():
            os.close(os.open(f"/proc/self/fd/{kept}", os.O_WRONLY))
            done.wait(0.01)

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    yield path
    done.set()
    writer.join()
    os.close(kept)


@pytest.mark.parametrize("name", INPUTS)
def test_a_pipe_in_place_of_an_input_is_refused_and_not_waited_for(name, tmp_path, pipe):
    with pytest.raises(InputError, match="must be a regular file, got a pipe"):
        INPUTS[name](tmp_path, pipe)
