"""Source text of Warp kernels has requested effects only; CUDA's compiler accepts it, GPU or not."""

import re

import pytest
from cubin import resources_of

from fidsplat.backends.warp import runtime
from fidsplat.effects import OUTPUTS

wp = pytest.importorskip("warp")
RECORD = ("lowpass_screen", "ray_depth", "order_pixel", "order_coplanar")
MIXED = (*RECORD, "footprint_mixed")
NORMAL = ("normal",)
OF_BOXES = ("edges", "cover")
FILTERS = ("make_boxes", "make_filter")
OF_SAMPLES = ("depth_weight", "depth_median", "depth_first", "heaviest", "blended", "fog_slope", "fogged")
TAKEN = {
    "1.19.0": {"blend": {"registers": 77, "stack": 0}, "project": {"registers": 96, "stack": 8}},
}
"""by Warp's version: registers and memory of kernels without effects on an H100 (sm_90)"""
OF_LAYERS = ("Layer", "thickest", "tau")
LENSES = [
    ("camera_orthographic", "lowpass_screen"),
    *((f"camera_{name}", "rays", *RECORD) for name in ("brown_conrady", "fisheye", "equirectangular")),
]
STEPS = ("decode_srgb", "veiling_glare", "exposure", "vignetting", "noise", "saturation", "gain")
STEPS += ("white_balance", "response_srgb", "response_table", "quantise")


def made(name, *arguments):
    kernel = getattr(runtime.kernels(name.split(".")[0]), name.split(".")[1])
    return kernel if isinstance(kernel, wp.Kernel) else kernel(*arguments)


def compiled(kernel, folder, block=256, assembly=False):
    """Source text without comments, compiled by NVRTC for sm_80; or the PTX."""
    kernel.module.options.update(block_dim=block, optimization_level=3)  # lower levels take minutes
    with runtime.quiet():
        wp.compile_aot_module(kernel.module, arch=80, module_dir=folder, use_ptx=True)
    (result,) = folder.glob("*.ptx")
    return result.read_text() if assembly else without_comments(folder)


def measured(kernel, folder, block):
    """Source text, and resources of the machine code for an H100."""
    kernel.module.options.update(block_dim=block, optimization_level=3)
    with runtime.quiet():
        wp.compile_aot_module(kernel.module, arch=90, module_dir=folder, use_ptx=False)
    (result,) = folder.glob("*.cubin")
    return without_comments(folder), resources_of(result.read_bytes())


def without_comments(folder):
    (source,) = folder.glob("*.cu")
    return re.sub(r"//[^\n]*", "", source.read_text())


def projecting(*effects, outputs=NORMAL, terms=0, precision="float64", every_bounds=False):
    return made("project.make_project", effects, outputs, terms, precision, every_bounds)


def everything():
    """Files of all outputs and fog."""
    return made("output.with_needed", {*made("output.known"), "fog"})


def blending(*effects, outputs=None, on_gpu=True, area=256, k_buffer_size=8):
    """The kernel with these effects, and with all code that outputs add to blending. k_buffer_size:
    small, since CUDA's compiler needs a second for each entry."""
    if outputs is None:
        outputs = made("output.having", everything(), "attributes", "state", "samples")
    return made("blend.make_blend", effects, outputs, on_gpu, area, k_buffer_size)[0]


GRADIENTS = ("rgb", "alpha", "depth", "normal", "distortion")
OF_GRADIENTS = (("lowpass_screen", "ray_depth"), ("depth", "distortion", "normal"))


def blending_back(*effects):
    """Backward pass of blending, with the device's tile size."""
    rendered = ((*effects, *OF_GRADIENTS[0]), OF_GRADIENTS[1])
    return made("blend_backward.make_blend_backward", *rendered, GRADIENTS, True, 256).kernel


def projecting_back(terms, *effects):
    effects = (*OF_GRADIENTS[0], *effects)
    names = made("fragment_backward.gradient_sum_names", effects, OF_GRADIENTS[1])
    return made("project_backward.make_project_backward", effects, NORMAL, names, terms)


def resolving(has_ray_lengths, samples):
    """The kernel for all outputs."""
    images = tuple((output.name, getattr(wp, output.dtype)) for output in OUTPUTS.values())
    return made("resolve.make_resolve", images, everything(), has_ray_lengths, samples)


LONG = pytest.mark.exhaustive
"""of blending with every output: 13 s each. Plain runs compile it with boxes, and room for 2 that wait, in a
test below"""


@pytest.fixture(autouse=True)
def started():
    runtime.load()


