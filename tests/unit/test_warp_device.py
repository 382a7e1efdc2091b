"""The Warp backend: its devices, its error if the package is missing, arrays shared without a copy."""

import gc
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import optimisation
import pytest
from agreement import ALL_OUTPUTS, random_splats

import fidsplat as fs
from fidsplat.backends.warp import device as warp_device
from fidsplat.backends.warp import runtime
from fidsplat.backends.warp.program import known
from fidsplat.effects import CATALOGUE, FeatureSet

wp = pytest.importorskip("warp")
CAMERA = fs.Camera.look_at(64, 48, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
CLOUD = random_splats(200, seed=1, depth=(1.0, 4.0), scale=(0.02, 0.4))
DEVICES = [info.name for info in fs.devices() if info.name.startswith("warp:") and info.usable]
GPUS = [name for name in DEVICES if name != "warp:cpu"]
CUDA = pytest.param(
    GPUS[0] if GPUS else "warp:cuda",
    marks=pytest.mark.skipif(not GPUS, reason="no CUDA device for Warp here"),
)


@pytest.fixture(scope="module", params=["warp:cpu", CUDA])
def renderer(request):
    return fs.Renderer(request.param)


def arrays_of(cloud, device):
    """The cloud as wp.arrays of vectors on a device."""
    types = {
        "means": wp.vec3,
        "quats": wp.vec4,
        "scales": wp.vec2,
        "opacities": wp.float32,
        "colors": wp.vec3,
    }
    return {name: wp.array(getattr(cloud, name), dtype=dtype, device=device) for name, dtype in types.items()}


def test_the_cpu_is_listed_and_opened_by_its_name():
    info = next(info for info in fs.devices() if info.name == "warp:cpu")
    assert info.usable
    assert info.kind == "cpu"
    assert fs.Renderer("warp:cpu").device == info
    assert fs.Renderer("WARP: CPU").device == info


def test_unknown_devices_and_missing_gpus_are_named():
    with pytest.raises(fs.DeviceError, match=r"no Warp device matches 'tpu'; there are: warp:cpu"):
        fs.Renderer("warp:tpu")
    if not GPUS:
        with pytest.raises(fs.DeviceError, match=r"no CUDA device .* use device='warp:cpu'"):
            fs.Renderer("warp:cuda")


def test_without_warp_devices_are_listed_and_the_error_says_how_to_install(monkeypatch):
    runtime.load.cache_clear()
    monkeypatch.setattr(runtime, "installed", lambda: False)
    try:
        listed = next(info for info in fs.devices() if info.name == "warp")
        assert not listed.usable
        assert "pip install 'fidsplat[warp]'" in listed.reason
        with pytest.raises(fs.DeviceError, match=r"pip install 'fidsplat\[warp\]'"):
            fs.Renderer("warp:cpu")
    finally:
        runtime.load.cache_clear()


def test_nothing_is_said_on_stdout_or_stderr():
    fs.Renderer("warp:cpu").render(fs.SplatCloud.empty(), fs.Camera.pinhole(4, 4, 4, 4, 2, 2))
    code = (
        "import fidsplat as fs; view = fs.Camera.pinhole(4, 4, 4, 4, 2, 2);"
        "fs.Renderer('warp:cpu').render(fs.SplatCloud.empty(), view)"
    )
    if optimisation.level() == "hardly":
        code = f"import optimisation; optimisation.compile_quickly(); {code}"
    # what was compiled above is loaded there: Warp would tell of either
    cache = Path(wp.config.kernel_cache_dir).parent  # Warp adds its version
    env = {"PATH": "", "WARP_CACHE_PATH": str(cache), "PYTHONPATH": ":".join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_an_effect_that_warp_lacks_is_an_error_that_names_both(renderer):
    effects = ("camera_pinhole", "color_rgb", "lowpass_screen", "stop_inclusive", "order_centre")
    features = FeatureSet(effects, ("overdraw",), 0, 1, "float64")
    with pytest.raises(
        fs.DeviceError, match=rf"{renderer.device.name} .* has no overdraw; use an OpenCL device"
    ):
        renderer.backend.pipeline(features)


def test_what_warp_lacks_is_listed_in_its_page():
    page = (Path(__file__).parents[2] / "docs" / "backends.md").read_text("utf-8")
    words = {"blend_half": "float16", "blend_double": "float64", "overdraw": "fragments"}
    words["termination_depths"] = "occlusion culling"
    for name in set(CATALOGUE) - known():
        assert words[name] in page, name


def test_a_panorama_is_on_the_device_once_and_as_long_as_it_is_used(renderer):
    held, before = renderer.backend.panoramas, len(renderer.backend.panoramas)
    sky = fs.Panorama(np.random.default_rng(1).uniform(0, 1, (8, 16, 3)))
    first, second = (renderer.render(CLOUD, CAMERA, names, background=sky) for names in ("rgb", "alpha"))
    assert len(held) == before + 1
    assert held[sky].shape == (8, 16)
    again = fs.Panorama(1 - sky.image)
    assert not np.array_equal(renderer.render(CLOUD, CAMERA, background=again)["rgb"], first["rgb"])
    assert np.array_equal(renderer.render(CLOUD, CAMERA, background=sky)["rgb"], first["rgb"])
    assert second["alpha"].any()
    del sky, again, first, second  # frames hold their captures
    gc.collect()
    assert len(held) == before


def test_the_environment_names_the_default(monkeypatch):
    monkeypatch.setenv("FIDSPLAT_DEVICE", "warp:cpu")
    assert fs.Renderer().device.name == "warp:cpu"
    assert fs.Renderer("reference").device.name == "reference"
    monkeypatch.setenv("FIDSPLAT_DEVICE", "")
    assert fs.Renderer().device.name.startswith("opencl")


def test_planes_are_warp_arrays_without_a_copy(renderer):
    frame = renderer.render(CLOUD, CAMERA, outputs=ALL_OUTPUTS)
    for name in ALL_OUTPUTS:
        array = frame.device_array(name)
        assert isinstance(array, wp.array)
        assert array.device == renderer.backend.device
        assert array.shape == frame[name].shape
        assert array.ptr == frame.device_array(name).ptr
        assert np.array_equal(array.numpy(), frame[name])
    with pytest.raises(KeyError, match="got 'depth'"):
        renderer.render(CLOUD, CAMERA).device_array("depth")


def test_what_is_done_to_a_shared_image_is_not_done_to_what_was_read(renderer):
    frame = renderer.render(CLOUD, CAMERA)
    before = frame["rgb"].copy()
    frame.device_array("rgb").zero_()
    assert np.array_equal(frame["rgb"], before)
    assert before.any()


def test_a_frame_keeps_its_arrays_when_the_next_is_rendered(renderer):
    frame = renderer.render(CLOUD, CAMERA).device_array("rgb")
    before = frame.numpy().copy()
    renderer.render(random_splats(50, seed=2, depth=(1, 3)), CAMERA)
    assert np.array_equal(frame.numpy(), before)


def test_other_backends_say_that_they_share_nothing(reference):
    frame = reference.render(CLOUD, CAMERA)
    with pytest.raises(fs.InputError, match="warp:cpu"):
        frame.device_array("rgb")
    with pytest.raises(fs.InputError, match="wrap arrays, got reference"):
        reference.wrap_arrays(means=0, quats=0, scales=0, opacities=0, colors=0)


def test_adopted_arrays_render_what_the_cloud_renders(renderer):
    expected = renderer.render(CLOUD, CAMERA)["rgb"]
    vectors = arrays_of(CLOUD, renderer.backend.device)
    rows = {
        name: wp.array(getattr(CLOUD, name), dtype=wp.float32, device=renderer.backend.device)
        for name in vectors
    }
    plain = {name: getattr(CLOUD, name) for name in vectors}
    for arrays in (vectors, rows, plain):
        assert np.array_equal(renderer.render(renderer.wrap_arrays(**arrays), CAMERA)["rgb"], expected)


def test_a_resident_cloud_reports_its_memory(renderer):
    words = 3 + 4 + 2 + 1 + 3 + 1  # means, quats, scales, opacities, colors, labels
    assert renderer.upload(CLOUD).memory_bytes == 4 * words * len(CLOUD)
    arrays = arrays_of(CLOUD, renderer.backend.device)
    assert renderer.wrap_arrays(**arrays).memory_bytes == 4 * words * len(CLOUD)
    harmonic = random_splats(10, seed=3, sh_degree=2).with_coplanar_groups(np.arange(10) // 2)
    assert renderer.upload(harmonic).memory_bytes == 4 * (words + 24 + 1) * 10


def test_adopted_labels_harmonics_and_origins(renderer):
    cloud = random_splats(100, seed=3, depth=(1, 4), scale=(0.02, 0.4), sh_degree=2)
    names = ("means", "quats", "scales", "opacities", "sh", "labels")
    resident = renderer.wrap_arrays(**{name: getattr(cloud, name) for name in names})
    frame, expected = (renderer.render(what, CAMERA, ("rgb", "label")) for what in (resident, cloud))
    assert all(np.array_equal(frame[name], expected[name]) for name in frame)
    moved = renderer.wrap_arrays(**{name: getattr(cloud, name) for name in names}, origin=(1e6, 0, 0))
    view = fs.Camera.look_at(64, 48, 1.0, (1e6, 0.0, -0.1), (1e6, 0.0, 3.0))
    assert np.allclose(renderer.render(moved, view)["rgb"], expected["rgb"], atol=1e-5)


def test_adopted_splats_with_three_scales(renderer):
    """Disks among them; rendered where they lie, and left out where a third scale is none."""
    device = renderer.backend.device
    third = np.where(np.arange(len(CLOUD)) % 3 == 0, 0, CLOUD.scales[:, :1].T * 0.5)
    scales = np.column_stack([CLOUD.scales, third[0]])
    thick = fs.SplatCloud(CLOUD.means, CLOUD.quats, scales, CLOUD.opacities, colors=CLOUD.colors)
    expected = renderer.render(thick, CAMERA)["rgb"]
    vectors = arrays_of(CLOUD, device) | {"scales": wp.array(scales, dtype=wp.vec3, device=device)}
    rows = vectors | {"scales": wp.array(scales, dtype=wp.float32, device=device)}
    plain = {name: getattr(CLOUD, name) for name in vectors} | {"scales": scales}
    for arrays in (vectors, rows, plain):
        resident = renderer.wrap_arrays(**arrays)
        assert np.array_equal(renderer.render(resident, CAMERA)["rgb"], expected)
        words = 3 + 4 + 3 + 1 + 3 + 1
        assert resident.memory_bytes == 4 * words * len(CLOUD)

    resident = renderer.wrap_arrays(**vectors)
    broken = {5: np.nan, 6: np.inf, 7: -0.1}
    scales[list(broken), 2] = list(broken.values())
    vectors["scales"].assign(scales)
    keep = ~np.isin(np.arange(len(CLOUD)), list(broken))
    rest = (CLOUD.means, CLOUD.quats, scales, CLOUD.opacities)
    left = fs.SplatCloud(*(array[keep] for array in rest), colors=CLOUD.colors[keep])
    after = renderer.render(resident, CAMERA)["rgb"]
    assert np.array_equal(after, renderer.render(left, CAMERA)["rgb"])
    assert not np.array_equal(after, expected)


def test_moving_an_adopted_array_moves_the_splats(renderer):
    arrays = arrays_of(CLOUD, renderer.backend.device)
    resident = renderer.wrap_arrays(**arrays)
    before = renderer.render(resident, CAMERA)["rgb"].copy()
    moved = CLOUD.means + np.float32([0.2, 0, 0])
    arrays["means"].assign(wp.array(moved, dtype=wp.vec3, device="cpu"))
    expected = fs.SplatCloud(moved, CLOUD.quats, CLOUD.scales, CLOUD.opacities, colors=CLOUD.colors)
    after = renderer.render(resident, CAMERA)["rgb"]
    assert np.array_equal(after, renderer.render(expected, CAMERA)["rgb"])
    assert not np.array_equal(after, before)


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_adopted_values_that_are_not_finite_leave_no_trace(renderer, name, value):
    keep = np.arange(len(CLOUD)) != 7
    names = ("means", "quats", "scales", "opacities", "colors")
    arrays = {each: getattr(CLOUD, each).copy() for each in names}
    without = {each: array[keep] for each, array in arrays.items()}
    arrays[name][7] = value
    frame, expected = (
        renderer.render(renderer.wrap_arrays(**a), CAMERA, ("rgb", "alpha")) for a in (arrays, without)
    )
    assert all(np.array_equal(frame[plane], expected[plane]) for plane in frame)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"means": np.zeros((200, 2), np.float32)},
            r"the last axis of means must be 3, got shape \(200, 2\)",
        ),
        ({"scales": np.zeros((200, 4))}, r"the last axis of scales must be 2 or 3, got shape \(200, 4\)"),
        ({"opacities": np.zeros(3, np.float32)}, "opacities must have 200 elements for 200 means, got 3"),
        ({"sh": np.zeros((200, 4, 3), np.float32)}, "exactly one of colors"),
        (
            {"colors": None, "sh": np.zeros((200, 5, 3), np.float32)},
            "sh coefficients per splat must be one of .* got 5",
        ),
        ({"scales": "wp.float64"}, "an element of scales must be 2 x float32"),
        ({"means": "strided"}, "must be contiguous"),
    ],
)
def test_arrays_that_cannot_be_adopted(renderer, changes, words):
    device = renderer.backend.device
    special = {
        "wp.float64": wp.zeros((200, 2), dtype=wp.float64, device=device),
        "strided": wp.zeros((200, 6), dtype=wp.float32, device=device)[:, :3],
    }
    changes = {
        name: special.get(value, value) if isinstance(value, str) else value
        for name, value in changes.items()
    }
    with pytest.raises(fs.InputError, match=words):
        renderer.wrap_arrays(**{**arrays_of(CLOUD, device), **changes})


