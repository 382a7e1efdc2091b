"""The output `error`: never less than the distance to the ideal, which NumPy composes without any cut-off."""

import hashlib
import math
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
from brute_force import ideal

import fidsplat as fs
from fidsplat.effects.catalogue import CATALOGUE
from fidsplat.render import certified_error
from fidsplat.render.certified_error import MAX_OMITTED, error_reference
from fidsplat.util.errors import InputError

HAZE = fs.Camera.pinhole(64, 48, 60.0, 60.0, 32.0, 24.0)
MIDDLE = fs.Camera.pinhole(16, 12, 60.0, 60.0, 8.0, 6.0)  # of HAZE
RIM = fs.Camera.pinhole(16, 12, 60.0, 60.0, -16.0, 6.0)  # next to it, 16 to 32 pixels from the haze's middle
SMALL = fs.Camera.pinhole(16, 12, 15.0, 15.0, 8.0, 6.0)
OUTPUTS = ("rgb", "error")


def facing(depths, scale, opacities, colors, spread=0.0, seed=0):
    """Splats that face the camera, at these depths."""
    n, generator = len(depths), np.random.default_rng(seed)
    means = np.column_stack([*generator.normal(0.0, spread, (2, n)), depths])
    sizes = np.full((n, 2), scale)
    return fs.SplatCloud(means, np.tile([1.0, 0, 0, 0], (n, 1)), sizes, opacities, colors=colors)


def haze(n, opacity):
    """White splats in one place, 2 m away."""
    return facing(np.full(n, 2.0), 0.25, np.full(n, opacity), np.ones((n, 3)))


def lamp():
    """A light of 100 behind black splats that are nearly opaque."""
    colors = np.zeros((6, 3))
    colors[5] = 100.0
    return facing(1.0 + 0.1 * np.arange(6), 0.5, [0.9, 0.9, 0.9, 0.9, 0.5, 1.0], colors)


def needle():
    """So thin and so far from facing the camera that float32 moves it by much of its width."""
    half = math.radians(89.0) / 2
    quat = [[math.cos(half), 0.6 * math.sin(half), 0.8 * math.sin(half), 0.0]]
    return fs.SplatCloud([(0.01, 0.02, 1.0)], quat, [(2.0, 1e-3)], [1.0], colors=[(1.0, 0.5, 1.0)])


def anything(seed):
    """Any splats, camera, quality and background: through the near plane, edge-on, needles, SH, colours below
    0 and above 1."""
    g = np.random.default_rng(seed)
    n = int(g.choice([5, 40, 200]))
    means = g.normal(size=(n, 3)) * g.choice([0.1, 1, 3]) + [0, 0, g.choice([0, 0.5, 2, 6])]
    edge_on = np.tile([math.sqrt(0.5), 0, math.sqrt(0.5), 0], (n, 1)) + g.normal(size=(n, 4)) * 1e-6
    quats = edge_on if seed % 4 == 1 else g.normal(size=(n, 4))
    scales = np.exp(g.normal(np.log(g.choice([0.001, 0.05, 0.5])), g.choice([0.3, 2]), (n, 2)))
    opacities = g.choice([1e-6, 1e-4, 1e-2, 0.5, 0.99, 1.0], n)
    colors = (
        {"sh": g.normal(size=(n, 9, 3))} if seed % 3 == 0 else {"colors": g.choice([0, 1, -1, 100], (n, 3))}
    )
    cloud = fs.SplatCloud(means, quats, scales, opacities, **colors)
    camera = fs.Camera.look_at(24, 17, float(g.choice([0.5, 1.5])), g.normal(size=3) * 0.2, (0, 0, 3))
    name, lowpass = g.choice(["standard", "fast", "gsplat"]), ("screen", "none")[seed % 2]
    quality = fs.Quality.named(str(name)).with_(order="centre", lowpass=lowpass, samples=1 + seed % 2)
    return cloud, camera, quality, tuple(g.random(3) * 10)


_IDEALS: dict[bytes, np.ndarray] = {}
"""composed once for all devices"""


