"""Merging splats for levels of detail.

The splats of a cell whose normals have the same main axis are merged into one by moment matching, weighted by
opacity times area: a disk with their mean, their covariance without its smallest axis, their mean colour, and
an opacity that preserves opacity times area. If one of them is a 3D Gaussian, the merged splat is one too.
Where cells are smaller than pixels, the merged splat covers the same fraction of a pixel.
fidsplat/accuracy/detail_errors.py measures the error.

The opacity can exceed 1, as the low-pass filter reduces the alpha of splats smaller than a pixel. A cell with
an edge between bright and dark splats becomes two splats; a single one would shift the edge by up to an
eighth of the cell.
"""

from __future__ import annotations

import numpy as np

from fidsplat.splats.harmonics import C0
from fidsplat.splats.rotations import matrices_to_quaternions
from fidsplat.store.morton import BITS, Grid

REDUCTION = 4
"""mean number of splats that are merged into one, as for a surface at half the resolution"""
MAX_OPACITY = 4.0
"""maximum opacity of a merged splat; if more is needed, several copies are stored"""
EDGE = 0.06
"""standard deviation of brightness in a cell above which bright and dark splats are merged separately"""
_CLASSES = 3
"""main axes of normals"""
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def merged(splats: dict[str, np.ndarray], grid: Grid) -> tuple[dict[str, np.ndarray], float]:
    """Merge splats (arrays of a store's columns) to about a quarter of their number. A merged splat has the
    label of the splat with the largest weight.

    Returns the merged splats and the edge [m] of the cells.
    """
    u, v, normal = _frames(splats["quats"])
    sides = np.abs(normal)
    classes = np.where(sides[0] > sides[1], np.where(sides[0] > sides[2], 0, 2), 1 + (sides[2] > sides[1]))
    keys, shift = _cells(grid.codes(splats["means"]), classes.astype(np.uint64))
    keys = _split_edges(keys, splats)
    order, starts = _runs(keys)
    ordered = {name: array[order] for name, array in splats.items()}
    result = _merge_moments(ordered, (u[:, order], v[:, order], normal[:, order]), starts)
    return result, grid.size(shift)


