"""Kinds of markers: boards that OpenCV's detectors read back, and kinds that are added from outside."""

import cv2
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.images.tag_dictionaries import predefined
from fidsplat.markers import Kind, Spec, marker, register, with_file
from fidsplat.markers.kinds import bits_of, parse_spec
from fidsplat.scenes import PlacedMarker

PIXELS = 10


def printed(sign: fs.markers.Marker) -> np.ndarray:
    """An image of the grid, quiet zone included."""
    return np.kron(255 * (1 - sign.grid), np.ones((PIXELS, PIXELS))).astype(np.uint8)


def place(sign, corners: np.ndarray) -> np.ndarray:
    """Pixels in modules of the code: as rendered, pixel centres lie at halves."""
    return (corners + 0.5) / PIXELS - sign.quiet_zone


@pytest.mark.parametrize(
    ("columns", "rows", "family"), [(7, 5, "4x4_50"), (4, 6, "5x5_100"), (2, 2, "6x6_250")]
)
def test_charuco_boards(columns, rows, family):
    sign = marker(f"charuco:{columns}x{rows}:{family}")
    square = sign.bits.shape[1] // columns
    assert sign.bits.shape == (rows * square, columns * square)
    dictionary = predefined("aruco", family)
    board = cv2.aruco.CharucoBoard((columns, rows), square, square - 2, dictionary)
    rendered = board.generateImage(sign.bits.shape[::-1], marginSize=0, borderBits=1)
    assert np.array_equal(sign.bits, rendered < 128)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(printed(sign))
    assert sorted(ids.ravel().tolist()) == list(range((columns - 1) * (rows - 1)))
    expected = board.getChessboardCorners()[ids.ravel(), :2]
    assert np.allclose(place(sign, corners.reshape(-1, 2)), expected, atol=0.05)


def test_grid_boards():
    sign = marker("gridboard:5x3:4x4_50")
    board = cv2.aruco.GridBoard((5, 3), 6, 2, predefined("aruco", "4x4_50"))
    rendered = board.generateImage(sign.bits.shape[::-1], marginSize=0, borderBits=1)
    assert np.array_equal(sign.bits, rendered < 128)
    detected_corners, ids, _ = cv2.aruco.ArucoDetector(board.getDictionary()).detectMarkers(printed(sign))
    at, image = board.matchImagePoints(detected_corners, ids)
    assert len(at) == 4 * 15
    assert np.allclose(place(sign, image.reshape(-1, 2)), at.reshape(-1, 3)[:, :2], atol=0.15)


def test_april_grids():
    sign = marker("aprilgrid:6x4:36h11")
    assert sign.bits.shape == (4 * 10 + 2, 6 * 10 + 2)
    options = cv2.aruco.DetectorParameters()
    # dark squares touch the tags' corners, where contours run on from one to the other
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    detector = cv2.aruco.ArucoDetector(predefined("apriltag", "36h11"), options)
    detected, ids, _ = detector.detectMarkers(printed(sign))
    places = {int(i): place(sign, c.reshape(4, 2)) for i, c in zip(ids.ravel(), detected, strict=True)}
    assert sorted(places) == list(range(24))
    for number, corners in places.items():
        row, column = divmod(number, 6)  # from the bottom left, as Kalibr counts
        x, y = 2 + 10 * column, 2 + 10 * (3 - row)
        expected = [[x, y], [x + 8, y], [x + 8, y + 8], [x, y + 8]]
        assert np.abs(corners[:, None] - expected).max(-1).min(0).max() < 0.3


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("charuco:7x5", "charuco:7x5:4x4_50"),
        ("charuco:7:4x4_50", "COLUMNSxROWS"),
        ("charuco:1x5:4x4_50", "must have 2 to 64 columns and rows"),
        ("gridboard:0x5:4x4_50", "must have 1 to 64 columns and rows"),
        ("gridboard:5x5:4x4_51", "unknown tag family"),
        ("gridboard:8x8:4x4_50", "of 4x4_50 must have at most 50 tags, got 64"),
        ("tga36h11:5", "did you mean 'apriltag:36h11:5'"),
        ("4x4_50", "did you mean 'aruco:4x4_50:ID'"),
        ("tag36h11,5", "did you mean 'apriltag:36h11:5'"),
        ("charcuo:7x5:4x4_50", "did you mean 'charuco'"),
        ("aprilgrid:6x6:4x4_50", "the family of an AprilGrid must be AprilTags, got 'aprilgrid:6x6:4x4_50';"),
    ],
)
def test_errors_say_what_would_be_right(text, says):
    with pytest.raises(fs.InputError, match=says):
        bits_of(parse_spec(text))


def stripes(spec: Spec) -> tuple[Spec, np.ndarray]:
    return spec, np.arange(int(spec.payload or 0), dtype=np.uint8)[None] % 2


@pytest.fixture
def toy(monkeypatch):
    """A kind of marker from outside, taken away again."""
    import fidsplat.markers.kinds as kinds

    monkeypatch.setattr(kinds, "_kinds", dict(kinds._kinds))
    register(
        Kind(
            "stripes", "stripes:N", 3, lambda text, _, n: Spec(text=text, kind="stripes", payload=n), stripes
        )
    )


def test_a_kind_from_outside_is_a_marker_like_any_other(toy, tmp_path):
    sign = marker("stripes:5", size=0.5)
    assert (sign.kind, sign.quiet_zone, sign.module) == ("stripes", 3, 0.1)
    assert sign.bits.tolist() == [[0, 1, 0, 1, 0]]
    assert len(sign.cloud) > 0
    scene = fs.Scene(markers=[PlacedMarker(sign)])
    scene.save(tmp_path / "a.toml")
    again = fs.Scene.load(tmp_path / "a.toml").markers[0].marker
    assert np.array_equal(again.cloud.means, sign.cloud.means)
    with pytest.raises(fs.InputError, match="or stripes:N"):
        marker("squares:5")


def test_names_that_are_no_names_of_kinds(toy):
    for name, says in (
        ("qr", "the name of a kind must not exist yet"),
        ("stripes", "the name of a kind must not exist yet"),
        ("a-b", "lower-case"),
        ("", "lower-case"),
    ):
        with pytest.raises(fs.InputError, match=says):
            register(Kind(name, "x:Y", 0, lambda text, *_: Spec(text=text, kind="x"), stripes))


def test_files_of_specs_are_put_elsewhere():
    assert with_file("image:a.png", lambda name: f"there/{name}") == "image:there/a.png"
    for text in ("qr:a.png", "image:", "image", "unknown:a"):
        assert with_file(text, str.upper) == text
