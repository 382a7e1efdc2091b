"""Work for other processes: the queue, and flights whose images return as bytes."""

import pickle
from collections import Counter

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.remote.flights import FlightWork, render_flight
from fidsplat.remote.queue import ATTEMPTS, WorkerLost, drain
from fidsplat.remote.ray_engine import _per_worker
from fidsplat.render.flight import Flight, FlightFolder
from fidsplat.scenes import PlacedMarker


class Here:
    """An engine in this process whose workers die at a given item."""

    def __init__(self, work=lambda item: item, dies=()):
        self.work, self.dies = work, list(dies)
        self.started, self.waits, self.had = 0, 0, Counter()

    def start(self):
        self.started += 1
        return self.started

    def submit(self, worker, item):
        self.had[worker] += 1
        return worker, item, (worker, self.had[worker]) in self.dies

    def wait(self, tickets):
        self.waits += 1
        return tickets[-self.waits % len(tickets)]  # not in their order

    def result(self, ticket):
        _, item, dead = ticket
        if dead:
            raise WorkerLost("killed")
        return self.work(item)


def test_every_item_is_done_and_none_twice_though_workers_die():
    done = Counter()

    def work(item):
        done[item] += 1
        return 10 * item

    engine = Here(work, dies=[(1, 1), (2, 3), (4, 2)])
    actual = list(drain(engine, range(20), workers=3))
    assert set(done.values()) == {1}
    assert sorted(actual) == [(k, 10 * k) for k in range(20)]
    assert engine.started == 3 + 3  # another for each that died


def test_there_are_no_more_workers_than_items():
    engine = Here()
    assert sorted(item for item, _ in drain(engine, range(2), workers=8)) == [0, 1]
    assert engine.started == 2
    assert list(drain(engine, [], workers=8)) == []


def test_an_item_that_kills_its_workers_is_named():
    dies = [(worker, 1) for worker in range(1, 9)]
    engine = Here(dies=dies)
    with pytest.raises(fs.FidsplatError, match=f"7 has lost {ATTEMPTS} workers, the last one: killed"):
        list(drain(engine, [7], workers=1))
    assert engine.started == ATTEMPTS


@pytest.mark.parametrize(
    ("count", "workers", "fraction"), [(8, 3, 1), (2, 2, 1), (2, 3, 0.5), (2, 5, 1 / 3), (0, 4, 0)]
)
def test_every_worker_finds_a_place(count, workers, fraction):
    assert _per_worker(count, workers) == fraction
    assert count == 0 or count * int(1 / fraction) >= workers  # however they are spread


def flight(**parts) -> Flight:
    scene = fs.Scene(
        markers=[PlacedMarker(fs.marker("aruco:4x4_50:7", size=0.4))],
        camera=fs.Camera.look_at(16, 12, 1.0, (0, 0, -1), (0, 0, 0)),
        outputs=("rgb", "depth"),
        **parts,
    )
    path = fs.Trajectory([0.0, 1.0], [[0, 0, -1, 1, 0, 0, 0], [0.3, 0, -1, 1, 0, 0, 0]])
    return Flight(scene, path, np.linspace(0, 1, 5), scene.capture)


def test_workers_return_the_files_that_one_process_writes(tmp_path):
    flown = flight(sensor=fs.Sensor(bits=16))
    renderer = fs.Renderer("reference")
    single = FlightFolder(tmp_path / "single", flown, renderer.device.title)
    list(single.render(renderer))
    work = pickle.loads(pickle.dumps(FlightWork(flown, "reference")))()
    assert work.title == renderer.device.title
    folder = FlightFolder(tmp_path / "many", flown, work.title)
    folder.file(3, "rgb", ".png").write_bytes(single.file(3, "rgb", ".png").read_bytes())
    rendered = list(render_flight(folder, Here(work, dies=[(1, 2), (3, 1)]), 2))
    assert sorted(rendered) == [0, 1, 2, 3, 4]  # the depth of frame 3 was missing
    files = {file.relative_to(single.folder): file.read_bytes() for file in single.folder.glob("*/*")}
    assert len(files) == 5 * 4  # rgb, and an array and two images of depth
    assert {file.relative_to(folder.folder): file.read_bytes() for file in folder.folder.glob("*/*")} == files
    assert list(render_flight(folder, Here(work), 2)) == []


@pytest.mark.parametrize(
    "reply",
    [
        None,
        [],
        {},
        {("rgb", ".png"): b"x"},
        {("../../rgb", ".png"): b"x", ("depth", ".npy"): b"x"},
        {("rgb", ".png"): "text", **{("depth", end): b"x" for end in (".npy", ".png", "-turbo.png")}},
        {("rgb", ".png"): b"", **{("depth", end): b"x" for end in (".npy", ".png", "-turbo.png")}},
        {(name, end): b"x" for name in ("rgb", "depth") for end in (".npy", ".png", "-turbo.png", "/../x")},
    ],
    ids=range(8),
)  # fmt: skip
def test_replies_that_are_no_files_of_the_image(tmp_path, reply):
    folder = FlightFolder(tmp_path / "flight", flight(), "a device")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(fs.FidsplatError, match="reply of a worker must be the files of the outputs of image"):
        list(render_flight(folder, Here(lambda _: reply), 2))
    assert sorted(tmp_path.rglob("*")) == before


def test_workers_read_stores_at_the_same_path(tmp_path):
    cloud = fs.marker("aruco:4x4_50:7", size=0.4, mixture="fitted").cloud
    fs.save_ply(cloud, tmp_path / "a.ply")
    store = fs.Store(fs.build_store([tmp_path / "a.ply"], tmp_path / "a.fss"))
    flown = flight(stores=(store,))
    sent = pickle.dumps(FlightWork(flown, "reference"))
    ours, here = pickle.loads(sent)()(2), FlightWork(flown, "reference")()(2)
    assert ours == here
    store.path.rename(tmp_path / "b.fss")
    with pytest.raises(
        fs.InputError, match=r"must have access to all stores, got on .*a\.fss must be the folder of a store"
    ):
        pickle.loads(sent)()
    fs.save_ply(fs.marker("aruco:4x4_50:3", size=0.4, mixture="fitted").cloud, tmp_path / "a.ply")
    fs.build_store([tmp_path / "a.ply"], tmp_path / "a.fss")
    with pytest.raises(fs.InputError, match=r"a\.fss on .* must be the same store as here"):
        pickle.loads(sent)()


def test_unusable_options(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words, message in (
        (("--workers", "2"), "must be given with --ray ADDRESS"),
        (("--ray", "local", "--workers", "0"), "must be at least 1, got 0"),
    ):
        assert main(["fly", "none.toml", *words]) == 2
        assert message in capsys.readouterr().err
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    from fidsplat.remote.ray_engine import ray_engine

    with pytest.raises(fs.InputError, match=r"pip install 'fidsplat\[ray\]'"), ray_engine("local", int):
        pass
