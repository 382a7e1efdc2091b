"""Self-contained HTML pages: their content, the download of the engine, and images of a headless
Chromium.

The browser's test is skipped without Chromium (Debian: apt-get install chromium), and without the PlayCanvas
Engine in the user's cache, which `fidsplat convert SCENE.toml SCENE.html` downloads once by npm.
"""

import base64
import io
import re
import tarfile
import time

import chromium
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.images.files import to_uint8
from fidsplat.util.files import user_cache
from fidsplat.viewer import scene_page
from fidsplat.vision.detect import detect

ENGINE = user_cache() / "fidsplat" / f"playcanvas-{scene_page.VERSION}" / "playcanvas.min.js"
SCENE = """
[camera]
width = 320
height = 240
fov_x_deg = 60.0
position = [0.3, -0.4, -1.5]
look_at = [0.0, 0.0, 0.0]
[[splats]]
file = "blob.ply"
[[markers]]
spec = "apriltag:36h11:5"
size = 0.6
[render]
background = [0.2, 0.4, 0.6]
"""


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A scene file with a red blob to the left of a tag."""
    blob = fs.SplatCloud([[-0.65, 0.1, 0]], [[1, 0, 0, 0]], [[0.08, 0.04, 0.04]], [0.99], colors=[[1, 0, 0]])
    fs.save_splats(blob, tmp_path / "blob.ply")
    (tmp_path / "scene.toml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "scene.toml"


def test_a_page_has_engine_licence_and_splats(scene, tmp_path, monkeypatch, capsys):
    (tmp_path / "engine.js").write_text("/* engine </script> <!-- */")
    (tmp_path / "LICENSE").write_text("MIT of someone")
    monkeypatch.setenv("FIDSPLAT_PLAYCANVAS", str(tmp_path / "engine.js"))
    assert main(["convert", "scene.toml", "a.html"]) == 0
    assert "bytes, with PlayCanvas Engine" in capsys.readouterr().out
    page = (tmp_path / "a.html").read_text()
    assert "MIT of someone" in page
    assert page.count("</script") == 2
    assert not re.search(r"(src|href)=", page)  # nothing from elsewhere
    (tmp_path / "m.ply").write_bytes(base64.b64decode(re.search(r'"markers.ply": "([^"]+)"', page)[1]))
    assert len(fs.load_splats(tmp_path / "m.ply")) == len(fs.marker("apriltag:36h11:5", size=0.6).gaussians)
    assert main(["convert", "scene.toml", "a.html"]) == 2
    assert "already exists" in capsys.readouterr().err


def test_a_page_needs_a_camera_and_splats(scene, tmp_path, monkeypatch):
    with pytest.raises(fs.InputError, match="must have a camera"):
        scene_page.save_page(fs.Scene(), tmp_path / "a.html")
    camera = fs.Camera.look_at(32, 24, 1.0, (0, 0, -1), (0, 0, 0))
    with pytest.raises(fs.InputError, match="must have splats or markers"):
        scene_page.save_page(fs.Scene(camera=camera), tmp_path / "a.html")
    monkeypatch.setattr(scene_page, "MAX_SPLATS", 0)
    with pytest.raises(fs.InputError, match="must have at most 0 splats, got 1"):
        scene_page.save_page(fs.Scene.load(scene), tmp_path / "a.html")


def test_the_engine_is_checked(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def pack(words):
        with tarfile.open(f"{words[words.index('--pack-destination') + 1]}/a.tgz", "w:gz") as archive:
            for name in ("package/build/playcanvas.min.js", "package/LICENSE"):
                archive.addfile(tarfile.TarInfo(name), io.BytesIO())
        return "a.tgz\n"

    with pytest.raises(fs.InputError, match=r"of playcanvas must have the SHA-256 fea87830"):
        scene_page.engine_files(pack)
    assert not list(tmp_path.rglob("*.js"))
    monkeypatch.setattr("shutil.which", lambda _: None)
    with pytest.raises(fs.InputError, match="install npm, or set FIDSPLAT_PLAYCANVAS"):
        scene_page.engine_files()


@pytest.mark.skipif(chromium.program() is None, reason="no Chromium here")
@pytest.mark.skipif(not ENGINE.is_file(), reason="the PlayCanvas Engine is not in the user's cache")
def test_a_browser_shows_the_scene(scene, tmp_path):
    pytest.importorskip("websockets", reason="the extra viewer is not installed")
    assert main(["convert", "scene.toml", "a.html"]) == 0
    loaded = fs.Scene.load(scene)
    rendered = to_uint8(fs.Renderer("opencl").render(loaded)["rgb"])
    frames = "Number(document.body?.dataset.frames ?? 0)"
    with chromium.Page((tmp_path / "a.html").as_uri(), 320, 240) as page:
        end = time.monotonic() + 60
        while page.evaluate(frames) < 6:
            assert time.monotonic() < end, page.evaluate("document.getElementById('note')?.textContent")
            time.sleep(0.1)
        shown = page.screenshot()
        (detection,) = detect(shown)
        assert detection.payload == detect(rendered)[0].payload
        np.testing.assert_allclose(detection.corners, detect(rendered)[0].corners, atol=1.0)
        part = slice(0, 210)  # above the text
        assert np.abs(shown[part].astype(int) - rendered[part]).mean() < 4
        red = lambda image: np.argwhere(image[:, :, 0] > image[:, :, 2].astype(int) + 100).mean(0)  # noqa: E731
        np.testing.assert_allclose(red(shown), red(rendered), atol=1.0)
        before = shown.astype(int)
        page.drag((160, 60), (190, 70))
        time.sleep(0.5)
        assert np.abs(page.screenshot() - before).mean() > 1
