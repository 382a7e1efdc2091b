"""Flights by Ray, on a cluster of this machine. Skipped without the extra."""

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.remote import ray_engine as module
from fidsplat.remote.flights import FlightWork, render_flight
from fidsplat.remote.queue import WorkerLost
from fidsplat.remote.ray_engine import ray_engine
from fidsplat.render.flight import Flight, FlightFolder
from fidsplat.scenes import PlacedMarker

ray = pytest.importorskip("ray", reason="the extra ray is not installed")
VIEWS = 12


@pytest.fixture(scope="module", autouse=True)
def cluster():
    """A cluster that stays open, as if another program had started it."""
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    yield
    ray.shutdown()


def flight() -> Flight:
    scene = fs.Scene(
        markers=[PlacedMarker(fs.marker("aruco:4x4_50:7", size=0.4))],
        camera=fs.Camera.look_at(16, 12, 1.0, (0, 0, -1), (0, 0, 0)),
    )
    path = fs.Trajectory([0.0, 1.0], [[0, 0, -1, 1, 0, 0, 0], [0.3, 0, -1, 1, 0, 0, 0]])
    return Flight(scene, path, np.linspace(0, 1, VIEWS), scene.capture)


def test_a_worker_that_is_killed_costs_no_image_and_none_is_rendered_twice(tmp_path):
    flown = flight()
    with ray_engine("local", FlightWork(flown, "reference"), workers=3) as engine:  # of two cores
        folder = FlightFolder(tmp_path / "many", flown, engine.title)
        rendered = []
        for k in render_flight(folder, engine, engine.workers):
            rendered.append(k)
            if len(rendered) == 3:
                ray.kill(engine._actors[0])
        assert len(engine._actors) == 4
    assert sorted(rendered) == list(range(VIEWS))
    assert folder.remaining() == []
    single = FlightFolder(tmp_path / "single", flown, engine.title)
    list(single.render(fs.Renderer("reference")))
    for k in range(VIEWS):
        assert folder.file(k, "rgb", ".png").read_bytes() == single.file(k, "rgb", ".png").read_bytes()


def test_a_worker_with_another_fidsplat_is_refused(monkeypatch):
    monkeypatch.setattr(module, "identity", lambda: ("0.0.1", "1234"))
    with (
        pytest.raises(
            fs.InputError, match=r"has fidsplat .*, and this is 0\.0\.1, code 1234; install the same"
        ),
        ray_engine("local", FlightWork(flight(), "reference"), workers=1),
    ):
        pass


def test_what_a_device_refuses_is_said_once(tmp_path):
    with (
        pytest.raises(fs.DeviceError, match="nowhere"),
        ray_engine("local", FlightWork(flight(), "opencl:nowhere"), workers=2),
    ):
        pass


def test_the_command_renders_by_workers(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(
        "[camera]\nwidth = 16\nheight = 12\nfov_x_deg = 60.0\nposition = [0.0, 0.0, -1.0]\n"
        'look_at = [0.0, 0.0, 0.0]\n[[markers]]\nspec = "aruco:4x4_50:7"\nsize = 0.4\n'
    )
    (tmp_path / "poses.tum").write_text("0 0 0 -1 0 0 0 1\n1 0.3 0 -1 0 0 0 1\n")
    words = ["fly", "scene.toml", "--trajectory", "poses.tum", "--rate", "3", "--device", "reference"]
    assert main([*words, "-o", "many", "--ray", "local", "--workers", "1"]) == 0
    assert "4 frames" in capsys.readouterr().out
    assert main([*words, "-o", "one"]) == 0
    for name in ("rgb/000003.png", "contact-sheet.png", "trajectory.tum"):
        assert (tmp_path / "many" / name).read_bytes() == (tmp_path / "one" / name).read_bytes()
    assert main([*words, "-o", "many"]) == 0  # the same flight, whatever renders it
    assert "4 were there already" in capsys.readouterr().out


@pytest.mark.parametrize(
    "error",
    [
        ray.exceptions.OutOfMemoryError("the system's memory ran out"),
        ray.exceptions.NodeDiedError("the machine is gone"),
        ray.exceptions.ObjectLostError("00ffff", None, ""),
        ray.exceptions.WorkerCrashedError(),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_worker_is_lost_in_whatever_way_it_ends(monkeypatch, error):
    """Ray says not only of an actor that it died."""

    def gone(ticket):
        raise error

    monkeypatch.setattr(ray, "get", gone)
    engine = object.__new__(module.RayEngine)
    with pytest.raises(WorkerLost):
        engine.result("ticket")
