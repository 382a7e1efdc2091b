"""Arrays of a SplatCloud: validation, conversion, origin, quaternions and concatenation."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from fidsplat.splats.rotations import quaternion_multiply
from fidsplat.util.arguments import LARGEST
from fidsplat.util.errors import InputError

F32 = np.dtype(np.float32)
OPTIONAL = ("colors", "sh", "coplanar_groups", "boxes", "thickness")
"""names of the arrays that may be None"""


def present_arrays(cloud: Any) -> dict[str, np.ndarray]:
    """The arrays of a cloud by their names; arrays that are None are left out."""
    names = ("means", "quats", "scales", "opacities", "labels", *OPTIONAL)
    return {name: array for name in names if (array := getattr(cloud, name)) is not None}


def all_scales(cloud: Any) -> np.ndarray:
    """Scales (n, 2) of a cloud of disks, or scales and thickness (n, 3) if some splats are 3D Gaussians."""
    return cloud.scales if cloud.thickness is None else np.column_stack([cloud.scales, cloud.thickness])


def rows_beyond(array: np.ndarray, limit: float) -> np.ndarray | None:
    """Mask of the rows with a value that is not finite or beyond +-limit; None if there are none."""
    with np.errstate(invalid="ignore"):
        if not array.size or (array.min() >= -limit and array.max() <= limit):  # False with a NaN
            return None
        within = array <= limit
        within &= array >= -limit
    return ~np.asarray(within.all(axis=tuple(range(1, array.ndim))))


def find_defects(arrays: dict[str, np.ndarray]) -> tuple[np.ndarray | None, dict[str, int]]:
    """Mask of the valid splats (None: all are valid), and numbers of invalid splats by their first defect."""
    invalid: np.ndarray | None = None
    dropped: dict[str, int] = {}
    scales, opacities = arrays["scales"], arrays["opacities"]
    finite = float(np.finfo(F32).max)
    limits = {name: finite if name == "quats" else LARGEST for name in arrays}
    beyond = {name: rows_beyond(array, limits[name]) for name, array in arrays.items()}
    beyond = {name: rows for name, rows in beyond.items() if rows is not None}
    defects = [(f"{name} not finite", rows_beyond(arrays[name], finite)) for name in beyond]
    defects += [(f"{name} beyond {LARGEST:g}", rows) for name, rows in beyond.items()]
    with np.errstate(over="ignore", invalid="ignore"):
        defects += [
            ("zero quaternion", squared_lengths(arrays["quats"]) < 1e-30),
            ("scale not above 0", (scales[:, :2] <= 0).any(axis=1) | (scales[:, 2:] < 0).any(axis=1)),
            ("opacity outside [0, 1]", (opacities < 0) | (opacities > 1)),
        ]
    for reason, rows in defects:
        if rows is None or not rows.any():
            continue
        newly_invalid = rows if invalid is None else rows & ~invalid
        invalid = rows if invalid is None else rows | invalid
        if newly_invalid.any():
            dropped[reason] = int(newly_invalid.sum())
    return (None if invalid is None else ~invalid), dropped


def drop_report(dropped: dict[str, int], count: int, source) -> str:
    """Text of the warning about dropped splats."""
    parts = ", ".join(f"{reason}: {count}" for reason, count in dropped.items())
    start = "" if source is None else f"{source}: "
    total = sum(dropped.values())
    hints = [hint for reason, hint in _RAW_PARAMETER_HINTS.items() if 4 * dropped.get(reason, 0) > count]
    return f"{start}{total} of {count} splats left out ({parts}){''.join(f'; {hint}' for hint in hints)}"


_RAW_PARAMETER_HINTS = {
    "scale not above 0": "scales are standard deviations in metres: take exp() of logarithms",
    "opacity outside [0, 1]": "opacities are from 0 to 1: take the sigmoid of logits",
}
"""hint for a defect of more than a quarter of all splats, which may be the raw parameters of a trainer"""


def squared_lengths(quats: np.ndarray) -> np.ndarray:
    """Squared lengths (n,) float64 of quaternions (n, 4)."""
    return np.einsum("ij,ij->i", quats, quats, dtype=np.float64)


# Row i rotates axis i to the third: a cyclic permutation of the axes, which stay right-handed. The new axes
# are (y, z, x) for i = 0 and (z, x, y) for i = 1, by rotations of +-120 degrees about (1, 1, 1).
_AXIS_ROTATIONS = np.array([[0.5, 0.5, 0.5, 0.5], [0.5, -0.5, -0.5, -0.5], [1.0, 0.0, 0.0, 0.0]])
_AXIS_ORDERS = np.array([[1, 2, 0], [2, 0, 1], [0, 1, 2]])


def real_numbers(name: str, value) -> np.ndarray:
    try:
        array = np.asarray(value)
    except ValueError:
        raise InputError(f"{name} must be an array, got rows of different lengths") from None
    if array.dtype.kind not in "fiu" or array.dtype.itemsize > 8:
        raise InputError(f"{name} must be an array of real numbers, got {array.dtype}")
    return array


def check_shape(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape == shape:
        return
    required = "(n, 3)" if name == "means" else str(shape)
    if name == "scales":
        required += f" or {(shape[0], 3)}"
    raise InputError(f"{name} must have the shape {required}, got shape {array.shape}")


def check_color_range(colors: np.ndarray) -> np.ndarray:
    """Raise InputError for colours from 0 to 255; white must be 1."""
    if colors.dtype == np.uint8 and colors.size and colors.max() > 1:
        raise InputError("colors must be numbers in which 1 is white, got bytes up to 255; pass colors / 255")
    return colors


def whole_numbers(labels, n: int, name: str = "labels") -> np.ndarray:
    array = real_numbers(name, 0 if labels is None else labels)
    if array.dtype.kind == "f" and array.size:
        raise InputError(f"{name} must be ints, got {array.dtype}")
    if array.shape not in ((), (n,)):
        raise InputError(f"{name} must be one int or have the shape ({n},), got shape {array.shape}")
    limits = np.iinfo(np.int32)
    if array.size and (int(array.min()) < limits.min or int(array.max()) > limits.max):
        raise InputError(
            f"{name} must be from {limits.min} to {limits.max}, got {array.min():.0f} to {array.max():.0f}"
        )
    return np.full(n, array, np.int32) if array.ndim == 0 else array.astype(np.int32)


def check_origin(origin) -> np.ndarray:
    array = real_numbers("origin", origin).astype(np.float64)
    if array.shape != (3,) or rows_beyond(array, LARGEST) is not None:
        raise InputError(f"origin must be three numbers, at most {LARGEST:g} metres, got {origin!r}")
    return array


def _is_frozen(array) -> bool:
    while isinstance(array, np.ndarray):
        if array.flags.writeable or isinstance(array, np.memmap):
            return False
        array = array.base
    return array is None


def as_float32(array: np.ndarray) -> np.ndarray:
    """A C-ordered float32 array that no other code can change; an overflow becomes inf."""
    if array.dtype == F32 and array.flags.c_contiguous and _is_frozen(array):
        return array
    with np.errstate(over="ignore"):
        return np.array(array, dtype=F32, order="C")


def choose_origin(
    means: np.ndarray, rounded: np.ndarray, scales: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Choose an origin (3,) float64 for finite world means (n, 3), and return means (n, 3) float32 relative
    to it, and the origin. rounded: means as float32.

    The origin is 0, unless float32 would lose at least 6 of its 24 bits: means that float32 cannot represent
    exactly are further from 0 than 64 times the cloud's radius. Then it is the centre of the bounding box,
    rounded to a power of two near the radius.
    """
    zero = np.zeros(3)
    if means.dtype == F32 or not len(means) or np.array_equal(rounded, means):
        return rounded, zero
    low, high = means.min(axis=0), means.max(axis=0)
    radius = max(float((high - low).max()) / 2, 3.0 * float(scales.max()))
    if max(np.abs(low).max(), np.abs(high).max()) <= 64 * radius:
        return rounded, zero
    step = 2.0 ** np.floor(np.log2(radius))
    origin = np.round((low / 2 + high / 2) / step) * step
    return as_float32(means - origin), origin