@pytest.mark.parametrize(
    "kernel",
    [
        pytest.param(
            lambda: projecting(*RECORD, "motion_groups", precision="float32", every_bounds=True),
            id="project-float32",
        ),
        *(pytest.param(lambda effects=effects: projecting(*effects), id=effects[0]) for effects in LENSES),
        pytest.param(lambda: projecting(*LENSES[1], "lowpass_pixel"), id="project-filtered"),
        pytest.param(
            lambda: projecting("footprint_box", outputs=(), precision="float32"), id="project-boxes"
        ),
        pytest.param(lambda: projecting(*LENSES[2], "footprint_mixed"), id="project-fisheye-mixed"),
        pytest.param(lambda: projecting(*LENSES[0], "footprint_mixed"), id="project-parallel-mixed"),
        pytest.param(lambda: blending(*RECORD), id="blend-all", marks=LONG),
        pytest.param(lambda: blending(*RECORD, "arithmetic_fast"), id="blend-fast", marks=LONG),
        pytest.param(lambda: blending(*MIXED), id="blend-mixed", marks=LONG),
        pytest.param(lambda: blending("footprint_box", outputs=()), id="blend-boxes"),
        pytest.param(lambda: blending("rays", "footprint_box", outputs=()), id="blend-rays-boxes"),
        pytest.param(lambda: blending("rays", *MIXED), id="blend-rays-mixed", marks=LONG),
        pytest.param(lambda: blending("rays", *RECORD, "lens_ray_length"), id="blend-rays", marks=LONG),
        pytest.param(lambda: blending("camera_orthographic", *RECORD), id="blend-parallel", marks=LONG),
        pytest.param(lambda: blending("lowpass_screen", "stop_exclusive", outputs=()), id="blend-exclusive"),
        pytest.param(lambda: projecting_back(16, "ellipsoid_exact"), id="project-backward-exact"),
        pytest.param(lambda: projecting_back(0, "ellipsoid_ewa_antialiased"), id="project-backward-ewa"),
        pytest.param(lambda: made("blend_backward.make_gradient_offsets", True), id="gradient_offsets"),
        pytest.param(lambda: made("column_sums.add_rows"), id="sums"),
        pytest.param(lambda: resolving(False, 3), id="resolve"),
        pytest.param(lambda: resolving(True, 1), id="resolve-ray-lengths"),
        pytest.param(
            lambda: made("background.make_composite_background", "gradient", False), id="background-gradient"
        ),
        pytest.param(
            lambda: made("background.make_composite_background", "panorama", True), id="background-panorama"
        ),
        pytest.param(lambda: made("sensor.make_sensor", STEPS)[0], id="sensor"),
        pytest.param(lambda: made("shutter.make_accumulate", wp.vec4), id="accumulate"),
        pytest.param(lambda: made("tile_lists.make_list_big", True), id="list_big"),
        pytest.param(lambda: made("tile_lists.sort_lists"), id="list_windows, sort_lists"),
        pytest.param(lambda: made("tile_lists.start_lists"), id="start_lists"),
    ],
)
def test_the_kernels_compile_for_cuda(kernel, tmp_path):
    """Except kernels that other tests compile."""
    assert "wp::launch_bounds_t" in compiled(kernel(), tmp_path)


@pytest.mark.sweep
def test_the_base_has_nothing_of_absent_effects_and_takes_no_more_of_a_gpu(tmp_path):
    text, blend = measured(blending(outputs=()), tmp_path, 128)
    absent = (*OF_SAMPLES, *OF_BOXES, *OF_LAYERS, "finished", "lowpass_x", "intersect_ray", "origin")
    for name in absent:
        assert not re.search(rf"\b{name}", text), name
    project, projection = measured(projecting(outputs=()), tmp_path / "project", 128)
    for name in FILTERS:
        assert name not in project, name
    if wp.__version__ in TAKEN:  # includes the compiler
        assert {"blend": blend, "project": projection} == TAKEN[wp.__version__]
    text = compiled(blending(*MIXED, k_buffer_size=2), tmp_path / "all")
    project = compiled(projecting(*MIXED, "lowpass_pixel"), tmp_path / "mixed", 128)
    assert all(name in project for name in FILTERS)
    for name in (*OF_SAMPLES, *OF_BOXES, *OF_LAYERS):
        assert re.search(rf"\b{name}", text), name


def test_records_move_as_whole_lines(tmp_path):
    """Stores by field would access 32 records per warp."""
    project = compiled(projecting(*RECORD, terms=16), tmp_path / "project", 128, assembly=True)
    assert project.count("st.global.v4") == 7
    blend = compiled(blending(*RECORD, outputs=NORMAL, k_buffer_size=2), tmp_path / "blend", assembly=True)
    assert blend.count("ld.shared.v4") >= 5
    assert "shfl.sync.bfly" in blend
    assert "ld.shared.u8" in blend


def test_derivatives_read_records_where_they_lie(tmp_path):
    """They stage no records."""
    assert "staged" in compiled(blending(outputs=()), tmp_path / "blend")
    effects = "stop_exclusive", "arithmetic_fast", "ellipsoid_exact"
    assert "staged" not in compiled(blending_back(*effects), tmp_path / "back")


def test_a_record_grows_by_the_requested_fields():
    layout = runtime.kernels("records").RecordLayout
    assert layout(()).vec4s == 5
    assert layout(("lowpass_screen",)).names[-2:] == ["lowpass_x", "lowpass_y"]
    assert layout(RECORD, NORMAL).vec4s == 7
    assert layout(RECORD, NORMAL).position("nz") == (6, 2)
    assert layout(()).position("nz") == (0, 0)
    assert layout(("lowpass_screen", "footprint_mixed")).vec4s == 6
    assert layout(("footprint_box",)).position("edge_u0") == (4, 0), "a line of their own"
    assert layout(("rays", "footprint_box")).names == layout(("rays",)).names, "edges are curves"
    assert "boxed" in layout(("rays", "footprint_mixed")).names


def test_a_factory_makes_one_kernel_of_a_set():
    alone = blending(outputs=(), area=64)
    assert blending(outputs=(), area=64) is alone
    assert blending(outputs=(), area=64, on_gpu=False) is not alone
