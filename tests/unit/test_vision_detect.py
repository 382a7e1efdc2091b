"""Detectors on ideal images: detected codes, their corners, and no false detections."""

import cv2
import numpy as np
import pytest
from ideal_image import draw, photographed, pose, qr_bits, turned

from fidsplat.cameras import Camera
from fidsplat.images.apriltag3 import HOLE, LAYOUTS, outside
from fidsplat.images.tag_dictionaries import dictionary_bits, families, parse_family, predefined
from fidsplat.util.errors import InputError
from fidsplat.vision.align import align, fit
from fidsplat.vision.detect import DEFAULT_FAMILIES, detect
from fidsplat.vision.pose import marker_pose, plane_pose, pose_error

CAMERA = Camera.pinhole(480, 400, 700, 700, 240, 200)
SIZE = 0.2


def seen(bits, pixels, tilt=0.0, spin=0.0, quiet=1, camera=CAMERA, aside=(0.007, -0.011)):
    """A code about ``pixels`` wide: uint8 image, corners, camera_from_marker."""
    placed = pose(turned(tilt, spin), [*aside, camera.fx * SIZE / pixels])
    picture, corners = draw(bits, SIZE, placed, camera, quiet)
    return photographed(picture), corners, placed


def corner_error(detection, corners):
    return float(np.linalg.norm(detection - corners, axis=1).max())


@pytest.mark.sweep
@pytest.mark.parametrize("family", families())
def test_every_family_is_found_and_its_corners_are_those_of_the_print(family):
    kind, _ = parse_family(family)
    # the last id of `original` looks the same upside down
    tag_id = families()[family].count - 2
    bits = dictionary_bits(kind, family, tag_id)
    picture, corners, _ = seen(bits * (bits != HOLE), 150, tilt=20, spin=100)
    if family in LAYOUTS:  # corners of the border
        inner, size = outside(family) / len(bits), np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
        frame = cv2.getPerspectiveTransform(size, corners.astype(np.float32))
        corners = cv2.perspectiveTransform((inner + size * (1 - 2 * inner))[None], frame)[0]
    detections = detect(picture, families=[family], qr=False)
    assert [(d.kind, d.family, d.id, d.payload) for d in detections] == [(kind, family, tag_id, None)]
    assert corner_error(detections[0].corners, corners) < 0.1
    assert detections[0].name == f"{kind}:{family}:{tag_id}"


@pytest.mark.parametrize(
    ("pixels", "tilt", "limit"), [(40, 0, 0.1), (150, 0, 0.05), (300, 10, 0.05), (150, 60, 0.1)]
)
def test_tag_corners_and_pose(pixels, tilt, limit):
    picture, corners, placed = seen(dictionary_bits("apriltag", "36h11", 5), pixels, tilt, spin=8)
    (tag,) = detect(picture)
    assert tag.name == "apriltag:36h11:5"
    assert corner_error(tag.corners, corners) < limit
    apart, angle = pose_error(marker_pose(tag.corners, SIZE, CAMERA), placed)
    assert apart < 0.002 * placed[2, 3]
    assert np.degrees(angle) < (5.0 if pixels == 40 else 1.0)


@pytest.mark.parametrize(("length", "pixels"), [(20, 150), (100, 185), (250, 250)])
@pytest.mark.parametrize(("tilt", "spin"), [(0, 0), (0, 130), (45, 15)])
def test_qr_codes_are_read_and_their_corners_serve_a_pose(length, pixels, tilt, spin):
    text = "".join(chr(97 + k % 26) for k in range(length))
    picture, corners, placed = seen(qr_bits(text), pixels, tilt, spin, quiet=4)
    (code,) = detect(picture, families=())
    assert (code.kind, code.id, code.payload) == ("qr", None, text)
    assert code.family == {20: "v2-L", 100: "v5-L", 250: "v10-L"}[length]
    assert corner_error(code.corners, corners) < 0.1
    apart, angle = pose_error(marker_pose(code.corners, SIZE, CAMERA), placed)
    assert apart < 0.002 * placed[2, 3]
    assert np.degrees(angle) < 1.0


