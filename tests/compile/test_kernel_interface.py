"""Declarations of kernel_interface.py against compiled kernels; effects from outside of the tree."""

import re
import subprocess
import sys

import cv2
import numpy as np
import pyopencl as cl
import pytest
from agreement import random_splats
from combined import LENSES, all_effects, combination

import fidsplat as fs
from fidsplat.backends.opencl.assemble import KernelSource, assemble, effect_code_of
from fidsplat.backends.opencl.declare import EffectCode, SampleBuffer, member, uniforms
from fidsplat.backends.opencl.effect_code import EFFECT_CODE
from fidsplat.backends.opencl.kernel_config import cpu_config, gpu_config
from fidsplat.backends.opencl.pipeline import MIN_VECTORISED
from fidsplat.backends.opencl.program import build
from fidsplat.cli import main
from fidsplat.effects import CATALOGUE, OUTPUTS, Effect, Output, declared_output, select
from fidsplat.effects.catalogue import DERIVED_OUTPUTS
from fidsplat.effects.extensions import outputs_help
from fidsplat.render.output_files import save_output
from fidsplat.selftest.agreement import compare

BACKEND = "opencl"
SETS = {
    "nothing": (),
    **{str(lens): all_effects(lens) for lens in (None, *LENSES)},
    "double": ("boxes and Gaussians", "planes", "output normal", "output label"),
}


def offsets_on(backend, source: KernelSource) -> dict[str, dict[str, int]]:
    """Offsets on the device by record and field, and under "" the size of the record."""
    structs = re.findall(
        r"typedef struct[^{]*\{[^}]*\} (?:View|Splat|Bounds);", source.programs["frame"].text
    )
    assert len(structs) == len(source.records)
    requested, lines = [], []
    for record, dtype in source.records.items():
        for field in ("", *(dtype.names or ())):
            place = f"(char *)&of_{record}.{field} - (char *)&of_{record}" if field else f"sizeof({record})"
            lines.append(f"    out[{len(requested)}] = (int)({place});\n")
            requested.append((record, field))
    variables = "".join(f"    {record} of_{record};\n" for record in source.records)
    real = f"typedef {source.scalar_types.real} real;\n#pragma OPENCL EXTENSION cl_khr_fp64 : enable\n"
    body = f"kernel void places(global int *out) {{\n{variables}{''.join(lines)}}}\n"
    program = build(backend, real + "\n".join(structs) + "\n" + body)
    actual = np.empty(len(requested), np.int32)
    out = cl.Buffer(backend.context, cl.mem_flags.READ_WRITE, actual.nbytes)
    program.places(backend.queue, (1,), None, out)
    cl.enqueue_copy(backend.queue, actual, out)
    places: dict[str, dict[str, int]] = {record: {} for record in source.records}
    for (record, field), place in zip(requested, actual.tolist(), strict=True):
        places[record][field] = place
    return places


@pytest.mark.parametrize("name", SETS)
def test_records_have_equal_layouts_on_host_and_device(renderer, name):
    requested = combination(SETS[name])
    if not renderer.device.float64:
        pytest.skip("records of a device without float64 are those of `projection_precision` float32")
    features = requested.features()
    if name == "double":
        quality = requested.capture.quality.with_(blend_precision="float64")
        features = select(requested.cloud, requested.capture.with_(quality=quality))
    source = assemble(features, gpu_config())
    places = offsets_on(renderer.backend, source)
    for record, dtype in source.records.items():
        fields = dtype.fields or {}
        assert places[record] == {"": dtype.itemsize, **{name: fields[name][1] for name in dtype.names or ()}}


@pytest.mark.parametrize("shape", [cpu_config(), gpu_config(256)], ids=["lanes", "group"])
def test_kernels_have_the_declared_arguments(renderer, shape):
    """Names, types and address spaces of all arguments, as reported by the compiler."""
    requested = combination(all_effects("fisheye") if shape.schedule == "lanes" else all_effects(None))
    source = assemble(requested.features(), shape)
    programs = [
        build(renderer.backend, program.text, "-cl-kernel-arg-info") for program in source.programs.values()
    ]
    info, spaces = cl.kernel_arg_info, cl.kernel_arg_address_qualifier
    kernels = {kernel.function_name: kernel for program in programs for kernel in program.all_kernels()}
    assert kernels.keys() == source.arguments.keys()
    for name, kernel in kernels.items():
        actual = [
            (
                kernel.get_arg_info(k, info.TYPE_NAME),
                kernel.get_arg_info(k, info.NAME),
                kernel.get_arg_info(k, info.ADDRESS_QUALIFIER) == spaces.GLOBAL,
            )
            for k in range(kernel.num_args)
        ]
        scalars = {"real": source.scalar_types.real, "blend_real": source.scalar_types.blend_real}
        declared = [
            (scalars.get(one.ctype, one.ctype) + ("*" if one.access else ""), one.name, bool(one.access))
            for one in source.arguments[name].values()
        ]
        assert actual == declared, name