def check(renderer, cloud, camera, quality=None, background=(0.0, 0.0, 0.0)):
    """The frame, and how far it is off per pixel; it is the frame without the output, and the bound holds."""
    quality = fs.Quality.of(quality)
    frame = renderer.render(cloud, camera, OUTPUTS, quality, background=background)
    plain = renderer.render(cloud, camera, quality=quality, background=background)
    assert np.array_equal(frame["rgb"], plain["rgb"])
    key = hashlib.sha256(pickle.dumps((cloud, camera, quality, background))).digest()
    if key not in _IDEALS:
        _IDEALS[key] = ideal(cloud, camera, quality, background)
    off = np.abs(frame["rgb"] - _IDEALS[key]).max(axis=2)
    assert frame["error"].shape == off.shape
    assert frame["error"].dtype == np.float32
    assert (frame["error"] >= off).all(), (frame["error"] - off).min()
    return frame, off


@pytest.mark.parametrize(
    ("n", "opacity", "camera", "wrong"),
    [(300, 1e-3, HAZE, 1.4), (1000, 1e-3, RIM, 4.0), (3000, 1e-3, RIM, 7.9), (10_000, 9.9e-6, MIDDLE, 48.0)],
)
def test_haze_below_the_cutoff_is_counted(renderer, n, opacity, camera, wrong):
    """By how much `standard` is wrong, in half 8-bit levels."""
    frame, off = check(renderer, haze(n, opacity), camera)
    assert off.max() > wrong / 512
    assert frame["error"].max() < 1.1 * off.max()  # and the bound is of use


def test_light_behind_the_stop_is_counted(renderer):
    frame, off = check(renderer, lamp(), HAZE)
    assert off.max() > 2 / 512
    assert frame["error"].max() < 1.1 * off.max()


def test_an_opacity_ceiling_is_counted(renderer):
    wall = facing([2.0], 1e3, [1.0], [(0.0, 0.0, 0.0)])
    _, off = check(renderer, wall, SMALL, "gsplat", background=(1.0, 1.0, 1.0))
    assert off.max() == pytest.approx(0.01, rel=1e-3)


def test_float32_rounding_is_counted(renderer):
    """Nothing is left out of this image but digits: more than resolving and omitted fragments explain."""
    quality = fs.Quality(
        lowpass="none", transmittance_stop=0.0, alpha_cutoff=MAX_OMITTED, arithmetic="precise"
    )
    frame, off = check(renderer, needle(), HAZE, quality)
    assert off.max() > 2e-5
    assert frame["error"].max() < 5e-3


@pytest.mark.parametrize("seed", range(4))
def test_the_bound_holds_for_anything(renderer, seed):
    check(renderer, *anything(seed))


def test_the_reference_has_it(reference):
    for cloud in (haze(100, 1e-3), lamp()):
        frame, off = check(reference, cloud, SMALL)
        assert frame["error"].max() < 1.02 * off.max()


def test_the_schedule_of_gpus_bounds_the_same(renderer):
    """Its kernels have the hooks of their own; the bound is that of the other schedule, but for rounding."""
    cloud, camera, quality, background = anything(2)
    backend, capture = renderer.backend, fs.Capture(camera, OUTPUTS, quality, background=background)
    data = backend.upload(cloud)
    plan = error_reference(data, capture, backend)
    own, groups = (
        backend.pipeline(plan.features, shape).render_view(data, plan.view)
        for shape in (backend.config, backend.configs("schedule")["groups"])
    )
    assert groups.read("rgb") == pytest.approx(own.read("rgb"), rel=1e-5, abs=1e-5)
    assert groups.read("rounding") == pytest.approx(own.read("rounding"), rel=1e-3, abs=1e-9)
    assert own.read("rounding").max() > 1e-6


def test_an_image_of_nothing_has_no_error(renderer):
    frame = renderer.render(fs.SplatCloud.empty(), SMALL, OUTPUTS)
    assert frame["error"].max() < 1e-6


def test_it_bounds_a_band_as_the_whole(renderer):
    cloud = haze(300, 1e-3)
    full_frame = renderer.render(cloud, SMALL, OUTPUTS)["error"]
    band = renderer.render_band((4, 9), cloud, SMALL, OUTPUTS)
    assert np.array_equal(band["error"][4:9], full_frame[4:9])
    assert "error" in band.timings


