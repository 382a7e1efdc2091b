"""Markers, cameras and devices in notebooks; ink and paper of markers."""

import cv2
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.scenes import PlacedMarker
from fidsplat.vision.detect import detect

DARK, PAPER = (0.1, 0.12, 0.1), (0.8, 0.78, 0.7)


def test_a_marker_is_shown_as_its_print():
    png = fs.marker("aruco:4x4_50:7", black=DARK, white=PAPER)._repr_png_()
    shown = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert shown.reshape(-1, 3).min(0).tolist() == [round(255 * value) for value in DARK]
    assert [code.name for code in detect(shown, ("4x4_50",))] == ["aruco:4x4_50:7"]
    round_tag = fs.marker("tagCircle21h7:3")._repr_png_()
    assert cv2.imdecode(np.frombuffer(round_tag, np.uint8), 0)[0, 0] in (127, 128)


def test_cameras_and_devices_are_tables():
    shown = fs.Camera.fisheye(64, 48, 2.0, coefficients=(0.1, 0, 0, 0))._repr_html_()
    assert "64 x 48 pixels" in shown
    assert "fisheye k1 = 0.1" in shown
    actual = fs.devices()
    assert actual._repr_html_().count("<tr>") == 1 + len(actual)
    assert "<td>reference</td>" in actual._repr_html_()


def test_ink_and_paper_are_rendered_saved_and_read(tmp_path):
    tag = fs.marker("tag36h11:5", size=0.2, black=DARK, white=PAPER)
    assert tag.inks == (DARK, PAPER)
    assert sum(tag.is_dark) == sum(fs.marker("tag36h11:5").is_dark)
    fs.Scene(markers=[PlacedMarker(tag)]).save(tmp_path / "a.toml")
    scene = fs.Scene.load(tmp_path / "a.toml")
    assert scene.markers[0].marker.inks == (DARK, PAPER)
    camera = fs.Camera.look_at(100, 100, 1.0, position=(0, 0, -0.4), target=(0, 0, 0))
    frame = fs.Renderer("opencl").render(scene, camera, background=(0.4, 0.4, 0.4))
    colors = np.unique(np.round(frame["rgb"].reshape(-1, 3), 4), axis=0)
    for color in (DARK, PAPER):
        assert np.abs(colors - color).max(1).min() < 1e-4
    assert [code.name for code in detect(frame.to_uint8())] == ["apriltag:36h11:5"]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"black": PAPER, "white": DARK}, "black must be darker than white"),
        ({"black": (0, 0)}, "black must be three numbers from 0 to 1"),
        ({"white": (2, 0, 0)}, "white must be three numbers from 0 to 1"),
    ],
)
def test_inks_are_checked(options, says):
    with pytest.raises(fs.InputError, match=says):
        fs.marker("qr:a", **options)
