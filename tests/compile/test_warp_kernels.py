"""The Warp kernels' text: what a scene asked for and nothing else; CUDA's compiler takes it, GPU or not."""

import re

import pytest

from fidsplat.backends.warp import runtime
from fidsplat.effects import OUTPUTS

wp = pytest.importorskip("warp")
RECORD = ("lowpass_screen", "ray_depth", "normal", "compose_planes")
TAPS = ("depth", "depth_median", "depth_first", "heaviest", "blended", "fog")
ALL = (*RECORD, *TAPS)
MIXED = (*RECORD, "footprint_mixed", *TAPS)
OF_BOXES = ("edges", "cover")
FILTERS = ("make_boxes", "make_filter")
OF_SAMPLES = ("depth_weight", "depth_median", "depth_first", "heaviest", "blended", "fog_slope", "fogged")
LENSES = [
    ("camera_orthographic", "lowpass_screen", "normal"),
    *((f"camera_{name}", "rays", *RECORD) for name in ("brown_conrady", "fisheye", "equirectangular")),
]
STEPS = ("exposure", "vignetting", "noise", "gain", "response_srgb", "response_table", "quantise")


def made(name, *arguments):
    kernel = getattr(runtime.kernels(name.split(".")[0]), name.split(".")[1])
    return kernel(*arguments) if arguments else kernel


def compiled(kernel, folder, block=256, assembly=False):
    """Source text, without comments, that NVRTC compiled for a GPU of 2020; or the PTX that it made of it."""
    kernel.module.options["block_dim"] = block
    with runtime.quiet():
        wp.compile_aot_module(kernel.module, arch=80, module_dir=folder, use_ptx=True)
    (result,) = folder.glob("*.ptx")
    if assembly:
        return result.read_text()
    (source,) = folder.glob("*.cu")
    return re.sub(r"//[^\n]*", "", source.read_text())


def resolving(stretched, samples):
    """The kernel for all outputs."""
    planes = tuple(made("planes.of_samples", ALL).items())
    integers = tuple(output.name for output in OUTPUTS.values() if output.dtype == "int32")
    return made("resolve.make_resolve", tuple(OUTPUTS), integers, planes, stretched, samples)


@pytest.fixture(autouse=True)
def started():
    runtime.load()


@pytest.mark.parametrize(
    "kernel",
    [
        lambda: made("project.make_project", RECORD, 16, "float64", False),
        lambda: made("project.make_project", (*RECORD, "motion_groups"), 0, "float32", True),
        *(lambda camera=name: made("project.make_project", camera, 0, "float64", False) for name in LENSES),
        lambda: made("project.make_project", (*LENSES[1], "lowpass_pixel"), 0, "float64", False),
        lambda: made(
            "project.make_project", (*RECORD, "footprint_mixed", "lowpass_pixel"), 0, "float64", False
        ),
        lambda: made("project.make_project", ("footprint_box",), 0, "float32", False),
        lambda: made("project.make_project", (*LENSES[2], "footprint_mixed"), 0, "float64", False),
        lambda: made("project.make_project", (*LENSES[0], "footprint_mixed"), 0, "float64", False),
        lambda: made("blend.make_blend", ALL, True, 256)[0],
        lambda: made("blend.make_blend", (*ALL, "arithmetic_fast"), True, 256)[0],
        lambda: made("blend.make_blend", MIXED, True, 256)[0],
        lambda: made("blend.make_blend", ("footprint_box",), True, 256)[0],
        lambda: made("blend.make_blend", ("rays", "footprint_box"), True, 256)[0],
        lambda: made("blend.make_blend", ("rays", *MIXED), True, 256)[0],
        lambda: made("blend.make_blend", ("rays", *ALL, "rays_length"), True, 256)[0],
        lambda: made("blend.make_blend", ("camera_orthographic", *ALL), True, 256)[0],
        lambda: made("blend.make_blend", ("lowpass_screen", "stop_exclusive"), True, 256)[0],
        lambda: resolving(False, 3),
        lambda: resolving(True, 1),
        lambda: made("surroundings.make_backdrop", "gradient", False),
        lambda: made("surroundings.make_backdrop", "panorama", True),
        lambda: made("sensor.make_develop", STEPS)[0],
        lambda: made("shutter.make_expose", wp.vec4),
        lambda: made("lists.make_lists", True).emit,
        lambda: made("lists.make_lists", True).count,
        lambda: made("lists.make_lists", False).histogram,
        lambda: made("lists.compact"),
        lambda: made("lists.find_starts"),
    ],
    ids=[
        *("project", "project-float32", *(names[0] for names in LENSES), "project-filtered"),
        *("project-mixed", "project-boxes", "project-fisheye-mixed", "project-parallel-mixed"),
        *(
            "blend-all",
            "blend-fast",
            "blend-mixed",
            "blend-boxes",
            "blend-rays-boxes",
            "blend-rays-mixed",
            "blend-rays",
        ),
        *("blend-parallel", "blend-exclusive", "resolve", "resolve-stretched"),
        *("backdrop-gradient", "backdrop-panorama"),
        *("sensor", "expose", "emit", "count", "histogram", "compact", "starts"),
    ],
)
def test_the_kernels_compile_for_cuda(kernel, tmp_path):
    assert "wp::launch_bounds_t" in compiled(kernel(), tmp_path)