def test_markers_are_composited_by_depth_in_float64(reference):
    """Their rounding has no bound in float32: OpenCL renders the ideal in float64, Warp refuses."""
    veil = facing(np.full(40, -1.0), 0.5, np.full(40, 5e-3), np.ones((40, 3)), spread=0.5)
    cloud = fs.SplatCloud.concatenate([fs.marker("aruco:4x4_50:7", size=1.0).cloud, veil])
    camera = fs.Camera.look_at(24, 18, 1.0, (0.3, 0.1, -2.0), (0.0, 0.0, 0.0))
    finest = fs.Quality(alpha_cutoff=1e-12, transmittance_stop=0.0)
    want = reference.render(cloud, camera, quality=finest)["rgb"]
    frame = fs.Renderer("opencl").render(cloud, camera, OUTPUTS, "fast")
    off = np.abs(frame["rgb"] - want).max(axis=2)
    assert off.max() > 1e-3
    assert (frame["error"] >= off - 2e-7).all()  # `want` is float32
    assert frame["error"].max() < 1.1 * off.max()
    with pytest.raises(InputError, match=r"on warp:cpu, got .*coplanar groups .*order='centre'"):
        fs.Renderer("warp:cpu").render(cloud, camera, OUTPUTS)


def spheres(n, thickness):
    """3D Gaussians, of the labels 0 and 1."""
    g = np.random.default_rng(n)
    means, scales = g.normal(size=(n, 3)) * 0.4 + [0, 0, 2.5], np.exp(g.normal(-2, 0.8, (n, 2)))
    scales = np.column_stack([scales, np.full(n, thickness)])
    arrays = means, g.normal(size=(n, 4)), scales, g.random(n)
    return fs.SplatCloud(*arrays, colors=g.random((n, 3)), labels=np.arange(n) % 2)


@pytest.mark.parametrize(
    ("backend", "parts"),
    [
        ("opencl", {}),
        ("warp:cpu", {}),
        ("opencl", {"motion": fs.Motion(groups={1: lambda time: np.eye(4) + 0.2 * np.eye(4, k=3)})}),
        ("opencl", {"quality": "ellipsoid=exact,order=pixel"}),
    ],
)
def test_the_bound_holds_for_ellipsoids(reference, backend, parts):
    capture = fs.Capture(SMALL, OUTPUTS, background=(0.2, 0.5, 0.1)).with_(**parts)
    finest = capture.quality.with_(alpha_cutoff=1e-12, transmittance_stop=0.0, arithmetic="precise")
    want = reference.render(spheres(40, 0.1), capture.with_(quality=finest, outputs="rgb"))["rgb"]
    coarse = capture.quality.with_(alpha_cutoff=1e-3)
    frame = fs.Renderer(backend).render(spheres(40, 0.1), capture.with_(quality=coarse))
    off = np.abs(frame["rgb"].astype(np.float64) - want).max(axis=2)
    assert (frame["error"] >= off - 6e-8).all()  # `want` is float32
    assert 1e-4 < frame["error"].max() < 1.1 * off.max()


@pytest.mark.parametrize(
    ("parts", "effect", "remedy"),
    [
        ({"fog": fs.Fog(0.1)}, "fog", "without fog"),
        ({"sensor": fs.Sensor(exposure=2.0)}, r"a sensor with exposure=2\.0", r"with fs\.Sensor\(\)"),
        ({"sensor": fs.Sensor(bits=8)}, "a sensor with bits=8", r"with fs\.Sensor\(\)"),
        ({"sensor": fs.Sensor(full_well=900.0)}, r"a sensor with full_well=900\.0", r"with fs\.Sensor\(\)"),
        ({"sensor": fs.Sensor(response="srgb")}, "a sensor with response='srgb'", r"with fs\.Sensor\(\)"),
        ({"sensor": fs.Sensor(response=2.2)}, r"a sensor with response=2\.2", r"with fs\.Sensor\(\)"),
        ({"sensor": fs.Sensor(vignetting=(-0.1,))}, r"a sensor with vignetting=\(", r"with fs\.Sensor\(\)"),
        (
            {"camera": replace(SMALL, far=10.0)},
            "a camera whose far is 10 m",
            "with a camera whose far is inf",
        ),
        ({"camera": replace(SMALL, lens=fs.Fisheye())}, "a distorted or non-pinhole camera", "a pinhole"),
        ({"background": fs.Gradient((0, 0, 1), (1, 1, 1))}, "a gradient or panorama", "of one colour"),
    ],
)
def test_effects_without_a_bound_are_refused(renderer, parts, effect, remedy):
    capture = fs.Capture(SMALL, OUTPUTS).with_(**parts)
    with pytest.raises(InputError, match=f"the output 'error' must .*got {effect}.*; .*{remedy}"):
        renderer.render(haze(3, 0.5), capture)