@pytest.mark.parametrize("aside", [True, False])
def test_a_steep_qr_code_is_read_by_stretching_the_image(aside):
    camera = Camera.pinhole(640, 640, 2400, 2400, 320, 320)
    picture, corners, _ = seen(qr_bits("a" * 20), 350, tilt=80, quiet=4, camera=camera, aside=(0, 0))
    if aside:
        picture = np.ascontiguousarray(picture.T)
    (code,) = detect(picture, families=())
    assert code.payload == "a" * 20
    # a transposed image shows a mirrored code, whose corners go round the other way
    expected = corners[:, ::-1] if aside else corners
    best = min(
        corner_error(np.roll(order, k, 0), expected)
        for order in (code.corners, code.corners[::-1])
        for k in range(4)
    )
    assert best < 1.0


# OpenCV's own corners are 2.5 px off here, more than a module of the short sides
STEEP = Camera.look_at(
    640, 480, 0.351, (-2.80253, -0.350656, -0.332148), (-0.0381, -0.0284, 0.0), (-0.196, 0.981, 0.3)
)


def test_a_steep_tags_corners_are_looked_for_in_more_than_one_way():
    picture, corners = draw(dictionary_bits("apriltag", "36h11", 5), 0.16, STEEP.world_to_camera, STEEP)
    (tag,) = detect(photographed(picture), ["36h11"], qr=False)
    assert corner_error(tag.corners, corners) < 0.2


def test_corners_that_do_not_settle_are_counted_from_the_edge_of_the_image_too(monkeypatch):
    """OpenCV counts from the centre of the first pixel; nothing moves its corners here."""
    picture, corners, _ = seen(dictionary_bits("apriltag", "36h11", 5), 100, tilt=30, spin=8)
    monkeypatch.setattr("fidsplat.vision.detect.align", lambda *args, **more: None)
    (tag,) = detect(picture, ["36h11"], qr=False)
    assert np.abs((tag.corners - corners).mean(0)).max() < 0.08


def test_where_no_corners_settle_those_that_fit_best_are_given(monkeypatch):
    bits = dictionary_bits("apriltag", "36h11", 5)
    picture, corners = draw(bits, 0.16, STEEP.world_to_camera, STEEP)
    grey, tried = photographed(picture), {}
    monkeypatch.setattr("fidsplat.vision.detect.align", lambda *args, **more: None)
    monkeypatch.setattr(
        "fidsplat.vision.detect.fit", lambda *args: tried.setdefault(args[1].tobytes(), fit(*args))
    )
    (tag,) = detect(grey, ["36h11"], qr=False)
    assert tag.name == "apriltag:36h11:5"
    assert len(tried) > 1
    assert tried[tag.corners.tobytes()] == max(tried.values())
    assert fit(grey, corners, bits) > max(tried.values()) > fit(grey, np.roll(corners, 1, 0), bits)


def test_one_square_is_given_once_and_in_the_family_named_first():
    picture, _, _ = seen(dictionary_bits("aruco", "4x4_50", 7), 150)
    assert [d.name for d in detect(picture, ["4x4_100", "4x4_50"], qr=False)] == ["aruco:4x4_100:7"]
    assert [d.name for d in detect(picture, ["4x4_50", "4x4_100", "4x4_50"], qr=False)] == ["aruco:4x4_50:7"]


def test_an_image_with_several_codes():
    left, _, _ = seen(dictionary_bits("apriltag", "36h11", 300), 150)
    right, _, _ = seen(dictionary_bits("aruco", "4x4_50", 7), 150, tilt=30)
    below, _, _ = seen(qr_bits("two words"), 150, quiet=4)
    detections = detect(
        np.repeat(np.vstack([np.hstack([left, right]), np.hstack([below, below])])[:, :, None], 3, 2)
    )
    assert [d.name for d in detections] == [
        "apriltag:36h11:300",
        "aruco:4x4_50:7",
        "qr:two words",
        "qr:two words",
    ]
    assert detections[0].corners[:, 0].max() < 480 < detections[1].corners[:, 0].min()


def test_neighbours_are_two_tags():
    """Their middles are 1.3 sides apart."""
    left, _, _ = seen(dictionary_bits("apriltag", "36h11", 7), 150, aside=(0, 0))
    right, _, _ = seen(dictionary_bits("apriltag", "36h11", 8), 150, aside=(0, 0))
    detections = detect(np.hstack([left[:, 140:340], right[:, 140:340]]), ["36h11"], qr=False)
    assert [tag.name for tag in detections] == ["apriltag:36h11:7", "apriltag:36h11:8"]


