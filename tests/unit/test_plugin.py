"""The template package of examples/plugin, installed: its marker, output and sensor step in saved scenes."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.backends.opencl.effect_code import EFFECT_CODE
from fidsplat.cli import main
from fidsplat.effects import CATALOGUE, IMAGES, OUTPUTS, extensions, select
from fidsplat.markers import Kind, kinds, marker
from fidsplat.util.plugins import load_plugins

TEMPLATE = Path(__file__).parents[2] / "examples" / "plugin"
SCENE = """
[camera]
width = 96
height = 80
fov_x_deg = 60.0
position = [0.02, 0.01, -0.25]
look_at = [0.0, 0.0, 0.0]
[[markers]]
spec = "datamatrix:hello"
size = 0.16
[sensor]
extra_steps = ["tint:0.5,1,1"]
[render]
background = [0.5, 0.5, 0.5]
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The folder that the package is installed into, without the network."""
    target = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-index", "--no-deps", "--no-build-isolation"]
    done = subprocess.run([*pip, "--target", target, TEMPLATE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return target


@pytest.fixture
def plugin(installed, monkeypatch):
    """The package is importable; its registrations are removed afterwards."""
    registries = (kinds._kinds, CATALOGUE, IMAGES, OUTPUTS, EFFECT_CODE, extensions.EXTENSIONS)
    before = [dict(registry) for registry in registries]
    monkeypatch.syspath_prepend(str(installed))
    load_plugins.cache_clear()
    yield
    load_plugins.cache_clear()
    for registry, items in zip(registries, before, strict=True):
        registry.clear()
        registry.update(items)


def test_a_saved_scene_with_a_plugin_is_rendered_and_detected(plugin, tmp_path, capsys):
    scene, out = tmp_path / "scene.toml", tmp_path / "out"
    scene.write_text(SCENE)
    again = tmp_path / "again.toml"
    fs.Scene.load(scene).save(again)
    assert (
        main(["render", str(again), "-o", str(out), "--outputs", "rgb,strongest", "--device", "opencl"]) == 0
    )
    assert np.isin(np.load(out / "strongest.npy"), (0.0, 1.0)).mean() > 0.9  # opaque boxes, or nothing
    capsys.readouterr()
    assert main(["detect", str(out / "rgb.png"), "--scene", str(again), "--json"]) == 0
    (reading,) = json.loads(capsys.readouterr().out)["markers"]
    assert reading["marker"] == "datamatrix:hello"
    assert reading["found"]
    assert reading["corner_error_px"] < 2  # zxing-cpp reports whole pixels
    assert cv2.imread(str(out / "rgb.png")).max((0, 1)).tolist() == [255, 255, 128]  # blue, green, red


def test_errors_name_the_plugin_and_what_it_needs(plugin):
    cloud, camera = marker("qr:a", size=0.1).cloud, fs.Camera.pinhole(8, 8, 8.0, 8.0, 4.0, 4.0)
    for steps, says in ((("tint",), "must be tint:red,green,blue"), (("tnt:1",), "did you mean 'tint'")):
        with pytest.raises(fs.InputError, match=says):
            fs.Renderer("opencl").render(cloud, camera, sensor=fs.Sensor(extra_steps=steps))
    with pytest.raises(fs.DeviceError, match="reference has no strongest"):
        fs.Renderer("reference").render(cloud, camera, outputs=("strongest",))
    with pytest.raises(fs.InputError, match="or datamatrix:TEXT"):
        marker("datamatrices:a")
    with pytest.raises(fs.InputError, match="new identifier, got 'depth'"):
        extensions.register(extensions.Extension("depth", TEMPLATE))
    with pytest.raises(fs.InputError, match="extra_steps must be"):
        fs.Sensor(extra_steps=("tint:a",))


def test_a_file_for_warp_is_found(plugin, tmp_path, monkeypatch):
    runtime = pytest.importorskip("fidsplat.backends.warp.runtime")
    backend, home = fs.Renderer("warp:cpu").backend, runtime.kernels("output")
    monkeypatch.setattr(home, "__path__", [*home.__path__])
    features = select(fs.SplatCloud.empty(), fs.Capture(outputs=("strongest",)))
    assert "has no strongest" in backend.unsupported(features)
    (tmp_path / "strongest.py").touch()
    own = replace(extensions.EXTENSIONS["strongest"], warp=tmp_path)
    monkeypatch.setitem(extensions.EXTENSIONS, "strongest", own)
    assert backend.unsupported(features) == ""


def test_a_plugin_that_fails_is_a_warning(plugin, monkeypatch):
    clash = Kind("qr", "qr:X", 0, lambda *_: None, lambda spec: spec)  # type: ignore[arg-type]
    monkeypatch.setattr("importlib.metadata.EntryPoint.load", lambda entry: clash)
    with (
        pytest.warns(UserWarning, match="datamatrix of fidsplat-example must load and register"),
        pytest.raises(fs.InputError, match="unknown kind of marker 'datamatrix'"),
    ):
        marker("datamatrix:a")