@pytest.mark.parametrize(
    ("cloud", "parts", "effect", "remedy"),
    [
        ("haze", {"quality": "order=pixel"}, "order='pixel'", "order='centre'"),
        ("haze", {"quality": "lowpass=pixel"}, "lowpass='pixel'", "lowpass='screen'"),
        ("haze", {"quality": "blend_precision=float64"}, "blend_precision='float64'", "'float32'"),
        (
            "haze",
            {"shutter": fs.Shutter(exposure_time=0.1), "motion": fs.Motion(lambda time: np.eye(4))},
            "a shutter with an exposure time",
            "exposure_time=0",
        ),
        ("marker", {}, "coplanar groups", "order='centre'"),
        ("boxes", {}, r".*box splats .*markers with mixture='exact'", "mixture='fitted'"),
        (
            "spheres",
            {"quality": "ellipsoid=exact"},
            r"3D Gaussians with ellipsoid='exact'",
            "ellipsoid='ewa'",
        ),
    ],
)
def test_refusals_name_what_was_requested(cloud, parts, effect, remedy):
    """On Warp, which has no blending in float64."""
    tag = "aruco:4x4_50:7"
    clouds = {
        "haze": lambda: haze(3, 0.5),
        "marker": lambda: fs.marker(tag, size=1.0, mixture="fitted").cloud,
        "boxes": lambda: fs.marker(tag, size=1.0, mixture="exact").cloud,
        "spheres": lambda: spheres(9, 0.1),
    }
    capture = fs.Capture(SMALL, OUTPUTS).with_(**parts)
    with pytest.raises(InputError, match=f"on warp:cpu, got {effect}.*; render with .*{remedy}") as caught:
        fs.Renderer("warp:cpu").render(clouds[cloud](), capture)
    assert not re.search("order_|footprint_|lowpass_|camera_|ellipsoid_|shutter_|slot", str(caught.value))


def test_every_effect_without_a_bound_has_words():
    """Effects of the catalogue that a scene may request, outputs and steps of sensors left out."""
    kinds = ("camera", "color", "ellipsoid", "lowpass", "order", "footprint", "background", "shutter")
    names = {name for name in CATALOGUE if name.startswith(kinds)} | {"external_depth", "blend_double"}
    words = {name: certified_error._remedy_of(name)[0] for name in names - certified_error._BOUNDED}
    assert {name for name, message in words.items() if message == name} == set()


def test_lenses_have_it_on_the_reference(reference):
    camera = replace(SMALL, lens=fs.Fisheye())
    finest = fs.Quality(alpha_cutoff=1e-12, transmittance_stop=0.0)
    images = (reference.render(haze(30, 1e-3), camera, OUTPUTS, q) for q in ("fast", finest))
    coarse, fine = images
    off = np.abs(coarse["rgb"].astype(np.float64) - fine["rgb"]).max(axis=2)
    assert (coarse["error"] >= off - 1e-9).all()
    assert off.max() > 1e-3


def test_batches_and_stores_are_refused(renderer, tmp_path):
    with pytest.raises(
        InputError, match=r"'error' must be rendered one capture at a time, got a batch of 1; call render"
    ):
        renderer.render_batch(haze(3, 0.5), [fs.Capture(SMALL, OUTPUTS)])
    fs.save_ply(haze(3, 0.5), tmp_path / "few.ply")
    fs.build_store([tmp_path / "few.ply"], tmp_path / "few.fss")
    store = fs.Store(tmp_path / "few.fss")
    with pytest.raises(
        InputError,
        match=r"must be in memory for the output 'error', got a store .*; render store\.cloud",
    ):
        renderer.render(store, SMALL, OUTPUTS)


def test_it_is_read_on_the_host():
    frame = fs.Renderer("warp:cpu").render(haze(3, 0.5), SMALL, OUTPUTS)
    with pytest.raises(InputError, match=r"frame\['error'\]"):
        frame.device_array("error")
