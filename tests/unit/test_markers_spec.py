"""Marker specs and their bits."""

import cv2
import numpy as np
import pytest

from fidsplat.images.tag_dictionaries import dictionary_bits, families
from fidsplat.markers import marker, parse_spec
from fidsplat.markers.codes import qr_capacity
from fidsplat.markers.kinds import bits_of
from fidsplat.util.errors import InputError
from fidsplat.vision.detect import detect


def printed(bits: np.ndarray, pixels: int = 8) -> np.ndarray:
    """An image of the code, with 4 modules of white around."""
    return np.kron(255 * (1 - np.pad(bits, 4)), np.ones((pixels, pixels))).astype(np.uint8)


def test_parts_of_a_spec():
    tag = parse_spec("apriltag:36h11:5")
    assert (tag.kind, tag.family, tag.id) == ("apriltag", "36h11", 5)
    tag = parse_spec("ArUco:4X4_50:07")
    assert (tag.kind, tag.family, tag.id) == ("aruco", "4x4_50", 7)
    code = parse_spec("qr:a:b ")
    assert (code.kind, code.payload, code.version, code.level) == ("qr", "a:b ", None, "L")
    for text, version, level in (("qr-v22-H:x", 22, "H"), ("qr-v3:x", 3, "L"), ("qr-q:x", None, "Q")):
        code = parse_spec(text)
        assert (code.version, code.level) == (version, level)
    image = parse_spec("image:C:\\logo.png")
    assert (image.kind, image.payload) == ("image", "C:\\logo.png")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "apriltag:FAMILY:ID"),
        ("36h11", "apriltag:FAMILY:ID"),
        ("datamatrix:x", "unknown kind of marker 'datamatrix'"),
        ("apriltag:36h11", "must be apriltag:FAMILY:ID"),
        ("apriltag:36h11:five", "the id of 'apriltag:36h11:five' must be a whole number from 0, got"),
        ("apriltag:36h11:-1", "the id of 'apriltag:36h11:-1' must be a whole number from 0, got '-1"),
        ("apriltag:36h11:²", "the id of 'apriltag:36h11:²' must be a whole number from 0, got '²"),
        ("apriltag:36h11:587", "0 to 586"),
        ("apriltag:36h12:0", "36h10, 36h11"),
        ("aruco:36h11:0", "4x4_50"),
        ("aruco:4x4_50:50", "0 to 49"),
        ("qr:", "a QR spec must have a text, for example qr:hello, got 'qr"),
        ("qr-v0:x", "the version of a QR code must be 1 to 40"),
        ("qr-v41-L:x", "the version of a QR code must be 1 to 40"),
        ("qr-v2-X:x", "the error level of a QR code must be L, M, Q, H, got 'X"),
        ("qr-2:x", "qr-v22-L:TEXT"),
        ("qr:\ud800", "UTF-8"),
        ("image:", "the spec of an image must be image:FILE.png, got 'image"),
        ("image:/no/such/file.png", "/no/such/file.png"),
    ],
)
def test_errors_say_what_would_be_right(text, says):
    with pytest.raises(InputError) as error:
        bits_of(parse_spec(text))
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_a_spec_is_text():
    with pytest.raises(InputError, match=r"a marker spec must be text .apriltag:FAMILY:ID, .*got 5"):
        parse_spec(5)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["apriltag", "aruco"])
def test_every_dictionary(kind):
    for family, (size, count) in families(kind).items():
        sign = marker(f"{kind}:{family}:{count - 1}")
        assert sign.bits.shape == (size, size)
        assert np.array_equal(sign.bits, dictionary_bits(kind, family, count - 1))
        assert sign.grid.shape == (size + 2 * sign.quiet_zone,) * 2
        assert sign.quiet_zone == (0 if family.startswith("circle") else 1)
        with pytest.raises(InputError, match=f"0 to {count - 1}"):
            marker(f"{kind}:{family}:{count}")


@pytest.mark.parametrize("level", "LMQH")
def test_qr_level_is_never_boosted_and_the_smallest_version_is_taken(level):
    spec, bits = bits_of(parse_spec(f"qr-{level}:{'x' * 14}"))
    # 14 bytes: version 1 up to M, 2 at Q and H; segno alone would raise L to M
    assert spec.family == f"v{1 if level in 'LM' else 2}-{level}"
    # the level stands in the first two format bits, masked with 10
    bits_of_level = {"L": (1, 1), "M": (1, 0), "Q": (0, 1), "H": (0, 0)}
    assert tuple(bits[8, :2]) == bits_of_level[level]


@pytest.mark.parametrize("version", [1, 2, 5, 9, 10, 22, 26, 27, 40])
@pytest.mark.parametrize("level", "LH")
def test_qr_capacity_is_exact(version, level):
    room = qr_capacity(version, level)
    spec, bits = bits_of(parse_spec(f"qr-v{version}-{level}:{'x' * room}"))
    assert spec.family == f"v{version}-{level}"
    assert bits.shape == (17 + 4 * version,) * 2
    with pytest.raises(InputError, match=rf"at most {room} bytes .* version {version} .*, got {room + 1};"):
        bits_of(parse_spec(f"qr-v{version}-{level}:{'x' * (room + 1)}"))


def test_a_version_higher_than_needed_is_used():
    assert bits_of(parse_spec("qr-v22-L:hello"))[1].shape == (105, 105)


@pytest.mark.parametrize("text", ["hello", "123456", "HELLO", "café: 5 µm", "10 € für 日本語", "a:b:c"])
def test_qr_codes_read_back_as_written(text):
    bits = bits_of(parse_spec(f"qr:{text}"))[1]
    assert [detection.payload for detection in detect(printed(bits), families=())] == [text]


def test_image_files(tmp_path):
    bits = np.array([[1, 0, 1], [0, 0, 1]], np.uint8)
    file = tmp_path / "a picture.png"
    cv2.imwrite(str(file), 255 * (1 - bits))
    sign = marker(f"image:{file}", size=0.3)
    assert np.array_equal(sign.bits, bits)
    assert np.array_equal(sign.grid, bits)
    assert (sign.kind, sign.family, sign.id, sign.payload) == ("image", None, None, str(file))
    assert sign.module == pytest.approx(0.1)
    assert marker(f"image:{file}", quiet_zone=2).grid.shape == (6, 7)
    cv2.imwrite(str(file), np.arange(12, dtype=np.uint8).reshape(3, 4))
    with pytest.raises(InputError, match=r"a picture\.png"):
        marker(f"image:{file}")