def test_the_base_text_has_nothing_of_absent_effects(tmp_path):
    text = compiled(made("blend.make_blend", (), True, 256)[0], tmp_path)
    absent = (*OF_SAMPLES, *OF_BOXES, "finished", "dot_x", "Layer", "thickest", "ink", "cross_ray", "origin")
    for name in absent:
        assert not re.search(rf"\b{name}", text), name
    project = compiled(made("project.make_project", (), 0, "float64", False), tmp_path / "project", 128)
    for name in FILTERS:
        assert name not in project, name
    everything = compiled(made("blend.make_blend", MIXED, True, 256)[0], tmp_path / "all")
    project = compiled(
        made("project.make_project", (*RECORD, "footprint_mixed", "lowpass_pixel"), 0, "float64", False),
        tmp_path / "mixed",
        128,
    )
    assert all(name in project for name in FILTERS)
    for name in (*OF_SAMPLES, *OF_BOXES, "Layer", "thickest", "ink"):
        assert re.search(rf"\b{name}", everything), name


def test_records_move_as_whole_lines(tmp_path):
    """Field by field, each store would touch 32 records of a warp."""
    project = compiled(
        made("project.make_project", RECORD, 0, "float64", False), tmp_path / "project", 128, assembly=True
    )
    assert project.count("st.global.v4") == 7
    blend = compiled(made("blend.make_blend", RECORD, True, 256)[0], tmp_path / "blend", assembly=True)
    assert blend.count("ld.shared.v4") >= 5
    assert "vote.sync.ballot" in blend


def test_a_record_grows_by_what_is_asked_for():
    layout = runtime.kernels("records").Layout
    assert layout(()).lines == 5
    assert layout(("lowpass_screen",)).names[-2:] == ["dot_x", "dot_y"]
    assert layout(RECORD).lines == 7
    assert layout(RECORD).place("nz") == (6, 1)
    assert layout(()).place("nz") == (0, 0)
    assert layout(("lowpass_screen", "footprint_mixed")).lines == 6
    assert layout(("footprint_box",)).place("edge_u0") == (4, 0), "a line of their own"
    assert layout(("rays", "footprint_box")).names == layout(("rays",)).names, "edges are curves"
    assert "boxed" in layout(("rays", "footprint_mixed")).names


def test_a_factory_makes_one_kernel_of_a_set():
    assert made("blend.make_blend", (), True, 64) is made("blend.make_blend", (), True, 64)
    assert made("blend.make_blend", (), True, 64) is not made("blend.make_blend", (), False, 64)