def test_numpy_sees_the_image_of_a_cpu_through_dlpack():
    frame = fs.Renderer("warp:cpu").render(CLOUD, CAMERA, outputs=("rgb", "label"))
    for name in frame:
        seen = np.from_dlpack(frame.device_array(name))
        assert np.array_equal(seen, frame[name])
        assert seen.ctypes.data == frame.device_array(name).ptr


@pytest.mark.skipif(not GPUS, reason="no CUDA device for Warp here")
@pytest.mark.parametrize("library", ["torch", "cupy"])
def test_gpu_planes_are_tensors_on_the_same_device(library):
    module = pytest.importorskip(library)
    renderer = fs.Renderer(GPUS[0])
    frame = renderer.render(CLOUD, CAMERA)
    plane = frame.device_array("rgb")
    assert plane.__cuda_array_interface__["data"][0] == plane.ptr
    tensor = module.from_dlpack(plane)
    pointer = tensor.data_ptr() if library == "torch" else tensor.data.ptr
    assert pointer == plane.ptr
    host = tensor.cpu().numpy() if library == "torch" else tensor.get()
    assert np.array_equal(host, frame["rgb"])
    # and back: splats that the library made
    names = ("means", "quats", "scales", "opacities", "colors")
    there = {name: module.asarray(getattr(CLOUD, name).copy()) for name in names}
    there = {name: each.cuda() for name, each in there.items()} if library == "torch" else there
    assert np.array_equal(renderer.render(renderer.wrap_arrays(**there), CAMERA)["rgb"], frame["rgb"])