@pytest.mark.parametrize("fails", [cv2.aruco.CORNER_REFINE_SUBPIX, cv2.aruco.CORNER_REFINE_APRILTAG])
def test_either_way_to_squares_is_enough_and_both_give_a_tag_once(fails, monkeypatch):
    picture, corners, _ = seen(dictionary_bits("apriltag", "36h11", 5), 160, tilt=20, spin=8)
    assert len(detect(picture)) == 1

    class Detector:
        def __init__(self, dictionary, parameters):
            self.blind = parameters.cornerRefinementMethod == fails
            self.real = real(dictionary, parameters)

        def detectMarkers(self, image):
            return ((), None, ()) if self.blind else self.real.detectMarkers(image)

    real = cv2.aruco.ArucoDetector
    monkeypatch.setattr(cv2.aruco, "ArucoDetector", Detector)
    (tag,) = detect(picture)
    assert tag.name == "apriltag:36h11:5"
    assert corner_error(tag.corners, corners) < 0.05


def test_nothing_is_found_where_nothing_is():
    noise = np.random.default_rng(3).integers(0, 256, (240, 320), dtype=np.uint8)
    assert detect(noise) == []
    assert detect(np.zeros((3, 3, 3), np.uint8)) == []
    assert detect(np.zeros((0, 4), np.uint8)) == []


def test_what_detect_cannot_use():
    with pytest.raises(InputError, match="36h11"):
        detect(np.zeros((9, 9), np.uint8), ["36h12"])
    with pytest.raises(ValueError, match="uint8"):
        detect(np.zeros((9, 9)))
    assert {parse_family(f)[1] for f in DEFAULT_FAMILIES} == set(DEFAULT_FAMILIES)
    with pytest.raises(InputError, match="rows of real numbers"):
        detect([[1], [2, 3]])
    with pytest.raises(InputError, match="qr must be True or False"):
        detect(np.zeros((60, 60), np.uint8), qr=np.eye(4))
    for expected in (5, "36h11"):
        with pytest.raises(InputError, match="families must be several names"):
            detect(np.zeros((60, 60), np.uint8), expected)


@pytest.mark.parametrize("spin", [0.0, 90.0])
def test_what_is_viewed_frontally_has_a_pose(spin):
    """Where OpenCV's IPPE divides by next to nothing: squares, and boards of many points."""
    points = np.stack(np.meshgrid([-0.12, -0.04, 0.04, 0.12], [-0.08, 0, 0.08]), -1).reshape(-1, 2)
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * SIZE / 2
    for distance in np.linspace(0.5, 3, 250):
        placed = pose(turned(0, spin), [0, 0, distance])
        for flat in (square, points):
            pixels = CAMERA.project(np.pad(flat, ((0, 0), (0, 1))) @ placed[:3, :3].T + placed[:3, 3])
            # as detectors give them
            pixels = pixels.astype(np.float32).astype(np.float64)
            actual = marker_pose(pixels, SIZE, CAMERA) if flat is square else plane_pose(flat, pixels, CAMERA)
            apart, angle = pose_error(actual, placed)
            assert apart < 1e-4 * distance
            assert angle < 0.01


def test_corners_of_no_square_before_the_camera_have_no_pose():
    """They cross; the squares that come nearest lie behind it."""
    crossed = np.array([[73.0, 55.0], [231.0, 136.0], [385.0, 7.0], [39.0, 111.0]])
    assert np.isnan(marker_pose(crossed, SIZE, CAMERA)).all()


def test_what_has_no_pose():
    camera, corners = Camera.pinhole(9, 9, 9, 9, 4, 4), np.eye(4)[:, :2]
    for given, says in (
        ((np.eye(4), 0.1, camera), r"corners must be \(4, 2\)"),
        ((corners, (0, 0, 0), camera), "size must be a positive length"),
        ((corners, float("nan"), camera), "size must be a positive length"),
        ((corners, 0.1, None), "camera must be a Camera, got None"),
    ):
        with pytest.raises(InputError, match=says):
            marker_pose(*given)


@pytest.mark.parametrize("module", [3, 8, 30])
def test_align_corrects_corners_that_are_off_by_a_third_of_a_module(module):
    bits = dictionary_bits("apriltag", "36h11", 2)
    picture, corners, _ = seen(bits, 8 * module, tilt=15, spin=20)
    rough = corners + np.random.default_rng(module).uniform(-0.3, 0.3, (4, 2)) * module
    mended = align(picture, rough, bits)
    assert mended is not None
    assert corner_error(mended, corners) < 0.15


