"""Off-the-shelf detectors, each tested separately."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.experiments.plane import plane_image
from fidsplat.experiments.setup import BACKGROUND, CATEGORIES, PROTOCOLS
from fidsplat.images.files import to_uint8
from fidsplat.markers import marker
from fidsplat.vision.readers import Attempt, Target, attempt, overlap, reader_versions, readers

ALL = [("apriltag", name) for name in readers("apriltag")] + [("qr", name) for name in readers("qr")]


def ideal(category: str, tilt: float, protocol: str = "fixed-module") -> tuple[np.ndarray, Target]:
    spec = CATEGORIES[category].spec(1)
    sign, setting = marker(spec), PROTOCOLS[protocol]
    module, camera = setting.module(sign.grid.shape[0]), setting.camera(tilt)
    image = plane_image(sign.grid, module, camera, background=BACKGROUND)
    corners = camera.project(sign.corners / sign.module * module)
    return to_uint8(image), Target(sign.kind, sign.family or "", sign.id, sign.payload, corners)


def test_the_extra_detector_is_among_those_tested():
    assert readers("apriltag") == ("aruco", "pupil", "locus")
    assert readers("apriltag", "25h9") == ("aruco", "pupil")
    assert readers("qr") == ("cv2", "zxing", "zxing-tall")
    assert set(reader_versions()) == {"opencv", "zxing-cpp", "pupil-apriltags", "locus-tag"}


@pytest.mark.parametrize(("kind", "name"), ALL)
def test_each_reads_the_ideal_texture_in_front_and_nothing_in_grey(kind, name):
    image, target = ideal("apriltag" if kind == "apriltag" else "small", 10.0)
    assert attempt(name, image, target) == Attempt(True, True)
    assert attempt(name, np.full_like(image, 128), target) == Attempt(False, False)


@pytest.mark.parametrize(("kind", "name"), ALL)
def test_another_code_in_its_place_is_found_at_most_and_not_read(kind, name):
    image, target = ideal("apriltag" if kind == "apriltag" else "small", 10.0)
    other = replace(target, id=99) if kind == "apriltag" else replace(target, payload="another")
    result = attempt(name, image, other)
    assert not result.read
    # these report only decoded tags
    assert result.found == (name not in ("pupil", "locus"))


def test_a_code_whose_decoder_fails_is_found_and_not_read(monkeypatch):
    class Failing:  # no subclass: freeing one of a class of OpenCV corrupts Python's memory
        detect = cv2.QRCodeDetector().detect

        def detectAndDecode(self, grey):
            raise cv2.error("mode 15 in function 'decodeSymbols'")

    monkeypatch.setattr(cv2, "QRCodeDetector", Failing)
    image, target = ideal("small", 10.0)
    assert attempt("cv2", image, target) == Attempt(True, False)
    assert attempt("cv2", np.full_like(image, 128), target) == Attempt(False, False)


@pytest.mark.parametrize("name", ["aruco", "cv2", "zxing"])
def test_a_quadrilateral_elsewhere_is_not_the_code(name):
    image, target = ideal("apriltag" if name == "aruco" else "small", 10.0)
    wrong = replace(target, id=99, payload="another", corners=target.corners + 300.0)
    assert attempt(name, image, wrong) == Attempt(False, False)


@pytest.mark.parametrize("category", ["small", "large"])
def test_a_tilted_code_is_read_once_it_is_made_taller(category):
    image, target = ideal(category, 80.0)
    assert not attempt("zxing", image, target).read
    assert attempt("zxing-tall", image, target) == Attempt(True, True)


def test_places_that_were_found_are_those_of_the_untouched_image():
    """The rows are cut out and stretched; the outline must come back to where the code is."""
    image, target = ideal("medium", 75.0)
    assert not attempt("zxing", image, target).read
    moved = replace(target, payload="another")  # so that only the place counts
    assert attempt("zxing-tall", image, moved) == Attempt(True, False)
    assert not attempt(
        "zxing-tall", image, replace(moved, corners=moved.corners + np.array([0.0, 120.0]))
    ).found


@pytest.mark.sweep
def test_a_code_that_is_only_read_enlarged_is_found_where_it_is():
    """Modules of less than two pixels: read in an image twice as large."""
    image, target = ideal("small", 10.0)
    height, width = image.shape
    for pixels in range(width, 20, -4):
        shrunk = cv2.resize(image, (pixels, pixels * height // width), interpolation=cv2.INTER_AREA)
        same = replace(target, corners=target.corners * (pixels / width))
        other = replace(same, payload="another")  # so that only the place counts
        if attempt("zxing-tall", shrunk, same).read and not attempt("zxing", shrunk, other).found:
            break
    else:
        pytest.fail("at no size it must be enlarged")
    assert attempt("zxing-tall", shrunk, other) == Attempt(True, False)


def test_threads_do_not_disturb_each_other():
    shots = [ideal("apriltag", tilt, "fixed-plane") for tilt in range(0, 90, 6)]
    alone = [attempt(name, *shot) for shot in shots for name in readers("apriltag")]
    with ThreadPoolExecutor(4) as pool:
        together = list(
            pool.map(
                lambda one: attempt(one[1], *one[0]), [(s, n) for s in shots for n in readers("apriltag")]
            )
        )
    assert together == alone


def test_overlap_of_quadrilaterals():
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    assert overlap(unit, unit) == pytest.approx(1.0)
    assert overlap(unit, unit[::-1]) == pytest.approx(1.0)
    assert overlap(unit, unit + np.array([0.5, 0])) == pytest.approx(1 / 3)
    assert overlap(unit, unit + 2.0) == 0.0
    assert overlap(unit, np.zeros((4, 2))) == 0.0


def test_an_unknown_detector_is_an_error():
    image, target = ideal("small", 0.0)
    with pytest.raises(fs.InputError, match="unknown detector 'aruco' for qr; known: cv2, zxing, zxing-tall"):
        attempt("aruco", image, target)
