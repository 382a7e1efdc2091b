"""Calibration by OpenCV: exact corners reproduce the camera; `fidsplat experiment calibrate`."""

import json
from dataclasses import replace

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.experiments.calibrate import LENSES, CalibrationSettings, errors_by_count, needed
from fidsplat.vision.calibration import (
    BoardView,
    calibrate,
    find_board,
    parameters,
    projection_errors,
)


def exact_views(settings: CalibrationSettings, count: int) -> list[BoardView]:
    rng, square = np.random.default_rng(1), 0.3 / 9
    x, y = (axis.ravel() * square for axis in np.meshgrid(np.arange(1, 9), np.arange(1, 6)))
    views = []
    while len(views) < count:
        camera = settings.camera(rng)
        points = np.column_stack([x, y, np.zeros_like(x)])
        corners = camera.project(points + settings.made.corners[0])
        inside = ((corners > 0) & (corners < settings.size)).all(1)
        if inside.sum() >= 10:
            views.append(BoardView(points[inside, :2], corners[inside]))
    return views


@pytest.mark.parametrize("lens", LENSES)
def test_exact_corners_give_the_camera_back(lens):
    settings = CalibrationSettings(lens=lens)
    calibration = calibrate(exact_views(settings, 10), settings.truth)
    true = parameters(settings.truth)
    assert parameters(calibration).keys() == true.keys()
    for name, value in parameters(calibration).items():
        # OpenCV accepts corners as float32: 3e-5 pixels
        assert abs(value - true[name]) < (2e-3 if name[0] in "fc" else 1e-4), name
    assert projection_errors(calibration, settings.truth).max() < 2e-3


def test_the_projection_ignores_a_rotation_and_measures_a_scale():
    expected = CalibrationSettings(lens="none").truth
    # a small shift of the principal point is almost a rotation of the camera
    assert projection_errors(replace(expected, cx=expected.cx + 1), expected).max() < 0.6
    assert projection_errors(replace(expected, fx=1.01 * expected.fx), expected).max() > 1


def test_what_cannot_be_calibrated():
    settings = CalibrationSettings(lens="none")
    views = exact_views(settings, 3)
    with pytest.raises(fs.InputError, match="at least 3 views of the board, got 2"):
        calibrate(views[:2], settings.truth)
    with pytest.raises(fs.InputError, match="none, brown_conrady or fisheye, got 'equirectangular'"):
        calibrate(views, fs.Camera.equirectangular(64, 32))
    with pytest.raises(fs.InputError, match="a ChArUco board"):
        find_board(np.zeros((64, 64, 3), np.uint8), fs.marker("gridboard:3x3:4x4_50"))
    assert find_board(np.zeros((64, 64, 3), np.uint8), settings.made) is None


def test_more_views_reduce_the_error():
    settings = CalibrationSettings(lens="none")
    rng = np.random.default_rng(0)
    views = [
        BoardView(view.points, view.corners + rng.normal(0, 0.2, view.corners.shape))
        for view in exact_views(settings, 9)
    ]
    rows = list(errors_by_count(settings, views))
    assert [row["views"] for row in rows] == [3, 4, 6, 8, 9]
    assert rows[-2]["projection_px"] < rows[0]["projection_px"]
    steps = [{"views": count, "quartiles_px": [0, high]} for count, high in ((3, 0.09), (4, 0.2), (6, 0.1))]
    assert needed(steps) == 6
    assert needed(steps[:2]) is None


def test_the_command(tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="the extra experiments is not installed")
    words = ("--board", "charuco:6x4:4x4_50", "--size", "320", "240", "--views", "6", "--lens", "none")
    assert main(["experiment", "calibrate", "-o", str(tmp_path), *words, "--device", "opencl", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "calibrate.json").read_text())
    assert printed["corner_rms_px"] < 0.15
    assert printed["rows"][-1]["projection_px"] < 1
    assert (tmp_path / "calibrate.svg").stat().st_size > 1000
    assert main(["experiment", "calibrate", "-o", str(tmp_path), *words]) == 2
    assert "already exists" in capsys.readouterr().err
    assert main(["experiment", "calibrate", "-o", str(tmp_path), "--lens", "fish"]) == 2
    assert "did you mean 'fisheye'" in capsys.readouterr().err
