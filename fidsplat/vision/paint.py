"""Planes of a frame as pictures that people look at: depth, normals, labels, detections. uint8 RGB out."""

import cv2
import numpy as np

_BACKGROUND = (90, 90, 90)
_SHIFT = 4  # OpenCV draws at sixteenths of a pixel
_OUTLINE = (255, 60, 200)


def depth_picture(depth: np.ndarray) -> np.ndarray:
    """Depth (h, w) in metres in the turbo colours, near red and far blue; black where it is 0 or not finite.

    The colours span the middle 98 % of the depths, so that one stray splat does not use them up.
    """
    seen = np.isfinite(depth) & (depth > 0)
    if not seen.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    low, high = np.percentile(depth[seen], (1, 99))
    share = np.clip((high - np.where(seen, depth, high)) / max(high - low, 1e-9), 0, 1)
    colours = cv2.applyColorMap(np.rint(share * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    return np.where(seen[:, :, None], colours[:, :, ::-1], 0).astype(np.uint8)


def depth_millimetres(depth: np.ndarray) -> np.ndarray:
    """Depth (h, w) in metres as uint16 millimetres, as depth cameras store it; 0 for nothing, 65535 for
    further."""
    clean = np.nan_to_num(depth, nan=0.0, posinf=np.inf, neginf=0.0)
    return np.rint(np.clip(clean * 1000.0, 0, 65535)).astype(np.uint16)


def normal_picture(normal: np.ndarray) -> np.ndarray:
    """Unit normals (h, w, 3) as (n + 1) / 2; black where there is none."""
    there = (normal != 0).any(axis=2, keepdims=True)
    return np.rint(np.where(there, np.clip((normal + 1) / 2, 0, 1), 0) * 255).astype(np.uint8)


def label_picture(label: np.ndarray) -> np.ndarray:
    """Labels or ids (h, w): black for -1, grey for 0 and a colour of its own for each other one."""
    values, which = np.unique(label, return_inverse=True)
    colours = _colours(values)
    colours[values < 0], colours[values == 0] = 0, _BACKGROUND
    return colours[which.reshape(label.shape)]


def count_picture(count: np.ndarray) -> np.ndarray:
    """Counts (h, w) in the turbo colours from 0 (dark blue) to the greatest (red)."""
    share = count / max(int(count.max(initial=0)), 1)
    return cv2.applyColorMap(np.rint(share * 255).astype(np.uint8), cv2.COLORMAP_TURBO)[:, :, ::-1]


def outlined(image: np.ndarray, corners: np.ndarray, text: str = "", thickness: int = 2) -> np.ndarray:
    """A copy of an image (h, w, 3) uint8 with a quadrilateral (4, 2), its first corner marked, and a
    caption."""
    drawn = np.ascontiguousarray(image).copy()
    # OpenCV counts from the centre of the first pixel
    points = np.rint((corners - 0.5) * 2**_SHIFT).astype(np.int32)
    cv2.polylines(drawn, [points.reshape(-1, 1, 2)], True, _OUTLINE, thickness, cv2.LINE_AA, _SHIFT)
    cv2.circle(drawn, points[0].tolist(), (2 + thickness) * 2**_SHIFT, _OUTLINE, -1, cv2.LINE_AA, _SHIFT)
    if text:
        x, y = corners[:, 0].min(), corners[:, 1].max() + 30
        write(drawn, text, (round(x), round(min(y, image.shape[0] - 8))), _OUTLINE, 0.9)
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
        ink = colour if (right, down) == (0, 0) else (0, 0, 0)
        at = (x + right, y + down)
        cv2.putText(image, plain, at, cv2.FONT_HERSHEY_SIMPLEX, size, ink, width, cv2.LINE_AA)


def shrunk(image: np.ndarray, width: int) -> np.ndarray:
    """An image (h, w, 3) uint8 made ``width`` pixels wide, each the mean of what it covers."""
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def contact_sheet(rows: list[list[tuple[str, np.ndarray]]], width: int = 384, gap: int = 6) -> np.ndarray:
    """Titled pictures in rows on one dark sheet, (h, w, 3) uint8.

    Args:
        rows: each a list of (title, image (h, w, 3) uint8); the images of a sheet have one shape.
        width: of each picture on the sheet, pixels.
        gap: pixels between pictures.
    """
    title = 22
    cells = [[(name, shrunk(image, width)) for name, image in row] for row in rows]
    height = max(image.shape[0] for row in cells for _, image in row)
    columns = max(len(row) for row in cells)
    sheet = np.full(
        (gap + len(rows) * (title + height + gap), gap + columns * (width + gap), 3), 28, np.uint8
    )
    for i, row in enumerate(cells):
        for j, (name, image) in enumerate(row):
            x, y = gap + j * (width + gap), gap + i * (title + height + gap)
            write(sheet, name, (x + 2, y + 15), size=0.45)
            sheet[y + title : y + title + image.shape[0], x : x + width] = image
    return sheet


def _colours(values: np.ndarray) -> np.ndarray:
    # turning by the golden angle keeps neighbouring labels far apart on the colour circle
    hue = (values - 1.0) * 137.508 % 360 / 2
    pixels = np.stack([hue, np.full(hue.shape, 200.0), np.full(hue.shape, 255.0)], -1).astype(np.uint8)
    return cv2.cvtColor(pixels[None], cv2.COLOR_HSV2RGB)[0]
