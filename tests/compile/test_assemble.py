"""Kernels contain only the effects that a scene requests: their source text, arguments and memory."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest
from agreement import random_splats
from cloud_properties import CloudProperties

import fidsplat as fs
from fidsplat.backends.opencl.assemble import assemble, sections_of
from fidsplat.backends.opencl.effect_code import EFFECT_CODE
from fidsplat.backends.opencl.kernel_config import cpu_config, gpu_config
from fidsplat.capture.quality import ELLIPSOID
from fidsplat.effects import OUTPUTS, select
from fidsplat.effects.extensions import EXTENSIONS, Extension

BACKEND = "opencl"

SHAPE, GROUP = cpu_config(lanes=16, cores=2), gpu_config()
FURTHER = [name for name in OUTPUTS if name != "rgb"]
PLAIN = fs.Quality(lowpass="none")
SHARED_FILES = {
    *("prelude", "math", "bounds", "project", "splat", "blend", "part/conic", "part/perspective"),
    *("part/resolve_pixel", "effect/arithmetic_fast", "effect/camera_pinhole"),
    "part/blend_float",
    *("effect/color_rgb", "effect/order_centre"),
}
"""kernel files of a scene without effects, on all devices"""
SCHEDULE_FILES = {
    "lanes": {
        *("scan", "sort", "bin", "pack", "part/tile_loop_lanes"),
        "part/resolve_fused_lanes",
        "schedule/lanes",
        "schedule/lanes_culling",
    },
    "group": {
        *("list/tiled", "tile_lists", "part/chord", "part/resolve_fused_group"),
        *("schedule/group", "schedule/group_culling"),
    },
}
LOWPASS_FILES = {"none": {"effect/lowpass_none"}, "screen": {"effect/lowpass_screen"}}


COLORS = CloudProperties()


def record_bytes(features):
    return assemble(features, SHAPE).records["Splat"].itemsize


@pytest.mark.parametrize("output", FURTHER)
def test_an_output_adds_its_own_text_only(output):
    base = assemble(select(COLORS, fs.Capture(quality=PLAIN)), SHAPE)
    with_output = assemble(select(COLORS, fs.Capture(outputs=(output,), quality=PLAIN)), SHAPE)
    assert with_output.digest != base.digest
    # arguments that follow add a comma, fields that follow change a size
    base_lines, output_lines = (
        [line.rstrip(",") for line in re.sub(".*(#line|_has_the_size).*", "", one.text).splitlines() if line]
        for one in (base, with_output)
    )
    remaining = iter(output_lines)
    for line in base_lines:
        assert line in remaining, f"{output} removed or moved: {line}"
    needed = {output, *EFFECT_CODE[output].parts}
    others = [
        other
        for other in FURTHER
        if not any(other.startswith(own) or own.startswith(other) for own in needed)
    ]
    assert not any(re.search(rf"\b{other}_(out|raw)", with_output.text) for other in others)


def test_only_a_scene_of_both_footprints_selects_per_splat():
    features = {
        kind: select(
            CloudProperties(has_coplanar_groups=True, footprint=kind), fs.Capture(outputs=("depth", "label"))
        )
        for kind in ("gaussian", "box", "mixed")
    }
    texts = {kind: assemble(each, SHAPE).text for kind, each in features.items()}
    assert "IS_BOX" not in texts["gaussian"]
    assert "boxes" not in texts["box"]
    assert "#define IS_BOX(s) true" in texts["box"]
    assert "boxes[i]" in texts["mixed"]
    sizes = [record_bytes(each) for each in features.values()]
    assert sizes == sorted(sizes)


def test_record_sizes_follow_from_the_effects():
    def record(outputs, quality=PLAIN, degree=-1):
        return record_bytes(select(CloudProperties(degree), fs.Capture(outputs=outputs, quality=quality)))

    # 72 bytes and 4 for each word that an effect adds, in whole vectors of 16
    assert record(("rgb",)) == record(("alpha",)) == record(("rgb",), degree=3) == 80
    assert assemble(select(COLORS, fs.Capture(quality=PLAIN)), SHAPE).records["Bounds"].itemsize == 32
    assert record(("rgb",), fs.Quality()) == record(("label",)) == 80
    assert record(("depth",)) == record(("depth", "depth_median")) == record(("normal",)) == 96
    assert record(("depth", "normal")) == record(("depth", "label"), fs.Quality()) == 96
    assert record_bytes(select(CloudProperties(has_coplanar_groups=True), fs.Capture(quality=PLAIN))) == 96


def test_options_of_3d_gaussians_do_not_change_other_scenes():
    """No option of 3D Gaussians changes the text of a scene without them."""
    words = (
        "thickness",
        "THICK_HERE",
        "ellipsoid_term",
        "conjugate_disk",
        "slopes",
        "ellipsoid",
        "conic_facing",
    )
    for outputs, shape in ((("rgb",), SHAPE), (tuple(FURTHER), GROUP)):
        plain = assemble(select(COLORS, fs.Capture(outputs=outputs)), shape)
        assert not [word for word in words if word in plain.text]
        for way in ELLIPSOID:
            requested = fs.Capture(outputs=outputs, quality=fs.Quality(ellipsoid=way))
            assert assemble(select(COLORS, requested), shape).digest == plain.digest
            assert (
                assemble(select(CloudProperties(ellipsoids="some"), requested), shape).digest != plain.digest
            )


def test_clouds_of_3d_gaussians_only_have_smaller_records():
    """All splats are disks that face the camera: constant fields are not in records."""
    constant = {"nuy", "d0", "dx", "dy", "d_near"}
    for shape in (SHAPE, GROUP):
        alone, among = (
            assemble(select(CloudProperties(ellipsoids=which), fs.Capture(outputs=("depth",))), shape)
            for which in ("all", "some")
        )
        assert constant <= set(among.records["Splat"].names or ())
        assert not constant & set(alone.records["Splat"].names or ())
    assert record_bytes(select(CloudProperties(ellipsoids="all"), fs.Capture())) == 64
    assert record_bytes(select(CloudProperties(ellipsoids="some"), fs.Capture())) == 80


def test_an_extension_that_fills_an_unknown_hook_is_refused(monkeypatch, tmp_path):
    (tmp_path / "toy.cl").write_text("//@ no_such_hook\nx\n")
    monkeypatch.setitem(EXTENSIONS, "toy", Extension("toy", tmp_path / "toy.cl"))
    features = replace(select(COLORS, fs.Capture(quality=PLAIN)), post_steps=("toy",))
    with pytest.raises(fs.DeviceError, match="no_such_hook"):
        assemble(features, SHAPE)
    assert "toy" not in EFFECT_CODE


def test_each_section_of_a_kernel_file_fills_a_hook():
    files = sorted((Path(__file__).resolve().parents[2] / "kernels" / "opencl").rglob("*.cl"))
    texts = [file.read_text() for file in files]
    hooks = {hook for text in texts for hook in re.findall(r"^[ \t]*//@@ (\w+)", text, re.MULTILINE)}
    for file in files:
        assert sections_of(str(file)).keys() <= hooks, file


def test_order_by_centres_has_no_layers():
    layered = CloudProperties(has_coplanar_groups=True)
    in_order = fs.Capture(outputs=tuple(FURTHER), quality=PLAIN.with_(order="centre"))
    plain = fs.Capture(outputs=tuple(FURTHER), quality=PLAIN)
    texts = [assemble(select(*each), SHAPE).text for each in ((layered, in_order), (COLORS, plain))]
    assert texts[0] == texts[1] != assemble(select(layered, plain), SHAPE).text


def test_text_does_not_depend_on_numbers():
    numbers = fs.Quality(lowpass="none", alpha_cutoff=0.01, transmittance_stop=0.5, opacity_ceiling=0.7)
    assert select(COLORS, fs.Capture(quality=numbers)) == select(COLORS, fs.Capture(quality=PLAIN))


def test_features_are_the_same_whatever_the_order_of_outputs():
    assert select(CloudProperties(2), fs.Capture(outputs=["rgb", "label", "depth"], quality=PLAIN)) == select(
        CloudProperties(2), fs.Capture(outputs=("depth", "label"), quality=PLAIN)
    )


def kernel_files(source):
    """Kernel files that have lines in a source text, without their ending."""
    return set(re.findall(r'^#line \d+ "opencl/(.*)\.cl"$', source.listing, re.MULTILINE))


@pytest.mark.parametrize("lowpass", LOWPASS_FILES)
@pytest.mark.parametrize("schedule", SCHEDULE_FILES)
def test_a_scene_without_effects_has_lines_of_these_files_only(schedule, lowpass):
    source = assemble(
        select(COLORS, fs.Capture(quality=fs.Quality(lowpass=lowpass))),
        {"lanes": SHAPE, "group": GROUP}[schedule],
    )
    culling = {"part/cull_frustum"} if (schedule, lowpass) == ("lanes", "screen") else set()
    expected = SHARED_FILES | SCHEDULE_FILES[schedule] | LOWPASS_FILES[lowpass] | culling
    assert kernel_files(source) == expected


# of each kernel without effects: arguments, buffers among them, bytes of local memory
TAKEN = {
    "lanes": {
        "bin_count": (9, 5, 0),
        "bin_emit": (13, 7, 0),
        "blend": (17, 6, 0),
        "pack_count": (3, 2, 0),
        "pack_move": (8, 7, 0),
        "project": (14, 12, 0),
        "scan_bins": (5, 3, 16),
        "scan_blocks": (3, 2, 0),
        "sort_count": (6, 3, 0),
        "sort_scatter": (10, 7, 0),
    },
    "group": {
        "blend": (18, 6, 15508),
        "emit": (17, 8, 18708),
        "project": (14, 12, 0),
        "sort_tiles": (6, 4, 20556),
        "count_big": (7, 3, 272),
        "tile_starts": (7, 5, 12288),
    },
}


@pytest.mark.parametrize("schedule", ["lanes", "group"])
def test_arguments_and_local_memory_without_effects(renderer, schedule):
    """Absent effects must not add any."""
    shape = SHAPE if schedule == "lanes" else GROUP
    pipeline = renderer.backend.pipeline(select(COLORS, fs.Capture(quality=PLAIN)), shape)
    local = cl.kernel_work_group_info.LOCAL_MEM_SIZE
    arguments = {}
    for name in pipeline.source.arguments:
        kernel = cl.Kernel(pipeline.program.programs[name], name)
        head = re.search(rf"void {name}\(([^{{]*?)\)\s*\{{", pipeline.source.text)
        assert head, name
        arguments[name] = kernel.num_args, len(re.findall(r"\bglobal\b", head[1]))
        # drivers may pad local memory
        staged = kernel.get_work_group_info(local, renderer.backend.device)
        assert 0 <= staged - TAKEN[schedule][name][2] < 64, name
    assert arguments == {name: numbers[:2] for name, numbers in TAKEN[schedule].items()}


def test_the_readme_lists_exactly_the_hooks_of_the_kernels():
    folder = Path(__file__).resolve().parents[2] / "kernels"
    page = (folder / "README.md").read_text("utf-8")
    texts = [file.read_text("utf-8") for file in (folder / "opencl").rglob("*.cl")]
    hooks = {hook for text in texts for hook in re.findall(r"^[ \t]*//@@ (\w+)", text, re.MULTILINE)}
    assert len(hooks) > 50
    rows = page[page.index("| hook |") : page.index("## Dialect rules")].splitlines()[2:]
    listed = {name for row in rows if row for name in re.findall(r"`(\w+)`", row.split("|")[1])}
    assert listed == hooks


def test_no_kernel_calls_functions_without_error_bounds():
    for file in (Path(__file__).resolve().parents[2] / "kernels" / "opencl").rglob("*.cl"):
        assert not re.search(r"\b(native|half)_\w+\(", file.read_text("utf-8")), file


# settings that the compile matrix (test_matrix.py) does not combine with everything
SETTINGS = {
    "double": {"quality": fs.Quality(blend_precision="float64")},
    "half": {"quality": fs.Quality(blend_precision="float16")},
    "precise": {"quality": fs.Quality(arithmetic="precise")},
}


@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.parametrize("outputs", [("rgb",), ("rgb", *FURTHER)], ids=["rgb", "all"])
def test_quality_settings_compile_and_run_with_all_outputs_and_none(renderer, name, outputs):
    cloud = random_splats(20, seed=1, depth=(1, 4)).with_coplanar_groups(np.arange(20) // 2 - 1)
    if name == "double" and not renderer.device.float64:
        pytest.skip("the device has no float64")
    if name == "double":
        cloud = cloud.with_boxes(np.arange(20) // 2 % 2 == 0)
    camera = fs.Camera.pinhole(20, 12, 20.0, 20.0, 10.0, 6.0)
    frame = renderer.render(cloud, camera, outputs=outputs, **SETTINGS[name])
    assert all(np.isfinite(frame[each]).all() for each in frame)


MOVING = fs.Motion(lambda time: np.eye(4))


def test_only_pinhole_frames_of_several_poses_are_culled_by_spheres():
    lens = fs.Camera.fisheye(20, 20, 2.0)
    for expected, footprint, quality, camera, exposed in (
        (True, "gaussian", fs.Quality(), None, True),
        (True, "gaussian", PLAIN, None, True),
        (False, "gaussian", PLAIN, None, False),
        (False, "gaussian", PLAIN, lens, True),
        (False, "mixed", PLAIN, None, True),
        (False, "box", PLAIN, None, True),
        (False, "gaussian", fs.Quality(lowpass="pixel"), None, True),
    ):
        chosen = select(
            CloudProperties(footprint=footprint),
            fs.Capture(
                camera, quality=quality, motion=MOVING, shutter=fs.Shutter(exposure_time=0.1 * exposed)
            ),
        )
        assert ("sub_frame_culling" in chosen.names) == expected
        assert ("reach * sqrt(fy" in assemble(chosen, SHAPE).text) == expected


def test_pipelines_are_compiled_once(renderer):
    features = select(COLORS, fs.Capture(quality=PLAIN))
    assert renderer.backend.pipeline(features) is renderer.backend.pipeline(features)


def test_half_precision_and_approximate_arithmetic_add_their_instructions_of_a_dialect_only():
    ptx = gpu_config(dialect="ptx")
    for quality, added in (
        ({}, set()),
        ({"arithmetic": "approximate"}, {"ex2.approx"}),
        ({"blend_precision": "float16"}, {"ex2.approx", "fma.rn.f16x2"}),
    ):
        features = select(COLORS, fs.Capture(quality=PLAIN.with_(**quality)))
        text = assemble(features, ptx).text
        assert {word for word in ("ex2.approx", "fma.rn.f16x2") if word in text} == added
        portable = assemble(features, GROUP).text
        assert "asm(" not in portable
        assert ("vstore_half_rte" in portable) == ("blend_precision" in quality)
