"""Families of AprilTag 3: the codes and detections of the AprilTag library, holes, spellings."""

import sys

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.images.apriltag3 import HOLE, LAYOUTS, codes
from fidsplat.markers import marker
from fidsplat.markers.kinds import bits_of, parse_spec
from fidsplat.scenes import PlacedMarker
from fidsplat.vision import read_back
from fidsplat.vision.apriltag_library import _detector
from fidsplat.vision.detect import detect


@pytest.mark.parametrize("family", LAYOUTS)
def test_codes_are_those_of_the_library(family):
    pytest.importorskip("pupil_apriltags")
    theirs = _detector(family).tag_families["added"].contents
    assert np.array_equal(np.ctypeslib.as_array(theirs.codes, (theirs.ncodes,)), codes(family))
    assert (theirs.total_width, theirs.width_at_border) == LAYOUTS[family]


def test_the_library_reads_rendered_tags_at_their_poses():
    pytest.importorskip("pupil_apriltags")
    markers = [marker(f"apriltag:{family}:{len(codes(family)) - 1}", size=0.1) for family in LAYOUTS]
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = 0.2 * np.arange(5) - 0.4
    camera = fs.Camera.look_at(480, 120, 1.2, position=(0.05, 0.15, -0.8), target=(0, 0, 0))
    scene = fs.Scene(camera=camera, markers=[PlacedMarker(m, p) for m, p in zip(markers, poses, strict=True)])
    capture = fs.Capture(camera, outputs=("rgb",), background=(0.5, 0.5, 0.5))
    readings = read_back(fs.Renderer("opencl").render(scene, capture), scene).readings
    assert [r.detection and r.detection.name for r in readings] == [m.spec for m in markers]
    for reading in readings:
        assert reading.corner_error is not None
        assert reading.corner_error < 0.05
        assert reading.position_error is not None
        assert reading.position_error < 0.005


def test_a_recursive_tag_has_a_tag_in_its_hole():
    pytest.importorskip("pupil_apriltags")
    outer = marker("tagCustom48h12:7", size=0.3)
    # the hole has 2 of the border's 6 modules; 36h11 has 8 modules and a quiet zone of one
    inner = marker("tag36h11:5", size=0.3 * 2 / 6 * 8 / 10)
    camera = fs.Camera.look_at(400, 400, 0.5, position=(0, 0, -1.2), target=(0, 0, 0))
    scene = fs.Scene(camera=camera, markers=[PlacedMarker(outer), PlacedMarker(inner)])
    capture = fs.Capture(camera, outputs=("rgb",), background=(0.5, 0.5, 0.5))
    readings = read_back(fs.Renderer("opencl").render(scene, capture), scene).readings
    assert all(reading.detection is not None for reading in readings)
    assert max(reading.corner_error or 0 for reading in readings) < 0.05


@pytest.mark.parametrize("mixture", ["exact", "fitted", "facets"])
def test_holes_have_no_splats(mixture):
    tag = marker("apriltag:circle21h7:3", size=0.05, mixture=mixture)
    assert (tag.module, tag.quiet_zone) == (0.01, 0)
    assert np.allclose(np.abs(tag.corners[:, :2]), 0.025)
    modules = np.floor(tag.cloud.means[:, :2] / tag.module + 4.5).astype(int)
    inside = ((modules >= 0) & (modules < 9)).all(1)
    assert not (tag.bits[modules[inside, 1], modules[inside, 0]] == HOLE).any()
    assert {(x, y) for y, x in zip(*np.nonzero(tag.bits == HOLE), strict=True)} >= {(0, 0), (8, 0), (8, 8)}
    with pytest.raises(fs.InputError, match=r"the quiet zone of a round tag must be 0, got 1"):
        marker("apriltag:circle21h7:3", quiet_zone=1)


@pytest.mark.parametrize(
    ("foreign", "ours"),
    [
        ("tag36h11:5", "apriltag:36h11:5"),
        ("tagStandard41h12:9", "apriltag:standard41h12:9"),
        ("apriltag:tag25h9:3", "apriltag:25h9:3"),
        ("DICT_4X4_50:7", "aruco:4x4_50:7"),
        ("DICT_APRILTAG_16h5:1", "apriltag:16h5:1"),
        ("DICT_ARUCO_ORIGINAL:1", "aruco:original:1"),
        ("dict_aruco_mip_36h12:1", "aruco:mip_36h12:1"),
        ("charuco:5x4:DICT_4X4_50", "charuco:5x4:4x4_50"),
    ],
)
def test_spellings_of_other_projects(foreign, ours):
    (one, bits), (other, expected) = bits_of(parse_spec(foreign)), bits_of(parse_spec(ours))
    assert (one.kind, one.family, one.id) == (other.kind, other.family, other.id)
    assert np.array_equal(bits, expected)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("apriltags:36h11:5", "unknown kind of marker 'apriltags' (did you mean 'apriltag:36h11:5'?)"),
        ("apriltag:standart41h12:5", "(did you mean 'standard41h12'?)"),
        ("tag36h12:5", "did you mean"),
        ("tagStandard41h12:2115", "ids must be 0 to 2114, got 2115"),
        ("aprilgrid:2x2:standard41h12", "must be one of OpenCV's dictionaries"),
    ],
)
def test_errors_suggest_the_nearest(text, says):
    with pytest.raises(fs.InputError) as error:
        bits_of(parse_spec(text))
    assert says in str(error.value)


def test_without_the_library_the_error_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pupil_apriltags", None)
    monkeypatch.setattr("fidsplat.vision.apriltag_library._idle", {})
    with pytest.raises(fs.DeviceError, match="pip install pupil-apriltags"):
        detect(np.zeros((40, 40), np.uint8), ("tagCircle21h7",))
