"""Image files: round trips, one-bit images, damaged input, atomic writes."""

import cv2
import numpy as np
import pytest

from fidsplat.capture.environment import Panorama
from fidsplat.images.files import read_bits, read_image, to_uint8, write_png
from fidsplat.util.errors import InputError


def test_colours_survive_a_round_trip(tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (7, 5, 3), dtype=np.uint8)
    assert np.array_equal(read_image(write_png(tmp_path / "a.png", image)), image)


def test_floats_are_clamped_and_rounded():
    assert to_uint8(np.array([-1.0, 0.0, 0.5, 1.0, 7.0, np.nan])).tolist() == [0, 0, 128, 255, 255, 0]
    assert to_uint8(np.array([True, False])).tolist() == [255, 0]
    with np.errstate(invalid="raise"):  # what NaN is as an integer is the processor's choice
        assert not to_uint8(np.full(7, np.nan)).any()


def test_a_large_image_is_converted_as_its_rows_are():
    """In shares, by threads; the last share is smaller."""
    random = np.random.default_rng(3)
    large = random.uniform(-0.1, 1.1, (900, 857, 3)).astype(np.float32)
    large[-1, -1] = (np.nan, np.inf, -np.inf)
    converted = to_uint8(large)
    assert np.array_equal(converted, np.stack([to_uint8(row) for row in large]))
    assert converted[-1, -1].tolist() == [0, 255, 0]


def test_sixteen_bits_are_preserved(tmp_path):
    depth = np.array([[0, 1, 65535], [300, 4000, 2]], np.uint16)
    write_png(tmp_path / "d.png", depth)
    assert np.array_equal(cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED), depth)


@pytest.mark.parametrize("suffix", ["png", "tiff"])
@pytest.mark.parametrize("grey", [False, True])
def test_a_panorama_has_the_depth_of_its_file(tmp_path, suffix, grey):
    values = np.random.default_rng(0).integers(0, 65536, (6, 8) if grey else (6, 8, 3), dtype=np.uint16)
    file = tmp_path / f"sky.{suffix}"
    cv2.imwrite(str(file), values if grey else values[:, :, ::-1])
    whole = np.broadcast_to(values[:, :, None] if grey else values, (6, 8, 3))
    np.testing.assert_allclose(Panorama.load(file).image, whole / 65535, atol=1e-7)
    assert read_image(file).dtype == np.uint8


def test_a_panorama_of_floats_keeps_what_is_brighter_than_white(tmp_path):
    values = np.random.default_rng(0).uniform(0, 30, (6, 8, 3)).astype(np.float32)
    cv2.imwrite(str(tmp_path / "sky.tiff"), values[:, :, ::-1])
    assert np.array_equal(Panorama.load(tmp_path / "sky.tiff").image, values)


def test_a_panorama_of_other_numbers_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "sky.tiff"), np.zeros((6, 8, 3)))
    with pytest.raises(InputError, match="must be integers of 8 or 16 bits or 32-bit floats, got float64"):
        Panorama.load(tmp_path / "sky.tiff")


@pytest.mark.parametrize("shape", [(3,), (2, 2, 4), (0, 3, 3)])
def test_a_png_needs_the_shape_of_an_image(tmp_path, shape):
    with pytest.raises(InputError, match="image of a PNG must be"):
        write_png(tmp_path / "x.png", np.zeros(shape))
    with pytest.raises(InputError, match="rows of real numbers"):
        write_png(tmp_path / "x.png", np.full((2, 2), "a"))
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_left_behind_where_nothing_can_be_written(tmp_path):
    with pytest.raises(InputError, match="cannot write"):
        write_png(tmp_path / "missing" / "x.png", np.zeros((2, 2)))
    folder = tmp_path / "x.png"
    folder.mkdir()
    with pytest.raises(InputError, match="cannot write"):
        write_png(folder, np.zeros((2, 2)))
    assert [p.name for p in tmp_path.iterdir()] == ["x.png"]


@pytest.mark.parametrize("levels", [(0, 255), (40, 200), (150, 160)])
def test_any_two_levels_make_a_one_bit_image(tmp_path, levels):
    bits = np.random.default_rng(1).integers(0, 2, (9, 11)).astype(np.uint8)
    write_png(tmp_path / "b.png", np.where(bits == 1, levels[0], levels[1]).astype(np.uint8))
    assert np.array_equal(read_bits(tmp_path / "b.png"), bits)


def test_real_one_bit_files_grey_rgb_and_transparent_ones_read_alike(tmp_path):
    bits = np.array([[1, 0, 1], [0, 1, 1]], np.uint8)
    light = (255 * (1 - bits)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "one.png"), light, [cv2.IMWRITE_PNG_BILEVEL, 1])
    cv2.imwrite(str(tmp_path / "rgb.png"), np.repeat(light[:, :, None], 3, 2))
    clear = np.dstack([np.zeros((2, 3, 3), np.uint8), 255 * bits])
    cv2.imwrite(str(tmp_path / "clear.png"), clear)
    cv2.imwrite(str(tmp_path / "deep.png"), light.astype(np.uint16) * 257)
    for name in ("one", "rgb", "clear", "deep"):
        assert np.array_equal(read_bits(tmp_path / f"{name}.png"), bits), name


@pytest.mark.parametrize(("level", "bit"), [(0, 1), (255, 0)])
def test_an_image_of_one_level_is_dark_or_light(tmp_path, level, bit):
    write_png(tmp_path / "c.png", np.full((3, 4), level, np.uint8))
    assert (read_bits(tmp_path / "c.png") == bit).all()


def test_grey_levels_and_colours_are_no_marker(tmp_path):
    write_png(tmp_path / "grey.png", np.arange(12, dtype=np.uint8).reshape(3, 4))
    with pytest.raises(InputError, match="a marker image must have at most two grey levels, got 12 in"):
        read_bits(tmp_path / "grey.png")
    red = np.zeros((2, 2, 3), np.uint8)
    red[0, 0, 0] = 255
    write_png(tmp_path / "red.png", red)
    with pytest.raises(InputError, match="colours"):
        read_bits(tmp_path / "red.png")


@pytest.mark.parametrize("damage", ["empty", "text", "cut", "missing", "folder"])
def test_an_unreadable_image_is_one_clear_error(tmp_path, damage, capfd):
    path = tmp_path / "bad.png"
    if damage == "empty":
        path.write_bytes(b"")
    elif damage == "text":
        path.write_bytes(b"this is no image")
    elif damage == "cut":
        write_png(path, np.random.default_rng(0).integers(0, 256, (40, 40, 3), dtype=np.uint8))
        path.write_bytes(path.read_bytes()[:1500])
    elif damage == "folder":
        path.mkdir()
    for read in (read_image, read_bits):
        with pytest.raises(InputError, match=r"bad\.png"):
            read(path)
    assert capfd.readouterr().err == "", "OpenCV's own warnings stay silent"
