"""The schedule for GPUs renders every effect and every output as the reference does, on whatever OpenCL
device this is: where these run there is no GPU."""

import numpy as np
import pytest
from agreement import compare, random_splats, some_thick
from combined import LENSES, SIZE, Combination, all_effects, combination, rotating, sliding

import fidsplat as fs
from fidsplat.backends.prepare import prepare
from fidsplat.backends.reference import ReferenceBackend
from fidsplat.effects import OUTPUTS
from fidsplat.effects.catalogue import CATALOGUE

BACKEND = "opencl"
SPLATS = random_splats(40, 21, depth=(0.8, 4.0), scale=(0.05, 0.5), across=1.2)
CAMERA = fs.Camera.pinhole(*SIZE, 30.0, 30.0, 18.0, 11.0)
ELSEWHERE = {
    *("distortion", "overdraw", "rounding", "termination_depths"),
    *("arithmetic_approximate", "blend_half"),
}
"""tests/contract/test_gradients.py has the first two, test_error_output.py the third,
tests/unit/test_store_occlusion.py the fourth, and test_quality_settings.py the others"""


def taken(cloud, outputs=tuple(OUTPUTS), **how):
    return Combination(cloud, fs.Capture(CAMERA, outputs, **how))


def gaussians_and_an_external_depth_image():
    rng = np.random.default_rng(0)
    surface = fs.ExternalDepth(rng.random((*SIZE[::-1], 3)), rng.uniform(0.9, 3.0, SIZE[::-1]), 77)
    thick = some_thick(SPLATS, SPLATS.scales[::-1, 0])
    return taken(thick, quality="standard,ellipsoid=ewa_antialiased", external_depth=surface)


PICTURES = {
    **{f"all behind {lens}": lambda lens=lens: combination(all_effects(lens)) for lens in [None, *LENSES]},
    "3D Gaussians and an external depth image": gaussians_and_an_external_depth_image,
    "disks under a shutter": lambda: taken(
        SPLATS,
        quality="standard,order=pixel",
        motion=fs.Motion(rotating, {0: sliding}),
        shutter=fs.Shutter(exposure_time=0.2, sub_poses=2, readout=0.4, rows_per_band=8),
    ),
    "splats whose centres a fisheye does not see": lambda: Combination(
        random_splats(60, 0, depth=(-5.0, 6.0)),
        fs.Capture(fs.Camera.fisheye(*SIZE, 2.0), ("rgb", "depth", "normal"), quality="standard"),
    ),
    "coplanar groups by pixel": lambda: taken(
        SPLATS.with_coplanar_groups(np.maximum(np.arange(len(SPLATS)) % 9 - 6, -1)),
        quality="standard,order=pixel",
    ),
    "boxes in float64": lambda: taken(SPLATS.with_boxes(), quality="standard,blend_precision=float64"),
}


@pytest.mark.parametrize("name", PICTURES)
def test_it_agrees_with_the_reference(renderer, name):
    requested = PICTURES[name]()
    backend, reference = renderer.backend, ReferenceBackend()
    features, view = prepare(requested.cloud, requested.capture)
    groups = backend.configs("schedule")["groups"]
    images = backend.pipeline(features, groups).render_view(backend.upload(requested.cloud), view)
    rendered = {output: images.read(output, 0) for output in requested.capture.outputs}
    expected = (
        reference.pipeline(requested.features("alpha"))
        .render_view(reference.upload(requested.cloud), view)
        .arrays_of(0)
    )
    differences = compare(rendered, expected, requested.capture.outputs)
    # of so few pixels a single one that is hard is too large a share
    wrong = [one for one in differences if not (one.finite and one.excess <= 0)]
    assert not wrong, wrong
    assert rendered["rgb"].std() > 0.02


def test_nothing_is_left_out():
    every = [make().features() for make in PICTURES.values()]
    assert set().union(*(features.names for features in every)) == set(CATALOGUE) - ELSEWHERE
