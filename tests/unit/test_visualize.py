"""Output images as colours: meaning of the colours, and of empty pixels."""

import cv2
import numpy as np
import pytest

from fidsplat.images.visualize import (
    KEY_WIDTH,
    color_depth,
    color_labels,
    color_normals,
    contact_sheet,
    count_key,
    depth_key,
    depth_millimetres,
    depth_span,
    draw_outlines,
    normal_key,
)
from fidsplat.render.output_files import save_output

SQUARE = np.array([[20.5, 10.5], [60.5, 10.5], [60.5, 40.5], [20.5, 40.5]])


def test_near_is_red_far_is_blue_and_nothing_is_black():
    depth = np.linspace(1, 5, 100).reshape(1, 100)
    depth[0, 50], depth[0, 51], depth[0, 52] = 0, np.nan, np.inf
    colors = color_depth(depth).astype(int)
    assert colors.shape == (1, 100, 3)
    assert colors[0, 2, 0] > colors[0, 2, 2], "red above blue"
    assert colors[0, 90, 2] > colors[0, 90, 0], "blue above red"
    assert (colors[0, 50:53] == 0).all()
    assert (color_depth(np.zeros((3, 4))) == 0).all()
    assert color_depth(np.full((3, 4), 2.0)).any(), "a flat picture has a colour"


def test_one_stray_splat_does_not_use_up_the_colours():
    depth = np.tile(np.linspace(1, 2, 200), (10, 1))
    depth[0, 0] = 1000.0
    # stretched to 1000 m, all of the first row would be of one colour
    assert len(np.unique(color_depth(depth)[1], axis=0)) > 150


def test_millimetres():
    depth = np.array([[0.0, 0.0004, 1.2346, 65.535, 70.0, np.inf, np.nan]])
    assert depth_millimetres(depth).tolist() == [[0, 0, 1235, 65535, 65535, 65535, 0]]


def test_normals():
    normal = np.array([[[0, 0, -1], [1, 0, 0], [0, 0, 0]]], float)
    assert color_normals(normal).tolist() == [[[128, 128, 0], [255, 128, 128], [0, 0, 0]]]


def test_labels_have_colours_of_their_own():
    label = np.array([[-1, 0, 1, 2, 3, 4, 5, 6, 7, 8]])
    colors = [tuple(c) for c in color_labels(label)[0].tolist()]
    assert len(set(colors)) == 10
    assert colors[0] == (0, 0, 0)
    assert len(set(colors[1])) == 1


def test_an_outline_has_the_corners_and_keeps_the_image():
    image = np.zeros((60, 80, 3), np.uint8)
    rendered = draw_outlines(image, [(SQUARE, "")], thickness=1)
    assert not image.any()
    assert rendered[25, 20].any()
    assert rendered[25, 60].any()
    assert not rendered[25, 40].any()
    assert rendered[10, 20].sum() > 400, "the first corner is marked"


def test_captions_are_below_their_outlines_and_not_over_each_other():
    image = np.zeros((200, 160, 3), np.uint8)

    def captions(*words):
        rendered = draw_outlines(image, [(SQUARE, word) for word in words], size=0.5)
        return (rendered.min(axis=2) == 255).any(axis=1)[
            42:
        ]  # rows with white in them; outlines are not white

    one, two = captions("näme"), captions("näme", "näme")
    assert one.any()
    rows = np.flatnonzero(one)
    assert two.sum() == 2 * one.sum()
    assert two[rows].all()


def test_captions_stay_inside_the_image():
    """Of outlines that are cut off by each edge and corner of the image."""
    image = np.zeros((200, 160, 3), np.uint8)

    def white(shift):
        return (draw_outlines(image, [(SQUARE + shift, "12345")], size=0.5).min(axis=2) == 255).sum()

    inside = white((40, 60))
    assert inside > 0
    for shift in np.stack(np.meshgrid((-60, 40, 140), (60, 180)), -1).reshape(-1, 2):
        assert white(shift) == inside, shift


def test_keys_say_what_the_colours_mean():
    depth = np.tile(np.linspace(1, 5, 200), (10, 1))
    span = depth_span([depth, np.zeros((2, 2))])
    assert span == pytest.approx(np.percentile(depth, (1, 99)))
    assert depth_span([]) == (0, 0)
    key = depth_key(span, 200)
    assert key.shape == (200, KEY_WIDTH, 3)
    ends = [key[y, 20].astype(int) for y in (9, 190)]
    assert ends[0][2] > ends[0][0], "the far end is blue"
    assert ends[1][0] > ends[1][2], "the near end is red"
    most = count_key(7, 200)
    assert (most[9, 20] == key[190, 20]).all(), "the greatest count has the colour of the nearest depth"
    ball = normal_key(200)
    towards = color_normals(np.array([[[0.0, 0, -1]]]))[0, 0]
    assert (ball[100, KEY_WIDTH // 2] == towards).all()
    assert ball[100, KEY_WIDTH // 2 + 30, 0] > ball[100, KEY_WIDTH // 2 - 30, 0], "red is to the right"


def test_a_key_is_next_to_its_row():
    rows = [[("a", np.full((30, 40, 3), 200, np.uint8))]] * 2
    strip = np.full((60, KEY_WIDTH, 3), 99, np.uint8)
    sheet = contact_sheet(rows, width=80, gap=4, key=lambda row, height: strip if row else None)
    assert sheet.shape[1] == 4 + 84 + KEY_WIDTH + 4
    assert (sheet[4 + 86 + 22 : 4 + 86 + 82, 88 : 88 + KEY_WIDTH] == 99).all()
    assert not (sheet[:86, 88:] == 99).any()


def test_a_sheet_has_every_image_under_its_title():
    rows = [
        [(f"{i}{j}", np.full((30, 40, 3), 50 * i + 10 * j + 40, np.uint8)) for j in range(3)]
        for i in range(2)
    ]
    sheet = contact_sheet(rows, width=80, gap=4)
    assert sheet.shape == (4 + 2 * (22 + 60 + 4), 4 + 3 * 84, 3)
    for i in range(2):
        for j in range(3):
            y, x = 4 + i * 86 + 22, 4 + j * 84
            assert (sheet[y : y + 60, x : x + 80] == 50 * i + 10 * j + 40).all()


@pytest.mark.parametrize(
    ("name", "shape", "files"),
    [
        ("rgb", (4, 5, 3), ["rgb.png"]),
        ("alpha", (4, 5), ["alpha.png"]),
        ("normal", (4, 5, 3), ["normal.png"]),
        ("depth", (4, 5), ["depth.npy", "depth.png", "depth-turbo.png"]),
        ("label", (4, 5), ["label.npy", "label.png"]),
    ],
)
def test_outputs_as_files(tmp_path, name, shape, files):
    plane = np.random.default_rng(0).uniform(0, 1, shape).astype(np.float32)
    plane = (plane * 5).astype(np.int32) if name == "label" else plane
    written = save_output(name, plane, lambda kind, suffix: tmp_path / f"{kind}{suffix}")
    assert [path.name for path in written] == files
    assert {path.name for path in tmp_path.iterdir()} == set(files)
    if name in ("depth", "label"):
        assert np.array_equal(np.load(written[0]), plane)
    image = cv2.imread(str(tmp_path / f"{name}.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.shape[:2] == (4, 5)
