"""Group C: order, ties and keys."""

import numpy as np
import pytest
from cases import assert_holds

import fidsplat as fs
from fidsplat.hard_cases import group_c
from fidsplat.hard_cases.coplanar import largest_jump, tag, turning
from fidsplat.hard_cases.invariance import trace


@pytest.mark.parametrize("case", group_c.CASES, ids=lambda case: case.name)
def test_case(renderer, case):
    assert_holds(renderer, case)


def test_every_entry_of_the_catalogue_is_there():
    assert [case.name for case in group_c.CASES] == [f"C{n}" for n in range(1, 3 + 1)]


@pytest.mark.parametrize("away", [0.0, 1.0])
def test_fronto_parallel_splats_do_tie(renderer, away):
    """numerics C1: rounding leaves few depths to 200 splats; otherwise the case decides nothing."""
    keys = trace(renderer, group_c.fronto_parallel(away))["keys"]
    assert len(np.unique(keys)) < 50


def test_a_tag_jumps_only_where_depth_decides(renderer):
    """Face to face, half of the depths change places within one step of 1e-4 degrees."""
    cloud = tag()
    before = largest_jump(renderer, turning(cloud, "order", steps=2))[0]
    after = largest_jump(renderer, turning(cloud, "blend", steps=2))[0]
    assert before > 0.2
    assert after < 1e-4


def test_a_real_marker_does_not_jump(renderer):
    cloud = fs.marker("apriltag:36h11:5", size=1.0).cloud
    for tilt in (0.0, 40.0):
        # what enters at a splat's rim enters with 1/255
        assert largest_jump(renderer, turning(cloud, "blend", steps=3, tilt=tilt))[0] < 1.1 / 255
    assert largest_jump(renderer, turning(cloud, "order", steps=3))[0] > 0.2