def unit_quaternions(quats: np.ndarray) -> np.ndarray:
    """Normalised quaternions; those that are normalised up to float32 rounding stay unchanged."""
    unit = quats
    for start in range(0, len(quats), 4096):  # bounds the float64 copy
        rows = slice(start, start + 4096)
        square = squared_lengths(quats[rows])
        unnormalised = np.abs(square - 1.0) > 2.4e-7
        if unnormalised.any():
            unit = unit if unit.flags.writeable else unit.copy()
            unit[rows][unnormalised] = quats[rows][unnormalised] / np.sqrt(square[unnormalised])[:, None]
    return unit


def with_thinnest_last(quats: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotate 3D Gaussians, quats (n, 4) wxyz and scales (n, 3), so that their third axis is the thinnest."""
    thinnest = 2 - np.argmin(scales[:, ::-1], axis=1)
    rotates = thinnest != 2
    if rotates.any():
        quats = quats.copy()
        with np.errstate(over="ignore", invalid="ignore"):
            quats[rotates] = quaternion_multiply(quats[rotates], _AXIS_ROTATIONS[thinnest[rotates]])
    return quats, np.take_along_axis(scales, _AXIS_ORDERS[thinnest], axis=1)


def check_one_footprint(groups: np.ndarray | None, boxes: np.ndarray | None) -> None:
    """Raise InputError for a coplanar group that has both box splats and Gaussians."""
    if groups is None or boxes is None:
        return
    mixed = np.intersect1d(groups[(groups >= 0) & boxes], groups[~boxes])
    if len(mixed):
        raise InputError(
            f"coplanar group {mixed[0]} must have only boxes or only Gaussians, got both; give each kind its "
            "own group"
        )


def joined_arrays(clouds: Sequence[Any], name: str, kind) -> np.ndarray | None:
    """Concatenated array of several clouds: 0 where a cloud has None, None if all have None."""
    arrays = [getattr(cloud, name) for cloud in clouds]
    if all(array is None for array in arrays):
        return None
    pairs = zip(arrays, clouds, strict=True)
    return np.concatenate([np.zeros(len(cloud), kind) if array is None else array for array, cloud in pairs])


def joined_groups(clouds: Sequence[Any]) -> np.ndarray | None:
    """Coplanar groups of several clouds, with ids that no two clouds share; -1 for no group."""
    groups = [cloud.coplanar_groups for cloud in clouds]
    if all(ids is None for ids in groups):
        return None
    dense = [
        np.full(len(cloud), -1, np.int32) if ids is None else ids
        for cloud, ids in zip(clouds, groups, strict=True)
    ]
    offsets = group_offsets([int(ids.max(initial=-1)) for ids in dense])
    pairs = zip(dense, offsets, strict=True)
    return np.concatenate([np.where(ids >= 0, ids + np.int32(offset), np.int32(-1)) for ids, offset in pairs])


def group_offsets(largest: Sequence[int]) -> list[int]:
    """Offsets that keep the coplanar group ids of several clouds distinct. largest: largest id of each cloud,
    -1 for no group. Raises InputError if an id would exceed int32."""
    offsets, next_id = [], 0
    for largest_id in largest:
        offsets.append(next_id if largest_id >= 0 else 0)
        next_id += largest_id + 1
        if next_id > 2**31:
            raise InputError(
                f"clouds of a scene must have fewer than 2^31 coplanar groups in total, got id {largest_id}; "
                "number the groups of each cloud from 0"
            )
    return offsets
