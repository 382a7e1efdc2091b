"""Images of a perfectly printed code under a known pose, for tests of the detectors: no splats, no
device."""

import math

import numpy as np
import segno


def turned(tilt: float = 0.0, spin: float = 0.0) -> np.ndarray:
    """Rotation (3, 3): spun in the marker's plane, then leaning back, both in degrees."""
    a, b = math.radians(spin), math.radians(tilt)
    flat = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    back = np.array([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    return back @ flat


def pose(rotation: np.ndarray, translation) -> np.ndarray:
    """camera_from_marker (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def draw(bits, size, placed, camera, quiet=1, samples=4, ground=0.5) -> tuple[np.ndarray, np.ndarray]:
    """Ideal image of a code of ``size`` metres at the pose ``placed`` (4, 4): (h, w) float in [0, 1], and
    corners (4, 2).

    Each pixel is the mean of samples x samples points, as a camera's pixel averages over its area. An edge
    along the rows or columns therefore lies up to 1 / (2 samples) px beside where it should.
    """
    matrix = camera.matrix @ np.column_stack([placed[:3, :2], placed[:3, 3]])
    module = size / bits.shape[0]
    half = size / 2
    unit = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    printed = np.pad(bits, quiet)
    # only what the paper covers is computed
    outline = _project(matrix, unit * (half + quiet * module))
    x0, y0 = np.clip(np.floor(outline.min(0)), 0, (camera.width, camera.height)).astype(int)
    x1, y1 = np.clip(np.ceil(outline.max(0)), 0, (camera.width, camera.height)).astype(int)
    x = x0 + (np.arange((x1 - x0) * samples) + 0.5) / samples
    y = y0 + (np.arange((y1 - y0) * samples) + 0.5) / samples
    points = np.stack([*np.meshgrid(x, y), np.ones((y.size, x.size))]).reshape(3, -1)
    u, v, w = np.linalg.inv(matrix) @ points
    column = np.floor(u / w / module + printed.shape[1] / 2)
    row = np.floor(v / w / module + printed.shape[0] / 2)
    inside = (row >= 0) & (column >= 0) & (row < printed.shape[0]) & (column < printed.shape[1])
    values = np.full(points.shape[1], float(ground))
    values[inside] = 1.0 - printed[row[inside].astype(int), column[inside].astype(int)]
    image = np.full((camera.height, camera.width), float(ground))
    image[y0:y1, x0:x1] = values.reshape(y1 - y0, samples, x1 - x0, samples).mean((1, 3))
    return image, _project(matrix, unit * half)


def _project(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def photographed(image: np.ndarray, seed: int = 0, noise: float = 2.0) -> np.ndarray:
    """uint8 with less than full contrast and sensor noise of ``noise`` grey levels."""
    levels = 20 + 200 * image + np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def qr_bits(text: str) -> np.ndarray:
    """Modules of a QR code in byte mode at level L, without quiet zone."""
    code = segno.make_qr(text, error="L", mode="byte", boost_error=False)
    return np.array([list(row) for row in code.matrix], np.uint8)
