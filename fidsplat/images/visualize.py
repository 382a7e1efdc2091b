"""Visualization of depth, normals, labels and detections as uint8 RGB, with colour keys."""

import math
from collections.abc import Callable, Iterable, Sequence

import cv2
import numpy as np

_BACKGROUND = (90, 90, 90)
_SHIFT = 4  # fractional bits of OpenCV's coordinates: sixteenths of a pixel
_OUTLINE = (255, 60, 200)
_SHEET_BACKGROUND = 28  # grey level of a sheet's background
KEY_WIDTH = 132  # pixels of the colour key next to the images of a sheet


def depth_span(depths: Iterable[np.ndarray]) -> tuple[float, float]:
    """Range [m] of the colours of depth images (h, w): percentiles 1 and 99; (0, 0) without valid depths."""
    valid = [depth[np.isfinite(depth) & (depth > 0)] for depth in depths]
    every = np.concatenate(valid) if valid else np.zeros(0)
    if not every.size:
        return 0.0, 0.0
    low, high = np.percentile(every, (1, 99))
    return float(low), float(high)


def color_depth(depth: np.ndarray, span: tuple[float, float] | None = None) -> np.ndarray:
    """Colour a depth image (h, w) with the turbo map, near red and far blue; black for 0 and not finite.

    span: depths in metres of the first and the last colour; default: `depth_span` of this image.
    """
    valid = np.isfinite(depth) & (depth > 0)
    low, high = depth_span([depth]) if span is None else span
    fraction = np.clip((high - np.where(valid, depth, high)) / max(high - low, 1e-9), 0, 1)
    return np.where(valid[:, :, None], _turbo(fraction), 0).astype(np.uint8)


def depth_key(span: tuple[float, float], height: int) -> np.ndarray:
    """Colour bar of `color_depth` with its range in metres, (height, KEY_WIDTH, 3)."""
    low, high = span
    digits = max(0, 2 - math.floor(math.log10(max(high, 1e-9))))
    words = [f"{low + fraction * (high - low):.{min(digits, 6)}f} m" for fraction in _TICKS]
    return _color_bar(height, lambda fraction: 1 - fraction, words)


def depth_millimetres(depth: np.ndarray) -> np.ndarray:
    """Convert depth (h, w) in metres to uint16 millimetres, as depth cameras do; 0: no surface, at most
    65535."""
    clean = np.nan_to_num(depth, nan=0.0, posinf=np.inf, neginf=0.0)
    return np.rint(np.clip(clean * 1000.0, 0, 65535)).astype(np.uint16)


def color_normals(normal: np.ndarray) -> np.ndarray:
    """Colour unit normals (h, w, 3) as (n + 1) / 2; black for normals of length 0."""
    valid = (normal != 0).any(axis=2, keepdims=True)
    return np.rint(np.where(valid, np.clip((normal + 1) / 2, 0, 1), 0) * 255).astype(np.uint8)


def normal_key(height: int) -> np.ndarray:
    """Colour key of `color_normals`, (height, KEY_WIDTH, 3): a sphere in the colours of its normals."""
    key = np.full((height, KEY_WIDTH, 3), _SHEET_BACKGROUND, np.uint8)
    radius, middle = 34, (KEY_WIDTH // 2, height // 2)
    y, x = (np.mgrid[-radius : radius + 1, -radius : radius + 1]) / radius
    inside = x * x + y * y <= 1
    normal = np.stack([x, y, -np.sqrt(np.maximum(1 - x * x - y * y, 0))], -1)
    top, left = middle[1] - radius, middle[0] - radius
    ball = key[top : top + 2 * radius + 1, left : left + 2 * radius + 1]
    ball[inside] = color_normals(normal)[inside]
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


def color_labels(label: np.ndarray) -> np.ndarray:
    """Colour labels or ids (h, w): black for -1, grey for 0, a distinct colour for each other label."""
    values, which = np.unique(label, return_inverse=True)
    colors = _colors(values)
    colors[values < 0], colors[values == 0] = 0, _BACKGROUND
    return colors[which.reshape(label.shape)]


def color_counts(count: np.ndarray) -> np.ndarray:
    """Colour counts or errors (h, w) with the turbo map, from 0 (dark blue) to the maximum (red)."""
    return _turbo(count / (count.max(initial=0) or 1))


def count_key(maximum: int, height: int) -> np.ndarray:
    """Colour bar of `color_counts` up to a maximum count, (height, KEY_WIDTH, 3)."""
    return _color_bar(height, lambda fraction: fraction, [f"{round(s * maximum)}" for s in _TICKS])


def draw_outlines(
    image: np.ndarray, marks: Sequence[tuple[np.ndarray, str]], thickness: int = 2, size: float = 0.9
) -> np.ndarray:
    """Copy an image (h, w, 3) uint8 and draw quadrilaterals with captions in dark boxes below them.

    Args:
        marks: (corners (4, 2), caption) each; a dot marks the first corner.
        thickness: width of the lines in pixels.
        size: size of the captions, in units of OpenCV's built-in font.
    """
    marked = np.ascontiguousarray(image).copy()
    for corners, _ in marks:
        # OpenCV's origin is the centre of the first pixel
        points = np.rint((corners - 0.5) * 2**_SHIFT).astype(np.int32)
        cv2.polylines(marked, [points.reshape(-1, 1, 2)], True, _OUTLINE, thickness, cv2.LINE_AA, _SHIFT)
        cv2.circle(marked, points[0].tolist(), (2 + thickness) * 2**_SHIFT, _OUTLINE, -1, cv2.LINE_AA, _SHIFT)
    line, bottom = round(36 * size), image.shape[0] - 8
    occupied = [
        (*corners.min(axis=0), *corners.max(axis=0)) for corners, _ in marks
    ]  # left, top, right, foot
    for corners, text in sorted(marks, key=lambda mark: mark[0][:, 1].max()):
        wide = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, max(1, round(2 * size)))[0][0]
        left = round(min(max(corners[:, 0].mean() - wide / 2, 4), max(image.shape[1] - wide - 4, 4)))
        foot = round(min(corners[:, 1].max() + line, bottom))
        while foot < bottom and any(
            left - 4 < right and left + wide + 4 > begin and foot - line + 8 < low and foot + 8 > high
            for begin, high, right, low in occupied
        ):
            foot += 1
        box = (left - 4, foot - line + 8, left + wide + 4, foot + 8)
        occupied.append(box)
        cv2.rectangle(marked, box[:2], box[2:], (_SHEET_BACKGROUND,) * 3, -1)
        write(marked, text, (left, foot), size=size)
    return marked