@pytest.mark.skipif(not GPUS, reason="no CUDA device for Warp here")
def test_arrays_of_another_device_are_refused():
    with pytest.raises(fs.InputError, match=r"means must be on cuda.*, the device of this renderer, got cpu"):
        fs.Renderer(GPUS[0]).wrap_arrays(**arrays_of(CLOUD, "cpu"))


def test_debug_builds_are_launched_by_one_thread(monkeypatch):
    """State that threads share, which would crash without a lock."""
    assert fs.Renderer("warp:cpu").backend._launches.threads > 1 or len(os.sched_getaffinity(0)) == 1
    monkeypatch.setattr(wp.config, "mode", "debug")
    assert fs.Renderer("warp:cpu").backend._launches.threads == 1


def test_warp_pipelines_share_kernels_that_mean_the_same():
    """A stage is compiled once for all feature sets that it cannot tell apart."""
    backend = warp_device.open_device("cpu")
    effects = ("camera_pinhole", "color_rgb", "lowpass_screen", "stop_inclusive", "order_centre")
    one, two = (
        backend.pipeline(FeatureSet(effects, outputs, 0, n, "float64"))
        for outputs, n in (((), 1), (("alpha",), 2))
    )
    assert one.program.project is two.program.project
    assert one.program.blend is two.program.blend
    assert one.program.resolve is not two.program.resolve
    assert one is backend.pipeline(FeatureSet(effects, (), 0, 1, "float64"))


