"""Splats that cannot be drawn: which they are, and why."""

import numpy as np

from fidsplat.scalars import LARGEST

_F32 = np.dtype(np.float32)


def rows_beyond(array: np.ndarray, limit: float) -> np.ndarray | None:
    """Which rows hold a value that is not finite or beyond +-limit; None, at no cost in memory, if none."""
    with np.errstate(invalid="ignore"):
        if not array.size or (array.min() >= -limit and array.max() <= limit):  # false where there is a NaN
            return None
        good = array <= limit
        good &= array >= -limit
    return ~np.asarray(good.all(axis=tuple(range(1, array.ndim))))


def find_defects(arrays: dict[str, np.ndarray]) -> tuple[np.ndarray | None, dict[str, int]]:
    """(mask of the rows to keep, or None for all; reason -> count), each row under its first reason."""
    bad: np.ndarray | None = None
    dropped: dict[str, int] = {}
    s, o = arrays["scales"], arrays["opacities"]
    finite = float(np.finfo(_F32).max)
    beyond = {n: rows_beyond(array, finite if n == "quats" else LARGEST) for n, array in arrays.items()}
    beyond = {name: rows for name, rows in beyond.items() if rows is not None}
    defects = [(f"{name} not finite", rows_beyond(arrays[name], finite)) for name in beyond]
    defects += [(f"{name} beyond {LARGEST:g}", rows) for name, rows in beyond.items()]
    with np.errstate(over="ignore", invalid="ignore"):
        defects += [
            ("zero quaternion", square_of(arrays["quats"]) < 1e-30),
            ("scale not above 0", (s[:, :2] <= 0).any(axis=1) | (s[:, 2:] < 0).any(axis=1)),
            ("opacity outside [0, 1]", (o < 0) | (o > 1)),
        ]
    for reason, rows in defects:
        if rows is None or not rows.any():
            continue
        fresh = rows if bad is None else rows & ~bad
        bad = rows if bad is None else rows | bad
        if fresh.any():
            dropped[reason] = int(fresh.sum())
    return (None if bad is None else ~bad), dropped


def drop_report(dropped: dict[str, int], n: int, source) -> str:
    """What a warning says about splats that are left out."""
    parts = ", ".join(f"{reason}: {count}" for reason, count in dropped.items())
    start = "" if source is None else f"{source}: "
    return f"{start}{sum(dropped.values())} of {n} splats left out ({parts})"


def square_of(quats: np.ndarray) -> np.ndarray:
    """Squared lengths (n,) float64 of quaternions (n, 4)."""
    return np.einsum("ij,ij->i", quats, quats, dtype=np.float64)