def _runs(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sorting order of keys (n,), and the first index of each run of equal keys."""
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    return order, np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))


def _split_edges(keys: np.ndarray, splats: dict[str, np.ndarray]) -> np.ndarray:
    """Split grid cells whose splats differ in brightness by more than `EDGE` (RMS): cell keys (n,), with
    different keys for the bright and the dark splats of such a cell."""
    colors = splats["colors"] if "colors" in splats else C0 * splats["sh"][:, 0]
    order, starts = _runs(keys)
    brightness = colors.astype(np.float64).mean(axis=1)[order]
    lengths = np.diff(np.append(starts, len(keys)))
    mean = np.add.reduceat(brightness, starts) / lengths
    difference = brightness - np.repeat(mean, lengths)
    edge = np.add.reduceat(difference * difference, starts) > EDGE**2 * lengths
    split = np.empty(len(keys), np.int64)
    split[order] = np.repeat(2 * np.arange(len(starts)), lengths) + (
        (difference > 0) & np.repeat(edge, lengths)
    )
    return split


def _frames(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two tangents and the normal, each (3, n) float64, of unit quaternions (n, 4)."""
    w, x, y, z = quats.T.astype(np.float64)
    u = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    v = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
    return u, v, np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


def _cells(codes: np.ndarray, classes: np.ndarray) -> tuple[np.ndarray, int]:
    """Keys (n,) of cell and class of each splat, and the number of combined grid levels."""
    target = max(1, len(codes) // REDUCTION)
    ordered = np.sort(codes)
    # number of levels at which neighbouring splats in Morton order differ
    _, exponents = np.frexp((ordered[1:] ^ ordered[:-1]).astype(np.float64))
    differing = np.bincount((exponents + 2) // 3, minlength=BITS + 2)
    cells = 1 + np.cumsum(differing[::-1])[::-1]  # cells[s + 1]: number of cells that combine s levels
    shift = int(np.argmax(np.append(cells[1:], 0) <= target))
    while True:
        keys = (codes >> np.uint64(3 * min(shift, BITS))) * np.uint64(_CLASSES) + classes
        if shift >= BITS:
            return keys, BITS
        ordered = np.sort(keys)
        if 1 + int(np.count_nonzero(ordered[1:] != ordered[:-1])) <= target:
            return keys, shift
        shift += 1


def _merge_moments(
    splats: dict[str, np.ndarray], frames: tuple[np.ndarray, np.ndarray, np.ndarray], starts: np.ndarray
) -> dict[str, np.ndarray]:
    """One splat for each run of splats, or several copies where the opacity exceeds `MAX_OPACITY`.

    frames: two tangents and the normal, each (3, n). starts: first index of each run.
    """
    count = len(splats["means"])
    lengths = np.diff(np.append(starts, count))
    scales = splats["scales"].T.astype(np.float64)
    thickness = splats.get("thickness")
    area = scales[0] * scales[1]
    third = np.zeros(count) if thickness is None else thickness.astype(np.float64)
    # approximate area of a 3D Gaussian, averaged over directions
    area = np.maximum(area, third * np.maximum(scales[0], scales[1]))
    opacity_area = splats["opacities"] * area
    weights = np.maximum(opacity_area, 1e-300)
    total = np.add.reduceat(weights, starts)
    # relative to the first splat of the run, to avoid cancellation
    base = splats["means"][starts].astype(np.float64).T
    offsets = splats["means"].T - np.repeat(base, lengths, axis=1)
    u, v = frames[0] * scales[0], frames[1] * scales[1]

    def mean(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values * weights, starts, axis=1) / total

    moments = [u[i] * u[j] + v[i] * v[j] + offsets[i] * offsets[j] for i, j in _PAIRS]
    if thickness is not None:
        moments = [
            m + third * third * frames[2][i] * frames[2][j] for m, (i, j) in zip(moments, _PAIRS, strict=True)
        ]
    middle, second = mean(offsets), mean(np.stack(moments))
    spread = np.empty((len(starts), 3, 3))
    for (i, j), values in zip(_PAIRS, second, strict=True):
        spread[:, i, j] = spread[:, j, i] = values - middle[i] * middle[j]
    sizes, vectors = np.linalg.eigh(spread)
    sigma = np.sqrt(np.maximum(sizes[:, ::-1], 1e-24))
    rotations = vectors[:, :, ::-1].copy()
    rotations[:, :, 2] = np.cross(rotations[:, :, 0], rotations[:, :, 1])
    opacities = np.add.reduceat(opacity_area, starts) / (sigma[:, 0] * sigma[:, 1])
    copies = np.maximum(np.ceil(opacities / MAX_OPACITY), 1).astype(np.int64)
    combined = {
        "means": (base + middle).T,
        "quats": matrices_to_quaternions(rotations),
        "scales": sigma[:, :2],
    }
    combined["opacities"] = opacities / copies
    for name in {"colors", "sh"} & set(splats):
        flat = splats[name].reshape(count, -1).T.astype(np.float64)
        combined[name] = mean(flat).T.reshape(-1, *splats[name].shape[1:])
    if thickness is not None:
        combined["thickness"] = np.where(np.logical_or.reduceat(thickness > 0, starts), sigma[:, 2], 0.0)
    single, heaviest = lengths == 1, _first_of_largest(weights, starts, lengths)
    result = {}
    for name, array in splats.items():
        if name not in combined:  # labels, coplanar groups
            result[name] = array[heaviest]
            continue
        result[name] = combined[name].astype(array.dtype)
        result[name][single] = array[starts[single]]
    return {name: np.repeat(array, copies, axis=0) for name, array in result.items()}


def _first_of_largest(weights: np.ndarray, starts: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """First index of the largest weight of each run."""
    largest = np.repeat(np.maximum.reduceat(weights, starts), lengths)
    indices = np.where(weights == largest, np.arange(len(weights)), len(weights))
    return np.minimum.reduceat(indices, starts)
