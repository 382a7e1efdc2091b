"""Subpixel corner refinement: least-squares fit of the known modules of a code to the image.

Every dark-light edge inside the code contributes, so the corners of a QR code, whose outer edge is
interrupted, are as accurate as those of a tag. The model is the box average of the pattern over each pixel.
Image and model are blurred equally for stability, so the blur does not move edges. Accuracy: a few hundredths
of a pixel.
"""

from collections.abc import Iterable

import cv2
import numpy as np

ITERATIONS = 8  # maximum steps of the three rounds: blurred, sharp, sharp with robust weights
SETTLED = 0.003  # pixels: maximum motion of a corner in the last step
FINE_BLUR = 0.7  # pixels, standard deviation of the blur
# difference from the model, as a fraction of the contrast, above which a pixel has less weight (occlusion)
TOLERANCE = 0.25
# a fit with a lower correlation has converged to another place
MIN_CORRELATION = 0.7
_POINTS = 3  # the pattern is averaged over 3 x 3 points of each pixel
_LARGE = 150_000  # pixels above which the image is downsampled before the comparison
_SMALL = 10_000  # the same limit for a grid search
_COARSE_MODULE = 4.0  # pixels: smallest module after downsampling
# the code spans [-1, 1], so that the fitted parameters have similar magnitudes
_SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float64)
_LARGEST_MODULE = 64  # samples of the pattern for each module
_QUIET = 1  # width in modules of the model's border, whose colour is the opposite of the code's corners


def align(
    grey: np.ndarray, corners: np.ndarray, bits: np.ndarray, unsure: Iterable[int] = ()
) -> np.ndarray | None:
    """Refine rough corners of a code with known modules.

    Args:
        grey: (h, w) uint8.
        corners: (4, 2) pixel coordinates TL, TR, BR, BL of the code's outer edge, within half a module.
        bits: (n, n) uint8, 1 = dark, without quiet zone; light corners: the surroundings are dark.
        unsure: indices of corners of which one may be wrong by two modules; if the fit from the given corners
            does not converge, a grid search for each of them follows.

    Returns (4, 2) float64, or None if the fit does not converge near the given corners.
    """
    rough = np.asarray(corners, np.float64)
    fitted = _fit(grey, rough, bits)
    for corner in unsure:
        if fitted is not None:
            break
        fitted = _fit(grey, _best_start(grey, rough, bits, corner), bits)
    return fitted


def fit(grey: np.ndarray, corners: np.ndarray, bits: np.ndarray) -> float:
    """Correlation of the pattern with the image, at most 1; -1 if it is undefined. Arguments as for
    `align`."""
    window = _window(grey, corners, bits, _LARGE)
    if window is None:
        return -1.0
    image, offset, shrink = window
    start = (corners - offset) / shrink
    model = _Model(bits, image.shape, _module(start, bits))
    smooth = cv2.GaussianBlur(image, (0, 0), FINE_BLUR)
    return model.correlation(smooth, _homography(_SQUARE, start), FINE_BLUR)


def _fit(grey: np.ndarray, corners: np.ndarray, bits: np.ndarray) -> np.ndarray | None:
    window = _window(grey, corners, bits, _LARGE)
    if window is None:
        return None
    image, offset, shrink = window
    start = (corners - offset) / shrink
    homography = _homography(_SQUARE, start)
    module = _module(start, bits)
    model = _Model(bits, image.shape, module)

    where, smooth = start, image
    for blur, robust, settled in (
        (float(np.clip(0.35 * module, FINE_BLUR, 2.5)), False, 0.1),
        (FINE_BLUR, False, 0.03),
        (FINE_BLUR, True, SETTLED),
    ):
        smooth = cv2.GaussianBlur(image, (0, 0), blur)
        for _ in range(ITERATIONS):
            step = _step(model, smooth, homography, blur, robust)
            if step is None:
                return None
            homography = homography @ (np.eye(3) + step)
            moved = _apply(homography, _SQUARE)
            if not np.isfinite(moved).all() or np.abs(moved - start).max() > max(1.0, module):
                return None
            change, where = np.abs(moved - where).max(), moved
            if change < settled:
                break
    good = model.correlation(smooth, homography, FINE_BLUR) > MIN_CORRELATION
    return where * shrink + offset if good else None


