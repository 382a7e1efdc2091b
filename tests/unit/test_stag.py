"""STag markers against their authors' detector."""

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.markers import marker
from fidsplat.markers.stag import codes
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.vision.detect import detect
from fidsplat.vision.readback import read_back


def test_a_marker_is_read_at_its_pose():
    pytest.importorskip("stag")
    camera = fs.Camera.look_at(320, 240, 1.0, position=(0.1, -0.05, -0.35), target=(0, 0, 0))
    sign = marker("stag:hd21:3", size=0.16)
    scene = Scene((), markers=(PlacedMarker(sign, np.eye(4)),), camera=camera, background=(1.0, 1.0, 1.0))
    image = fs.Renderer("opencl").render(scene)["rgb"]
    (reading,), others = read_back(np.clip(image, 0, 1), scene, camera)
    assert reading.corner_error < 0.3
    assert reading.position_error < 0.001
    assert not others
    # an image is searched for STags only on request
    assert detect(np.uint8(255 * np.clip(image, 0, 1))) == []


def test_libraries_have_the_published_numbers_of_distinct_codes():
    counts = {name: len(table) for name, table in codes().items()}
    assert counts == {"hd13": 2884, "hd15": 766, "hd17": 157, "hd19": 38, "hd21": 12, "hd23": 6}
    for name, count in counts.items():
        assert len(np.unique(codes()[name], axis=0)) == count


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        ("stag:hd21:12", "ids must be 0 to 11"),
        ("stag:3", "hd23, got 'stag:3'; write for example stag:hd21:3"),
        ("stag:hd21:x", "LIBRARY:ID"),
    ],
)
def test_specs_that_do_not_exist(spec, says, capsys):
    assert main(["marker", spec]) == 2
    assert says in capsys.readouterr().err
