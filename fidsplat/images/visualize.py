"""Output images as pictures that people look at: depth, normals, labels, detections, with keys that say what
their colours mean. uint8 RGB out."""

import math
from collections.abc import Callable, Iterable, Sequence

import cv2
import numpy as np

_BACKGROUND = (90, 90, 90)
_SHIFT = 4  # OpenCV draws at sixteenths of a pixel
_OUTLINE = (255, 60, 200)
_SHEET = 28  # the grey of a sheet
KEY_WIDTH = 132  # of a key beside the pictures of a sheet, pixels


def depth_span(depths: Iterable[np.ndarray]) -> tuple[float, float]:
    """Nearest and furthest metres for the colours of these pictures, (h, w) each: the middle 98 % of their
    depths, so that one stray splat does not use the colours up. (0, 0) where nothing was seen."""
    seen = [depth[np.isfinite(depth) & (depth > 0)] for depth in depths]
    every = np.concatenate(seen) if seen else np.zeros(0)
    if not every.size:
        return 0.0, 0.0
    low, high = np.percentile(every, (1, 99))
    return float(low), float(high)


def depth_picture(depth: np.ndarray, span: tuple[float, float] | None = None) -> np.ndarray:
    """Depth (h, w) in metres in the turbo colours, near red and far blue; black where it is 0 or not finite.

    span: metres of the first and the last colour (default: `depth_span` of this picture).
    """
    seen = np.isfinite(depth) & (depth > 0)
    low, high = depth_span([depth]) if span is None else span
    share = np.clip((high - np.where(seen, depth, high)) / max(high - low, 1e-9), 0, 1)
    return np.where(seen[:, :, None], _turbo(share), 0).astype(np.uint8)


def depth_key(span: tuple[float, float], height: int) -> np.ndarray:
    """The colour bar of `depth_picture`, (height, KEY_WIDTH, 3), with its range in metres."""
    low, high = span
    digits = max(0, 2 - math.floor(math.log10(max(high, 1e-9))))
    words = [f"{low + share * (high - low):.{min(digits, 6)}f} m" for share in _TICKS]
    return _colour_bar(height, lambda share: 1 - share, words)


def depth_millimetres(depth: np.ndarray) -> np.ndarray:
    """Depth (h, w) in metres as uint16 millimetres, as depth cameras store it; 0 for nothing, 65535 for
    further."""
    clean = np.nan_to_num(depth, nan=0.0, posinf=np.inf, neginf=0.0)
    return np.rint(np.clip(clean * 1000.0, 0, 65535)).astype(np.uint16)


def normal_picture(normal: np.ndarray) -> np.ndarray:
    """Unit normals (h, w, 3) as (n + 1) / 2; black where there is none."""
    there = (normal != 0).any(axis=2, keepdims=True)
    return np.rint(np.where(there, np.clip((normal + 1) / 2, 0, 1), 0) * 255).astype(np.uint8)


