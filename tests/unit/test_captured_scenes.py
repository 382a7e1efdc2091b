"""Captured scenes by name: downloads with checksums, from a folder instead of the network."""

import hashlib
import os
import socket
import subprocess
import sys
import threading

import pytest

import fidsplat as fs
from fidsplat import cli
from fidsplat.scenes import captured
from fidsplat.scenes.captured import CapturedScene, captured_scenes

DATA = b"splats" * 100


@pytest.fixture
def mirror(tmp_path, monkeypatch):
    """A folder in place of the network, with one scene of two files."""
    folder = tmp_path / "mirror"
    (folder / "part").mkdir(parents=True)
    files = {}
    for name, data in (("one.ply", DATA), ("part/two.ply", DATA[:-1])):
        (folder / name).write_bytes(data)
        files[name] = (len(data), hashlib.sha256(data).hexdigest())
    scene = CapturedScene("some", "Some", 5, "Someone", "MIT", "here", "http://0.0.0.0:1/", "one.ply", files)
    monkeypatch.setattr(captured, "captured_scenes", lambda: {"some": scene})
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("FIDSPLAT_SCENES", str(folder))
    return folder


def test_fetch_downloads_once(mirror, capsys):
    shares = []
    path = captured.fetch_scene("some", lambda _, share: shares.append(share))
    assert path.read_bytes() == DATA
    assert shares[-1] == 1.0
    (mirror / "one.ply").unlink()  # read from the cache from now on
    assert captured.fetch_scene("some") == path
    assert cli.main(["fetch", "some"]) == 0
    printed = capsys.readouterr()
    assert printed.out.strip() == str(path)
    assert "Some by Someone, MIT, here" in printed.err


@pytest.mark.parametrize("data", [DATA[:-1], DATA + b"x", b"x" * len(DATA)])
def test_fetch_refuses_another_file(mirror, data):
    (mirror / "one.ply").write_bytes(data)
    with pytest.raises(fs.InputError, match=r"must have 600 bytes and the SHA-256"):
        captured.fetch_scene("some")
    assert not list((mirror.parent / "cache").rglob("*.ply"))


def test_fetch_reports_what_failed(mirror, monkeypatch):
    with pytest.raises(fs.InputError, match="name of a captured scene"):
        captured.fetch_scene("sone")
    monkeypatch.delenv("FIDSPLAT_SCENES")
    with pytest.raises(fs.InputError, match=r"cannot download http://0.0.0.0:1/one.ply"):
        captured.fetch_scene("some")


def test_fetch_reports_a_server_that_ends_early(mirror, monkeypatch):
    def respond(server):
        with server.accept()[0] as client:
            client.recv(4096)
            client.sendall(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nab")

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=respond, args=(server,)).start()
        monkeypatch.setenv("FIDSPLAT_SCENES", f"http://127.0.0.1:{server.getsockname()[1]}")
        with pytest.raises(fs.InputError, match=r"cannot download http://127.0.0.1:\d+/one.ply: Incomplete"):
            captured.fetch_scene("some")


def test_a_download_that_hangs_ends_with_the_process(tmp_path):
    code = """import fidsplat.experiments.demo as demo
print(demo.fetch_in_background("biker")())"""
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"http://127.0.0.1:{server.getsockname()[1]}"
        changed = {"FIDSPLAT_SCENES": url, "XDG_CACHE_HOME": str(tmp_path)}
        run = subprocess.run(
            [sys.executable, "-c", code], env=os.environ | changed, capture_output=True, text=True, timeout=60
        )
    assert run.stdout == "the download of biker takes longer than the other views\n"
    assert run.stderr == ""


def test_every_scene_names_author_and_licence(capsys):
    for scene in captured_scenes().values():
        assert scene.open in scene.files
        assert all((scene.author, scene.licence, scene.source.startswith("https://")))
    assert cli.main(["fetch"]) == 0
    assert "CC-BY-4.0" in capsys.readouterr().out