@pytest.mark.parametrize("device", ["warp:cpu", CUDA])
def test_the_example_renders_each_step(device, monkeypatch, capsys):
    example = Path(__file__).resolve().parents[2] / "examples" / "warp_loop.py"
    monkeypatch.setattr(sys, "argv", [str(example), "--device", device, "--steps", "11"])
    runpy.run_path(str(example), run_name="__main__")
    covered = [int(count) for count in re.findall(r"covers +(\d+) pixels", capsys.readouterr().out)]
    assert len(covered) == 2
    assert 0 < covered[0] != covered[1] > 0


def test_a_memory_budget_renders_in_bands_bit_identically():
    cloud = random_splats(300, seed=5, depth=(0.5, 4.0), scale=(0.05, 1.0))
    view = fs.Camera.look_at(320, 240, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
    expected = fs.Renderer("warp:cpu").render(cloud, view, ALL_OUTPUTS)
    separate_renderer = fs.Renderer("warp:cpu", memory_budget=6_894_400)
    frame = separate_renderer.render(cloud, view, ALL_OUTPUTS)
    assert separate_renderer.backend.pool._arrays["lists", wp.int32].size < expected.stats["pairs"], (
        "rendered in ranges of tiles"
    )
    assert frame.stats == expected.stats
    assert all(np.array_equal(frame[name], expected[name]) for name in ALL_OUTPUTS)
    with pytest.raises(fs.DeviceError, match=r"memory_budget must exceed .*, got 1 MiB; raise it"):
        fs.Renderer("warp:cpu", memory_budget=2**20).render(cloud, view, ALL_OUTPUTS)


def test_a_memory_budget_counts_rays_and_the_planes_of_all_poses():
    cloud = random_splats(300, seed=5, depth=(0.5, 4.0), scale=(0.05, 1.0))
    view = fs.Camera.fisheye(320, 240, 2.6)
    start, end = np.eye(4), np.eye(4)
    end[0, 3] = 0.5
    poses = fs.Trajectory([-1.0, 1.0], np.stack([start, end]))
    exposed = {"motion": fs.Motion(poses), "shutter": fs.Shutter(exposure_time=0.3, sub_poses=2)}
    expected = fs.Renderer("warp:cpu").render(cloud, view, ("rgb", "depth"), **exposed)
    separate_renderer = fs.Renderer("warp:cpu", memory_budget=6_170_000)
    frame = separate_renderer.render(cloud, view, ("rgb", "depth"), **exposed)
    assert separate_renderer.backend.pool._arrays["lists", wp.int32].size < expected.stats["pairs"], (
        "rendered in ranges of tiles"
    )
    assert all(np.array_equal(frame[name], expected[name]) for name in ("rgb", "depth"))
    small = fs.Renderer("warp:cpu", memory_budget=5_500_000)
    small.render(cloud, view, ("rgb", "depth"))
    with pytest.raises(fs.DeviceError, match=r"memory_budget must exceed .*; raise it"):
        small.render(cloud, view, ("rgb", "depth"), **exposed)


def test_poison_reaches_every_array(renderer, monkeypatch):
    """Hard case E5 would prove nothing if the arrays were clean."""
    from fidsplat.backends.warp import probe

    measured, poison = [], probe.poison
    monkeypatch.setattr(probe, "poison", lambda array: measured.append(poison(array)) or measured[-1])
    with renderer.backend.probe().poisoned():
        renderer.render(CLOUD, CAMERA, ("rgb", "depth"))
        again = renderer.backend.pool.scratch("records", 4, wp.vec4)
    assert len(measured) > 15
    assert (again.numpy().view(np.uint8) == 0xFF).all()


@pytest.mark.parametrize("size", [2**46, 2**31])
def test_an_array_that_the_device_cannot_give_is_an_error_with_a_remedy(renderer, size):
    with pytest.raises(
        fs.DeviceError, match=r"lists must fit the memory of \S+, got \d+ MiB; use fewer splats"
    ):
        renderer.backend.pool.allocate("lists", size, wp.int32)