def test_align_gives_up_rather_than_slide_to_another_place():
    bits = dictionary_bits("apriltag", "36h11", 2)
    picture, corners, _ = seen(bits, 160)
    assert align(picture, corners + 45.0, bits) is None
    assert align(picture, corners + 5000.0, bits) is None
    assert align(picture, corners, dictionary_bits("apriltag", "36h11", 100)) is None
    assert align(np.full_like(picture, 90), corners, bits) is None
    assert align(255 - picture, corners, bits) is None


def test_a_dark_line_at_a_corner_does_not_move_it():
    picture, corners, _ = seen(dictionary_bits("apriltag", "36h11", 5), 240, tilt=5, spin=3)
    x, y = np.rint(corners[0]).astype(int)
    picture[y + 1 : y + 6, x - 30 : x + 3] = 25
    rough, _, _ = cv2.aruco.ArucoDetector(predefined("apriltag", "36h11")).detectMarkers(picture)
    assert corner_error(rough[0].reshape(4, 2) + 0.5, corners) > 10, "it misleads OpenCV"
    (tag,) = detect(picture)
    assert corner_error(tag.corners, corners) < 0.1


@pytest.mark.parametrize(("along", "across"), [(1.2, 0.0), (-1.0, 1.1), (0.4, -1.6)])
def test_align_finds_a_fourth_corner_that_is_a_module_off(along, across):
    bits = qr_bits("fourteen signs")
    picture, corners, _ = seen(bits, 210, tilt=40, spin=10, quiet=4)
    rough = corners.copy()
    rough[2] += (along * (corners[2] - corners[3]) + across * (corners[2] - corners[1])) / bits.shape[0]
    assert align(picture, rough, bits) is None
    mended = align(picture, rough, bits, unsure=[2])
    assert mended is not None
    assert corner_error(mended, corners) < 0.1


def test_align_looks_past_something_in_front():
    bits = qr_bits("a" * 100)
    picture, corners, _ = seen(bits, 200, quiet=4)
    covered = picture.copy()
    x, y = np.rint(corners[2]).astype(int)
    covered[y - 40 : y + 9, x - 40 : x + 9] = 128
    mended = align(covered, corners + 0.8, bits)
    assert mended is not None
    assert corner_error(mended, corners) < 0.1


def test_pose_error_is_the_distance_and_the_angle():
    true_pose = pose(turned(10), [0.1, 0.2, 1.0])
    moved = pose(turned(10 + 1e-4), [0.1, 0.2, 1.003])
    apart, angle = pose_error(moved, true_pose)
    assert apart == pytest.approx(0.003)
    assert np.degrees(angle) == pytest.approx(1e-4)
    for degrees in (60, 90, 180):
        turn = pose_error(pose(turned(degrees), [0, 0, 1]), np.eye(4))[1]
        assert np.degrees(turn) == pytest.approx(degrees)


def test_a_pose_behind_the_camera_is_not_taken(monkeypatch):
    """It is visible in the same places: the plane's axes and its place with their signs changed."""
    placed = pose(turned(30, 20), [0.05, -0.04, 1.2])
    _, corners = draw(np.ones((1, 1), np.uint8), SIZE, placed, CAMERA, samples=1)

    def both(*args, **more):
        _, turns, moves, errors = solve(*args, **more)
        matrix = cv2.Rodrigues(turns[0])[0] * [-1, -1, 1]
        return 2, (cv2.Rodrigues(matrix)[0], turns[0]), (-moves[0], moves[0]), errors

    solve = cv2.solvePnPGeneric
    monkeypatch.setattr(cv2, "solvePnPGeneric", both)
    assert pose_error(marker_pose(corners, SIZE, CAMERA), placed)[0] < 1e-5


@pytest.mark.parametrize("tilt", [-60, -20, 0, 20, 60])
def test_exact_corners_give_the_exact_pose(tilt):
    camera = Camera.pinhole(401, 333, 500, 480, 170.3, 190.8)
    placed = pose(turned(tilt, 77), [0.05, -0.04, 1.2])
    _, corners = draw(np.ones((1, 1), np.uint8), SIZE, placed, camera, samples=1)
    apart, angle = pose_error(marker_pose(corners, SIZE, camera), placed)
    assert apart < 1e-5
    assert angle < 1e-4
