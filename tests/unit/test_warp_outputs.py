"""An output and a step after blending need one file each on Warp. Toy versions of both are in a folder
that is not part of the kernels."""

import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.backends.view import View
from fidsplat.backends.warp import runtime
from fidsplat.effects import CATALOGUE, FeatureSet, Output
from fidsplat.render.output_files import save_output
from fidsplat.selftest.agreement import compare

wp = pytest.importorskip("warp")
STRONGEST = '''"""The largest weight of a fragment: of a pixel the mean of its samples."""
from typing import Any

import warp as wp

from ..common import View
from ..pixel_grid import PixelGrid, sample_at
from . import Output


@wp.func
def composite(pixel: Any, attributes: Any, weight: float, view: View):
    p = pixel
    p.strongest = wp.max(p.strongest, weight)
    return p


@wp.func
def store(pixel: Any, at: int, samples: Any):
    samples.strongest[at] = pixel.strongest


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    total = float(0.0)
    for k in range(grid.count):
        total += samples.strongest[sample_at(grid, k)]
    out.strongest[grid.pixel] = total * grid.mean


OUTPUT = Output(
    state={"strongest": wp.float32},
    composite=composite,
    samples={"strongest": wp.float32},
    store=store,
    resolve=resolve,
)
'''
NEGATIVE = '''"""Light becomes dark."""
from typing import Any

import warp as wp

from . import Step


@wp.func
def apply(v: float, x: int, y: int, channel: int, s: Any) -> float:
    return 1.0 - v


STEP = Step(apply=apply)
'''
EFFECTS = ("camera_pinhole", "color_rgb", "lowpass_screen", "stop_inclusive", "order_centre")
CAMERA = fs.Camera.pinhole(25, 17, 20.0, 20.0, 12.5, 8.5)


def two_splats():
    """One behind the other in the middle of the image."""
    one = np.ones((2, 1), np.float32)
    means = np.float32([[0, 0, 1], [0, 0, 2]])
    return fs.SplatCloud(
        means, one * [1, 0, 0, 0], one * [0.2, 0.2], [0.25, 0.5], colors=np.float32([[1, 0, 0], [0, 1, 0]])
    )


@pytest.fixture
def beside(tmp_path, monkeypatch):
    """Add a file to the modules of a package of the kernels."""

    def put(package, name, text):
        folder, home = tmp_path / package, runtime.kernels(package)
        folder.mkdir()
        (folder / f"{name}.py").write_text(text, "utf-8")
        monkeypatch.setattr(home, "__path__", [*home.__path__, str(folder)])

    return put


def rendered(outputs, post_steps):
    """rgb and these outputs."""
    backend = fs.Renderer("warp:cpu").backend
    cloud = two_splats()
    pipeline = backend.pipeline(FeatureSet(EFFECTS, outputs, 0, 1, "float64", post_steps))
    view = View.of(fs.Capture(CAMERA), cloud.origin)
    images = pipeline.render_view(backend.upload(cloud), view)
    return {name: images.read(name, 0) for name in ("rgb", *outputs)}


def make_anew(stage, monkeypatch):
    """Kernels of a stage are rebuilt until the test ends; existing pipelines keep theirs."""
    make = getattr(runtime.kernels(stage), f"make_{stage}")
    fresh = cache(make.__wrapped__)
    for module in list(sys.modules.values()):
        if vars(module).get(make.__name__) is make:
            monkeypatch.setattr(module, make.__name__, fresh)


def test_an_output_and_a_step_are_one_file_each(beside, monkeypatch, tmp_path):
    features = FeatureSet(EFFECTS, ("strongest",), 0, 1, "float64", ("negative",))
    backend = fs.Renderer("warp:cpu").backend
    output = Output("strongest", 1, "float32", tolerance=1e-3)
    monkeypatch.setitem(CATALOGUE, "strongest", replace(CATALOGUE["alpha"], name="strongest", output=output))
    monkeypatch.setitem(CATALOGUE, "negative", replace(CATALOGUE["gain"], name="negative"))
    with pytest.raises(fs.DeviceError, match=r"warp:cpu .* has no negative, strongest; use an OpenCL device"):
        backend.pipeline(features)
    beside("output", "strongest", STRONGEST)
    beside("post", "negative", NEGATIVE)
    assert not backend.unsupported(features)
    plain, toys = rendered((), ()), rendered(("strongest",), ("negative",))
    assert np.array_equal(toys["rgb"], np.float32(1) - plain["rgb"])
    # the nearer splat lets three quarters through, of which the other takes up to a half
    assert np.array_equal(toys["strongest"], plain["rgb"][..., :2].max(-1))
    assert toys["strongest"].max() == pytest.approx(0.375)
    # files and the comparison with the reference follow from the declaration
    files = save_output("strongest", toys["strongest"], lambda name, suffix: tmp_path / f"{name}{suffix}")
    assert [file.name for file in files] == ["strongest.png"]
    expected = {name: toys[name].astype(float) for name in ("rgb", "strongest")}
    expected |= {"error_bound": np.zeros(toys["strongest"].shape)}
    expected |= {"error_bound_strongest": np.zeros(toys["strongest"].shape)}
    for error, agrees in ((0.9e-3, True), (1.1e-3, False)):
        [difference] = compare({"strongest": toys["strongest"] + error}, expected, ("strongest",))
        assert difference.agrees == agrees

    # an output whose file has changed, which Warp's cache would not read_attributes, is compiled again
    largest, sum_of_all = "wp.max(p.strongest, weight)", "p.strongest + weight"
    (tmp_path / "output" / "strongest.py").write_text(STRONGEST.replace(largest, sum_of_all), "utf-8")
    del sys.modules[f"{runtime.kernels('output').__name__}.strongest"]
    for stage in ("pixel", "blend", "resolve"):
        make_anew(stage, monkeypatch)
    changed = rendered(("strongest",), ())["strongest"]
    assert np.array_equal(changed, plain["rgb"][..., :2].sum(-1))
    assert not np.array_equal(changed, toys["strongest"])


def test_two_outputs_that_keep_a_field_of_one_name_are_distinguished(beside):
    text = "import warp as wp\nfrom . import Output\nOUTPUT = Output(state={'normal': wp.float32})\n"
    beside("output", "taken", text)
    output = runtime.kernels("output")
    with pytest.raises(
        ValueError,
        match="state of the Warp output taken must have new names, got 'normal', which another output",
    ):
        output.fields(output.with_needed(("normal", "taken")), "state")