def _best_start(grey: np.ndarray, corners: np.ndarray, bits: np.ndarray, unsure: int) -> np.ndarray:
    """Corners with the best correlation in a grid search for one of them, in steps of half a module."""
    window = _window(grey, corners, bits, _SMALL)
    if window is None:
        return corners
    image, offset, shrink = window
    start = (corners - offset) / shrink
    model = _Model(bits, image.shape, _module(start, bits))
    smooth = cv2.GaussianBlur(image, (0, 0), FINE_BLUR)
    before, after = start[unsure - 1], start[(unsure + 1) % 4]
    steps = np.arange(-4, 5) / 2 / bits.shape[0]
    best, best_score = start, -1.0
    for along in steps:
        for across in steps:
            tried = start.copy()
            tried[unsure] += along * (start[unsure] - before) + across * (start[unsure] - after)
            fit = model.correlation(smooth, _homography(_SQUARE, tried), FINE_BLUR)
            if fit > best_score:
                best, best_score = tried, fit
    return best * shrink + offset


class _Model:
    """The pattern with its quiet zone, rendered under a homography with box-averaged pixels."""

    def __init__(self, bits: np.ndarray, shape: tuple[int, ...], module: float) -> None:
        self.shape = shape
        # OpenCV interpolates linearly between the k samples of a module. With this k the ramp at an edge is
        # as wide as the distance between the samples of a pixel, so that the model changes continuously with
        # the position of an edge along the rows.
        k = int(np.clip(np.ceil(_POINTS * module), 1, _LARGEST_MODULE))
        self.pattern = np.kron(
            1 - np.pad(bits, _QUIET, constant_values=1 - bits[0, 0]), np.ones((k, k))
        ).astype(np.float32)
        n = bits.shape[0]
        # [-1, 1] to OpenCV's indices of the pattern's samples; index 0 is the centre of the first
        half, shift = k * n / 2, k * (n / 2 + _QUIET) - 0.5
        self.to_pattern = np.array([[half, 0, shift], [0, half, shift], [0, 0, 1]])
        self.reach = 1 + _QUIET / n  # half of the quiet module: excludes the blurred surroundings
        rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]]
        self.pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(shape)]).reshape(3, -1)

    def render(self, homography: np.ndarray, blur: float) -> np.ndarray:
        k = _POINTS
        fine = np.array([[k, 0, -0.5], [0, k, -0.5], [0, 0, 1]])  # pixels to indices of the fine grid
        warp = fine @ homography @ np.linalg.inv(self.to_pattern)
        size = (self.shape[1] * k, self.shape[0] * k)
        rendered = cv2.warpPerspective(self.pattern, warp, size, flags=cv2.INTER_LINEAR, borderValue=1.0)
        rendered = cv2.resize(rendered, (self.shape[1], self.shape[0]), interpolation=cv2.INTER_AREA)
        return cv2.GaussianBlur(rendered, (0, 0), blur)

    def inside(self, homography: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the pixels inside the code, and their (s, t) in [-1, 1]."""
        u, v, w = np.linalg.inv(homography) @ self.pixels
        # the sign of w distinguishes the two sides of the horizon
        with np.errstate(divide="ignore", invalid="ignore"):
            s, t = u / w, v / w
        keep = np.flatnonzero((np.abs(s) < self.reach) & (np.abs(t) < self.reach))
        return keep, np.stack([s[keep], t[keep]])

    def correlation(self, smooth: np.ndarray, homography: np.ndarray, blur: float) -> float:
        keep, _ = self.inside(homography)
        if keep.size < 9:
            return 0.0
        a, b = self.render(homography, blur).ravel()[keep], smooth.ravel()[keep]
        spread = float(a.std() * b.std())
        return float(np.mean((a - a.mean()) * (b - b.mean()))) / spread if spread > 1e-6 else 0.0


def _step(model: _Model, smooth: np.ndarray, homography: np.ndarray, blur: float, robust: bool):
    """Gauss-Newton step X (3, 3) for the update H (I + X) of the homography H; None if singular."""
    keep, (s, t) = model.inside(homography)
    if keep.size < 16:
        return None
    rendered = model.render(homography, blur)
    ideal, observed = rendered.ravel()[keep].astype(np.float64), smooth.ravel()[keep].astype(np.float64)
    weight = np.ones(keep.size)
    gain, base = _contrast(ideal, observed, weight)
    if robust:
        weight = 1.0 / (1.0 + ((observed - gain * ideal - base) / (TOLERANCE * abs(gain) + 1e-6)) ** 2) ** 2
        gain, base = _contrast(ideal, observed, weight)
    if gain < 0.02:
        return None
    # the mean of the gradients of model and image makes the step second order (ESM)
    slope = np.stack([np.gradient(gain * rendered + smooth, axis=axis) for axis in (1, 0)])
    slope = 0.5 * slope.reshape(2, -1)[:, keep].astype(np.float64)
    x, y, z = homography @ np.stack([s, t, np.ones_like(s)])
    place = np.stack([x / z, y / z])
    along = [((homography[:2, k, None] - place * homography[2, k]) / z * slope).sum(0) for k in range(3)]
    columns = np.stack([along[k] * c for k in range(3) for c in (s, t, 1.0)][:8], axis=1)
    residual = -(observed - gain * ideal - base)
    normal = columns.T @ (columns * weight[:, None])
    try:
        solution = np.linalg.solve(normal, columns.T @ (weight * residual))
    except np.linalg.LinAlgError:
        return None
    return np.append(solution, 0.0).reshape(3, 3)


def _contrast(ideal: np.ndarray, observed: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    total = weight.sum()
    mean_ideal, mean_seen = (weight * ideal).sum() / total, (weight * observed).sum() / total
    spread = (weight * (ideal - mean_ideal) ** 2).sum()
    gain = (weight * (ideal - mean_ideal) * (observed - mean_seen)).sum() / spread if spread > 0 else 0.0
    return float(gain), float(mean_seen - gain * mean_ideal)


def _module(corners: np.ndarray, bits: np.ndarray) -> float:
    """Size of a module in pixels on the code's shortest side."""
    return float(np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1).min() / bits.shape[0])