def test_every_effect_has_a_layout_with_the_parts_of_its_output():
    assert set(CATALOGUE) <= set(EFFECT_CODE)
    for name, effect in CATALOGUE.items():
        assert set(effect.needs) <= set(EFFECT_CODE[name].parts), name


TOY_OUTPUT = """// nearest (h, w): depth [m] of the nearest fragment; 0 where there is none.
//@ state
    vfloat nearest;
//@ start
    pixel->nearest = INFINITY;
//@ composite
    pixel->nearest = fmin(pixel->nearest, VSELECT((vfloat)INFINITY, attributes->z, live & VMASK(weight > 0)));
//@ store
        BLOCK_STORE(pixel->nearest, nearest_raw + at, stride);
//@ resolve_start
    float nearest = 0.0f;
//@ resolve_sample
            nearest = nearest_raw[at];
//@ resolve_end
    nearest_out[out] = nearest < INFINITY ? nearest : 0.0f;
"""
TOY_STEP = """// The negative of the sensor's image.
//@ resolve_end
    for (size_t k = 3 * out; k < 3 * out + 3; k++) rgb_out[k] = white - rgb_out[k];
"""


class Negative(fs.Sensor):
    """A sensor with an additional step."""

    @property
    def steps(self):
        return (*super().steps, "negative")

    def uniforms_of(self, name):
        return (2.0,) if name == "negative" else super().uniforms_of(name)


@pytest.fixture
def toys(monkeypatch, tmp_path):
    """An output and a sensor step: each a line in the catalogue, one in the layouts, and a file."""
    (tmp_path / "nearest.cl").write_text(TOY_OUTPUT)
    (tmp_path / "negative.cl").write_text(TOY_STEP)
    output = Output(
        "nearest",
        1,
        "float32",
        "depth [m] of the nearest splat",
        "depth",
        1e-3,
        relative=True,
        discontinuous=True,
    )
    monkeypatch.setitem(CATALOGUE, "nearest", Effect("nearest", output))
    monkeypatch.setitem(OUTPUTS, "nearest", output)
    monkeypatch.setitem(CATALOGUE, "negative", Effect("negative"))
    nearest = EffectCode(
        str(tmp_path / "nearest.cl"),
        parts=("ray_depth",),
        sample_buffers=(SampleBuffer("float", "nearest_raw"),),
    )
    monkeypatch.setitem(EFFECT_CODE, "nearest", nearest)
    negative = EffectCode(str(tmp_path / "negative.cl"), resolve=uniforms("negative", "float white"))
    monkeypatch.setitem(EFFECT_CODE, "negative", negative)
    return tmp_path


def test_an_output_and_a_step_from_outside_are_rendered(renderer, toys):
    cloud = random_splats(60, seed=4, depth=(1, 4))
    camera = fs.Camera.pinhole(33, 21, 30.0, 30.0, 16.0, 10.0)
    plain = renderer.render(cloud, camera, ("rgb", "depth", "depth_first"), fs.Quality(first_hit=1e-3))
    toy = renderer.render(cloud, camera, ("rgb", "nearest", "depth"), sensor=Negative())
    np.testing.assert_array_equal(toy["rgb"], np.float32(2) - plain["rgb"])
    np.testing.assert_array_equal(toy["depth"], plain["depth"])
    assert ((toy["nearest"] > 0) >= (plain["depth"] > 0)).all()
    hit = plain["depth_first"] > 0
    assert (toy["nearest"][hit] <= plain["depth_first"][hit]).all()
    assert hit.any()


def test_an_output_is_compared_listed_and_written_as_it_is_declared(toys, tmp_path):
    expected = {
        "nearest": np.array([[1.0, 2.0, 0.0]]),
        "nearest_may_flip": np.array([[False, True, False]]),
        "error_bound": np.zeros((1, 3)),
        "rgb": np.zeros((1, 3, 3)),
    }
    within, flipped, off = (
        compare({"nearest": np.float32([row])}, expected, ("nearest",))[0]
        for row in ([1.0009, 2, 0], [1, 3, 0], [1.0011, 2, 0])
    )
    assert (within.error, within.agrees) == (0, True)
    assert (flipped.error, flipped.agrees) == (pytest.approx(1 / 3), True)
    assert (off.excess, off.agrees) == (pytest.approx(1 / 3), False)

    assert re.search(r"^  nearest +depth \[m\] of the nearest splat$", outputs_help(), re.MULTILINE)

    image = np.float32([[0.5, 1.5]])
    files = save_output("nearest", image, lambda name, suffix: tmp_path / f"{name}{suffix}")
    assert [file.name for file in files] == ["nearest.npy", "nearest.png", "nearest-turbo.png"]
    assert np.array_equal(np.load(files[0]), image)
    assert cv2.imread(str(files[1]), cv2.IMREAD_UNCHANGED).tolist() == [[500, 1500]]