def normal_key(height: int) -> np.ndarray:
    """A ball seen from the front, each point in the colour that `normal_picture` has for its normal,
    (height, KEY_WIDTH, 3)."""
    key = np.full((height, KEY_WIDTH, 3), _SHEET, np.uint8)
    radius, middle = 34, (KEY_WIDTH // 2, height // 2)
    y, x = (np.mgrid[-radius : radius + 1, -radius : radius + 1]) / radius
    inside = x * x + y * y <= 1
    normal = np.stack([x, y, -np.sqrt(np.maximum(1 - x * x - y * y, 0))], -1)
    top, left = middle[1] - radius, middle[0] - radius
    ball = key[top : top + 2 * radius + 1, left : left + 2 * radius + 1]
    ball[inside] = normal_picture(normal)[inside]
    sides = (
        ("up", 0, -radius - 12),
        ("down", 0, radius + 14),
        ("left", -radius - 17, 0),
        ("right", radius + 19, 0),
    )
    for word, right, down in sides:
        wide = cv2.getTextSize(word, cv2.FONT_HERSHEY_SIMPLEX, 0.4, 1)[0][0]
        write(key, word, (middle[0] + right - wide // 2, middle[1] + down + 4), size=0.4)
    return key


def label_picture(label: np.ndarray) -> np.ndarray:
    """Labels or ids (h, w): black for -1, grey for 0 and a colour of its own for each other one."""
    values, which = np.unique(label, return_inverse=True)
    colours = _colours(values)
    colours[values < 0], colours[values == 0] = 0, _BACKGROUND
    return colours[which.reshape(label.shape)]


def count_picture(count: np.ndarray) -> np.ndarray:
    """Counts or errors (h, w) in the turbo colours from 0 (dark blue) to the greatest (red)."""
    return _turbo(count / (count.max(initial=0) or 1))


def count_key(most: int, height: int) -> np.ndarray:
    """The colour bar of `count_picture` for a greatest count, (height, KEY_WIDTH, 3)."""
    return _colour_bar(height, lambda share: share, [f"{round(s * most)}" for s in _TICKS])


def outlined(
    image: np.ndarray, marks: Sequence[tuple[np.ndarray, str]], thickness: int = 2, size: float = 0.9
) -> np.ndarray:
    """A copy of an image (h, w, 3) uint8 with quadrilaterals and, in dark boxes below them, captions.

    Args:
        marks: (corners (4, 2), caption) each; the first corner gets a dot.
        thickness: of the lines, pixels.
        size: of the captions, in units of OpenCV's built-in font.
    """
    drawn = np.ascontiguousarray(image).copy()
    for corners, _ in marks:
        # OpenCV counts from the centre of the first pixel
        points = np.rint((corners - 0.5) * 2**_SHIFT).astype(np.int32)
        cv2.polylines(drawn, [points.reshape(-1, 1, 2)], True, _OUTLINE, thickness, cv2.LINE_AA, _SHIFT)
        cv2.circle(drawn, points[0].tolist(), (2 + thickness) * 2**_SHIFT, _OUTLINE, -1, cv2.LINE_AA, _SHIFT)
    line, bottom = round(36 * size), image.shape[0] - 8
    taken = [(*corners.min(axis=0), *corners.max(axis=0)) for corners, _ in marks]  # left, top, right, foot
    for corners, text in sorted(marks, key=lambda mark: mark[0][:, 1].max()):
        wide = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, max(1, round(2 * size)))[0][0]
        left = round(min(max(corners[:, 0].mean() - wide / 2, 4), max(image.shape[1] - wide - 4, 4)))
        foot = round(min(corners[:, 1].max() + line, bottom))
        while foot < bottom and any(
            left - 4 < right and left + wide + 4 > begin and foot - line + 8 < low and foot + 8 > high
            for begin, high, right, low in taken
        ):
            foot += 1
        box = (left - 4, foot - line + 8, left + wide + 4, foot + 8)
        taken.append(box)
        cv2.rectangle(drawn, box[:2], box[2:], (_SHEET,) * 3, -1)
        write(drawn, text, (left, foot), size=size)
    return drawn


def write(
    image: np.ndarray, text: str, place: tuple[int, int], colour=(255, 255, 255), size: float = 0.5
) -> None:
    """Put a line of text on an image, in place, its lower left corner at ``place`` (x, y), readable on any
    ground."""
    plain = text.encode("ascii", "replace").decode()  # all that every version's built-in font holds
    x, y = place
    width = max(1, round(2 * size))
    # a thicker stroke under it would be a wider text in OpenCV 5, so the dark rim is the same text moved
    for right, down in ((-1, 0), (1, 0), (0, -1), (0, 1), (0, 0)):
        shade = colour if (right, down) == (0, 0) else (0, 0, 0)
        at = (x + right, y + down)
        cv2.putText(image, plain, at, cv2.FONT_HERSHEY_SIMPLEX, size, shade, width, cv2.LINE_AA)


def shrunk(image: np.ndarray, width: int) -> np.ndarray:
    """An image (h, w, 3) uint8 made ``width`` pixels wide, each the mean of what it covers."""
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def contact_sheet(
    rows: list[list[tuple[str, np.ndarray]]],
    width: int = 384,
    gap: int = 6,
    key: Callable[[int, int], np.ndarray | None] | None = None,
) -> np.ndarray:
    """Titled pictures in rows on one dark sheet, (h, w, 3) uint8.

    Args:
        rows: each a list of (title, image (h, w, 3) uint8); the images of a sheet have one shape.
        width: of each picture on the sheet, pixels.
        gap: pixels between pictures.
        key: (row, height) -> what stands to the right of a row, (height, KEY_WIDTH, 3), or None for nothing.
    """
    title = 22
    cells = [[(name, shrunk(image, width)) for name, image in row] for row in rows]
    height = max(image.shape[0] for row in cells for _, image in row)
    columns = max(len(row) for row in cells)
    beside = gap + columns * (width + gap)
    across = beside + (KEY_WIDTH + gap if key else 0)
    sheet = np.full((gap + len(rows) * (title + height + gap), across, 3), _SHEET, np.uint8)
    for i, row in enumerate(cells):
        for j, (name, image) in enumerate(row):
            x, y = gap + j * (width + gap), gap + i * (title + height + gap)
            write(sheet, name, (x + 2, y + 15), size=0.45)
            sheet[y + title : y + title + image.shape[0], x : x + width] = image
        strip = key(i, height) if key else None
        if strip is not None:
            y = gap + i * (title + height + gap) + title
            sheet[y : y + height, beside : beside + KEY_WIDTH] = strip
    return sheet


_TICKS = (0.0, 0.25, 0.5, 0.75, 1.0)  # of a colour bar, from its foot


def _colour_bar(height: int, colour: Callable[[np.ndarray], np.ndarray], words: list[str]) -> np.ndarray:
    """A bar with words at its ticks; colour: share of the bar from its foot -> share of the turbo colours."""
    key = np.full((height, KEY_WIDTH, 3), _SHEET, np.uint8)
    left, right, top, foot = 10, 34, 8, height - 9
    key[top : foot + 1, left:right] = _turbo(colour(np.linspace(1, 0, foot + 1 - top)))[:, None].reshape(
        -1, 1, 3
    )
    for share, word in zip(_TICKS, words, strict=True):
        y = round(foot + share * (top - foot))
        cv2.line(key, (right, y), (right + 5, y), (255, 255, 255), 1)
        write(key, word, (right + 10, y + 5), size=0.45)
    return key


def _turbo(share: np.ndarray) -> np.ndarray:
    """Shares of 0 to 1 in the turbo colours, (..., 3) RGB."""
    levels = np.rint(share * 255).astype(np.uint8)
    return cv2.applyColorMap(levels.reshape(-1, 1), cv2.COLORMAP_TURBO)[:, 0, ::-1].reshape(*share.shape, 3)


def _colours(values: np.ndarray) -> np.ndarray:
    # turning by the golden angle keeps neighbouring labels far apart on the colour circle
    hue = (values - 1.0) * 137.508 % 360 / 2
    pixels = np.stack([hue, np.full(hue.shape, 200.0), np.full(hue.shape, 255.0)], -1).astype(np.uint8)
    return cv2.cvtColor(pixels[None], cv2.COLOR_HSV2RGB)[0]