def write(
    image: np.ndarray, text: str, place: tuple[int, int], color=(255, 255, 255), size: float = 0.5
) -> None:
    """Write a line of text with a dark outline into an image; `place` (x, y) is its lower left corner."""
    plain = text.encode("ascii", "replace").decode()  # OpenCV's fonts have only ASCII
    x, y = place
    width = max(1, round(2 * size))
    # the outline is the text shifted in four directions, since OpenCV 5 widens text of a thicker stroke
    for right, down in ((-1, 0), (1, 0), (0, -1), (0, 1), (0, 0)):
        shade = color if (right, down) == (0, 0) else (0, 0, 0)
        at = (x + right, y + down)
        cv2.putText(image, plain, at, cv2.FONT_HERSHEY_SIMPLEX, size, shade, width, cv2.LINE_AA)


def resize_to_width(image: np.ndarray, width: int) -> np.ndarray:
    """Scale an image (h, w, 3) uint8 to a width in pixels by averaging areas."""
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def contact_sheet(
    rows: list[list[tuple[str, np.ndarray]]],
    width: int = 384,
    gap: int = 6,
    key: Callable[[int, int], np.ndarray | None] | None = None,
) -> np.ndarray:
    """Contact sheet: titled images in rows on a dark background, (h, w, 3) uint8.

    Args:
        rows: each a list of (title, image (h, w, 3) uint8); the images of a sheet have one shape.
        width: of each image on the sheet, pixels.
        gap: pixels between images.
        key: (row, height) -> image to the right of a row, (height, KEY_WIDTH, 3), or None.
    """
    title = 22
    cells = [[(name, resize_to_width(image, width)) for name, image in row] for row in rows]
    height = max(image.shape[0] for row in cells for _, image in row)
    columns = max(len(row) for row in cells)
    key_left = gap + columns * (width + gap)
    across = key_left + (KEY_WIDTH + gap if key else 0)
    sheet = np.full((gap + len(rows) * (title + height + gap), across, 3), _SHEET_BACKGROUND, np.uint8)
    for i, row in enumerate(cells):
        for j, (name, image) in enumerate(row):
            x, y = gap + j * (width + gap), gap + i * (title + height + gap)
            write(sheet, name, (x + 2, y + 15), size=0.45)
            sheet[y + title : y + title + image.shape[0], x : x + width] = image
        strip = key(i, height) if key else None
        if strip is not None:
            y = gap + i * (title + height + gap) + title
            sheet[y : y + height, key_left : key_left + KEY_WIDTH] = strip
    return sheet


_TICKS = (0.0, 0.25, 0.5, 0.75, 1.0)  # positions of a colour bar's ticks, from the bottom


def _color_bar(height: int, color: Callable[[np.ndarray], np.ndarray], words: list[str]) -> np.ndarray:
    """Colour bar with labelled ticks. colour: maps positions from 0 (bottom) to 1 to [0, 1] of the turbo
    map."""
    key = np.full((height, KEY_WIDTH, 3), _SHEET_BACKGROUND, np.uint8)
    left, right, top, foot = 10, 34, 8, height - 9
    key[top : foot + 1, left:right] = _turbo(color(np.linspace(1, 0, foot + 1 - top)))[:, None].reshape(
        -1, 1, 3
    )
    for fraction, word in zip(_TICKS, words, strict=True):
        y = round(foot + fraction * (top - foot))
        cv2.line(key, (right, y), (right + 5, y), (255, 255, 255), 1)
        write(key, word, (right + 10, y + 5), size=0.45)
    return key


def _turbo(fraction: np.ndarray) -> np.ndarray:
    """Map values in [0, 1] to the turbo colours, (..., 3) RGB."""
    levels = np.rint(fraction * 255).astype(np.uint8)
    return cv2.applyColorMap(levels.reshape(-1, 1), cv2.COLORMAP_TURBO)[:, 0, ::-1].reshape(
        *fraction.shape, 3
    )


def _colors(values: np.ndarray) -> np.ndarray:
    # steps of the golden angle give neighbouring labels very different hues
    hue = (values - 1.0) * 137.508 % 360 / 2
    pixels = np.stack([hue, np.full(hue.shape, 200.0), np.full(hue.shape, 255.0)], -1).astype(np.uint8)
    return cv2.cvtColor(pixels[None], cv2.COLOR_HSV2RGB)[0]