def test_help_of_render_lists_all_outputs(capsys):
    assert main(["render", "--help"]) == 0
    listed = capsys.readouterr().out
    for name in (*OUTPUTS, *DERIVED_OUTPUTS):
        assert declared_output(name).summary[:40] in " ".join(listed.replace("│", " ").split()), name


def test_effects_from_outside_do_not_change_other_texts(request):
    requested = [select(random_splats(3, seed=1), fs.Capture(outputs=(name,))) for name in OUTPUTS]
    before = [assemble(features, cpu_config()).digest for features in requested]
    request.getfixturevalue("toys")
    assert [assemble(features, cpu_config()).digest for features in requested] == before
    assert "nearest" not in effect_code_of(requested[0])


def test_compiler_errors_name_the_kernel_file_and_line(renderer, toys):
    (toys / "wrong.cl").write_text("// wrong\n//@ resolve_end\n    nearest_out[out] = no_such_name;\n")
    layout = EffectCode(str(toys / "wrong.cl"), splat=(member("int wrong"),))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(EFFECT_CODE, "nearest", layout)
        features = select(random_splats(3, seed=1), fs.Capture(outputs=("nearest",)))
        with pytest.raises(fs.DeviceError, match=r"wrong\.cl:3:\d+: .*no_such_name"):
            _ = renderer.backend.pipeline(features).program


def test_line_directives_match_the_lines_of_the_files():
    from fidsplat.util.files import kernels_folder

    source = assemble(combination(all_effects("distortion")).features(), cpu_config())
    assert source.listing.count("\n") == source.text.count("\n")
    compared = 0
    for program in source.programs.values():
        file, number = "", 0
        for line in program.listing.splitlines():
            if directive := re.fullmatch(r'#line (\d+) "(.*)"', line):
                number, file = int(directive[1]), directive[2]
                continue
            if file.startswith("opencl/") and line.strip():
                written = (kernels_folder() / file).read_text("utf-8").splitlines()[number - 1]
                written = re.sub(r"BLEND_REAL\(([^()]+)\)", r"\1f", written).replace("blend_real ", "float ")
                assert written[:4] == line[:4]
                compared += 1
            number += 1
    assert compared > 800


def test_assembling_needs_no_opencl():
    code = (
        "import sys; sys.modules['pyopencl'] = None\n"
        "import fidsplat as fs\n"
        "from fidsplat.backends.opencl.assemble import assemble\n"
        "from fidsplat.backends.opencl.kernel_config import cpu_config\n"
        "from fidsplat.effects import select\n"
        "features = select(fs.SplatCloud.empty(), fs.Capture(outputs=('rgb', 'depth')))\n"
        "print(assemble(features, cpu_config()).digest)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.strip()) == 64


SOURCES = """import sys
sys.modules["pyopencl"] = None
from fidsplat.cli import main
for more in (["--outputs", "rgb,depth"], ["--schedule", "group"]):
    assert main(["source", sys.argv[1], *more]) == 0
    print("=" * 80)
"""


def test_source_prints_without_opencl(tmp_path, capsys):
    cloud, file = random_splats(5, seed=1, depth=(1, 3)), tmp_path / "cloud.ply"
    fs.save_ply(cloud, str(file))
    done = subprocess.run([sys.executable, "-c", SOURCES, str(file)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    lanes, group, _ = done.stdout.split("=" * 80)
    assert '"opencl/output/depth.cl"' in lanes
    assert "// depth = z_numerator / D" in lanes
    assert "output/normal.cl" not in lanes
    assert "schedule/group.cl" in group
    assert "schedule/group.cl" not in lanes
    assert main(["source", str(file), "--device", "reference"]) == 2
    assert "--device must be an OpenCL device, got reference" in capsys.readouterr().err


def test_source_prints_what_the_device_compiles(renderer, tmp_path, capsys):
    # small clouds and frames have other build constants than those that the command prints
    cloud, file = random_splats(MIN_VECTORISED, seed=1, depth=(1, 3)), tmp_path / "cloud.ply"
    fs.save_ply(cloud, str(file))
    frame = renderer.render(cloud, fs.Camera.pinhole(1280, 960, 1200.0, 1240.0, 640.0, 480.0))
    assert frame["rgb"].shape == (960, 1280, 3)
    # those of extensions of other tests, which are registered no longer, may not have been assembled
    assembled = [pipeline for pipeline in renderer.backend._pipelines.values() if "source" in vars(pipeline)]
    compiled = {pipeline.source.listing for pipeline in assembled}
    assert main(["source", str(file), "--device", renderer.device.name]) == 0
    assert capsys.readouterr().out in compiled