def _window(grey: np.ndarray, corners: np.ndarray, bits: np.ndarray, large: int):
    """Crop around the code (h, w) float32 in [0, 1], its origin (2,) and pixel size in `grey`.

    None if the code is outside of the image.
    """
    low, high = corners.min(0), corners.max(0)
    margin = 2.0 * (high - low).max() / bits.shape[0] + 4.0
    x0, y0 = np.maximum(np.floor(low - margin), 0).astype(int)
    x1, y1 = np.minimum(np.ceil(high + margin), (grey.shape[1], grey.shape[0])).astype(int)
    if x1 - x0 < 4 or y1 - y0 < 4:
        return None
    shrink = ((x1 - x0) * (y1 - y0) / large) ** 0.5
    shrink = max(1, min(int(shrink), int(_module(corners, bits) / _COARSE_MODULE)))
    width, height = (x1 - x0) // shrink, (y1 - y0) // shrink
    part = grey[y0 : y0 + height * shrink, x0 : x0 + width * shrink].astype(np.float32) / 255.0
    if shrink > 1:
        part = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
    return part, np.array([x0, y0], np.float64), shrink


def _homography(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Homography (3, 3) from four points (4, 2) to four others, in float64, unlike OpenCV's."""
    rows = []
    for (s, t), (x, y) in zip(source, target, strict=True):
        rows.append([s, t, 1, 0, 0, 0, -x * s, -x * t])
        rows.append([0, 0, 0, s, t, 1, -y * s, -y * t])
    return np.append(np.linalg.solve(np.array(rows), target.reshape(-1)), 1.0).reshape(3, 3)


def _apply(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    x, y, z = homography @ np.column_stack([points, np.ones(len(points))]).T
    return np.column_stack([x / z, y / z])
