"""SplatCloud: the 2D Gaussian splats of a scene as a structure of arrays, checked once and then frozen."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fidsplat.defects import drop_report, find_defects, rows_beyond, square_of
from fidsplat.errors import InputError
from fidsplat.harmonics import C0, MAX_DEGREE, rotation_of_coefficients, sh_basis
from fidsplat.rotations import (
    check_similarity,
    matrix_to_quaternion,
    quaternion_multiply,
    quaternion_to_matrix,
)
from fidsplat.scalars import LARGEST, PickledByFields

__all__ = ["SplatCloud", "sh_basis"]

_F32 = np.dtype(np.float32)


@dataclass(frozen=True, init=False, eq=False, repr=False)
class SplatCloud(PickledByFields):
    """2D Gaussian splats. Every array is read-only; make a new cloud to change one."""

    means: np.ndarray
    """(n, 3) float32, metres, centres relative to ``origin``"""
    quats: np.ndarray
    """(n, 4) float32, unit (w, x, y, z); the rotation's columns are tangent u, tangent v, normal"""
    scales: np.ndarray
    """(n, 2) float32, metres, standard deviations along the tangents, above 0"""
    opacities: np.ndarray
    """(n,) float32 in [0, 1]"""
    colors: np.ndarray | None
    """(n, 3) float32 RGB in display space, or None when ``sh`` is set"""
    sh: np.ndarray | None
    """(n, k, 3) float32, k = (degree + 1)^2, or None when ``colors`` is set; convention at ``sh_basis``"""
    labels: np.ndarray
    """(n,) int32"""
    origin: np.ndarray
    """(3,) float64, metres, world position of the means' zero"""
    planes: np.ndarray | None = None
    """(n,) int32, or None: splats with the same id >= 0 are printed on one plane, where their order means
    nothing (`with_planes`); -1 for splats of no plane"""
    boxes: np.ndarray | None = None
    """(n,) bool, or None if all are False: True for a box, whose opacity is the same all over |u|, |v| <= 1
    and whose ``scales`` are half sides (`with_boxes`); False for a Gaussian"""
    dropped: dict[str, int] = field(default_factory=dict)
    """reason -> number of splats left out when this cloud was made; empty when nothing was"""

    def __init__(
        self, means, quats, scales, opacities, colors=None, sh=None, labels=None, origin=None, *, source=None
    ):
        """Check and freeze n splats.

        means (n, 3) metres; quats (n, 4) wxyz of any length but 0; scales (n, 2) metres; opacities (n,) in
        [0, 1]; exactly one of colors (n, 3) and sh (n, 1 | 4 | 9 | 16, 3); labels: an int or (n,) ints,
        else 0.

        origin None: means are world coordinates; float32 means keep their bits, with origin 0; float64
        means get an origin when float32 would blur them. origin (3,): means are relative to it, as the
        attribute is.

        A splat that cannot be drawn (a value that is not finite or, quaternions apart, beyond 1e15,
        |q|^2 < 1e-30, a scale <= 0, an opacity outside [0, 1]) is left out and counted in ``dropped`` under
        its first such reason; one warning reports the counts, naming ``source`` (a file, say). Arrays are
        copied, except float32 arrays that are read-only down to the memory they stand on. Raises InputError,
        naming the array, for a wrong shape or type.
        """
        given = _numbers("means", means)
        n = given.shape[0] if given.ndim else -1
        _check_shape("means", given, (n, 3))
        arrays = {"quats": _numbers("quats", quats), "scales": _numbers("scales", scales)}
        arrays["opacities"] = _numbers("opacities", opacities)
        shapes: dict[str, tuple[int, ...]] = {"quats": (n, 4), "scales": (n, 2), "opacities": (n,)}
        if (colors is None) == (sh is None):
            raise InputError("give exactly one of colors (n, 3) and sh (n, k, 3)")
        if colors is not None:
            arrays["colors"] = _numbers("colors", colors)
            shapes["colors"] = (n, 3)
        else:
            arrays["sh"] = _numbers("sh", sh)
            k = arrays["sh"].shape[1] if arrays["sh"].ndim == 3 else 0
            if k not in [(d + 1) ** 2 for d in range(MAX_DEGREE + 1)]:
                got = arrays["sh"].shape
                raise InputError(
                    f"sh must have the shape ({n}, k, 3), k = 1, 4, 9 or 16, but its shape is {got}"
                )
            shapes["sh"] = (n, k, 3)
        for name, array in arrays.items():
            _check_shape(name, array, shapes[name])
        new_labels = _labels(labels, n)

        single = {name: _single(array) for name, array in {"means": given, **arrays}.items()}
        keep, dropped = find_defects(single)
        if keep is not None:
            single = {name: array[keep] for name, array in single.items()}
            given = single["means"] if given.dtype == _F32 else given[keep]
            new_labels = new_labels[keep]
            warnings.warn(drop_report(dropped, n, source), stacklevel=2)
        self._finish(given, single, new_labels, origin, dropped)

    @classmethod
    def of_checked(cls, means, quats, scales, opacities, sh, labels=None, *, origin, dropped) -> "SplatCloud":
        """A cloud that takes over arrays of splats that can all be drawn, as a reader of files has found.

        means (n, 3) float32 or float64, all else as the attributes are, but quats of any length above 0.
        dropped: what the reader left out.
        """
        cloud = object.__new__(cls)
        single = {"quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
        single["means"] = means if means.dtype == _F32 else _single(means)
        cloud._finish(means, single, _labels(None, len(means)) if labels is None else labels, origin, dropped)
        return cloud

    def _finish(self, given, single: dict[str, np.ndarray], labels, origin, dropped: dict[str, int]) -> None:
        """Freeze splats that can be drawn; given: the means in the type that they came in."""
        single["quats"] = _unit(single["quats"])
        if origin is not None:
            new_origin = _check_origin(origin)
        else:  # after the defects, so that a splat that is left out has no say in it
            single["means"], new_origin = _choose_origin(given, single["means"], single["scales"])
        self._set(
            **{"colors": None, "sh": None, "planes": None, "boxes": None, **single},
            labels=labels,
            origin=new_origin,
            dropped=dropped,
        )

    def _set(self, **values) -> None:
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)

    def _replaced(self, **values) -> "SplatCloud":
        """A copy with some arrays exchanged; the values are known to be good."""
        cloud = object.__new__(SplatCloud)
        old = {name: getattr(self, name) for name in self.__dataclass_fields__}
        cloud._set(**old | {"dropped": dict(self.dropped)} | values)
        return cloud

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        color = "colors" if self.sh is None else f"SH degree {self.sh_degree}"
        return f"SplatCloud({len(self)} splats, {color}, origin {tuple(self.origin.tolist())})"

    @property
    def sh_degree(self) -> int:
        """Degree 0 to 3 of the SH colours, -1 for plain colours."""
        return -1 if self.sh is None else int(np.sqrt(self.sh.shape[1])) - 1

    @property
    def plain_colors(self) -> np.ndarray | None:
        """(n, 3) float32 colours that do not depend on the view: `colors`, or what SH of degree 0 means; None
        for SH of a higher degree."""
        if self.sh is None or self.sh_degree > 0:
            return self.colors
        return np.maximum(np.float32(C0) * self.sh[:, 0, :] + np.float32(0.5), np.float32(0))

    @property
    def has_planes(self) -> bool:
        """Whether some splats are printed on planes."""
        return self.planes is not None

    @property
    def footprint(self) -> str:
        """`gaussian`, `box`, or `mixed` where there are splats of both kinds."""
        if self.boxes is None:
            return "gaussian"
        return "box" if self.boxes.all() else "mixed"

    @staticmethod
    def empty() -> "SplatCloud":
        """A cloud of no splats, with plain colours and no origin of its own."""
        zero = np.zeros
        return SplatCloud(zero((0, 3)), zero((0, 4)), zero((0, 2)), zero(0), colors=zero((0, 3)))

    def world_means(self) -> np.ndarray:
        """Centres (n, 3) float64 in the world, metres."""
        return self.means + self.origin

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest axis-aligned box (min (3,), max (3,)) float64, world, around all splats' 3 sigma ellipses.

        Raises InputError for an empty cloud.
        """
        if not len(self):
            raise InputError("an empty cloud has no bounds")
        axes = quaternion_to_matrix(self.quats)[:, :, :2] * (3.0 * self.scales.astype(np.float64))[:, None, :]
        reach = np.sqrt((axes * axes).sum(axis=2))
        return (self.means - reach).min(axis=0) + self.origin, (self.means + reach).max(axis=0) + self.origin

    def with_labels(self, labels) -> "SplatCloud":
        """The same splats with other labels, one int or (n,) ints. Raises InputError for anything else."""
        return self._replaced(labels=_labels(labels, len(self)))

    def transformed(self, matrix) -> "SplatCloud":
        """The cloud moved by a 4x4 rigid transform with uniform scale (world from world); SH colours turn
        too.

        A cloud with an origin keeps its relative means small: the origin moves. Raises InputError for any
        other matrix, a reflection among them.
        """
        rotation, scale, translation = check_similarity(matrix, "the transform")
        local = self.means @ (scale * rotation).T
        if self.origin.any():
            means, origin = _single(local), scale * rotation @ self.origin + translation
        else:
            world = local + translation
            means, origin = _choose_origin(world, _single(world), self.scales * scale)
        quats = _unit(quaternion_multiply(matrix_to_quaternion(rotation), self.quats).astype(_F32))
        sh = self.sh
        if sh is not None and sh.shape[1] > 1:
            sh = rotation_of_coefficients(self.sh_degree, rotation).astype(_F32) @ sh
        scales = _single(self.scales * scale)
        within = all(rows_beyond(array, LARGEST) is None for array in (means, scales))
        if not (within and (scales > 0).all()):
            raise InputError(
                f"the transform takes splats out of range (its scale is {scale:g}): means and scales may be "
                f"at most {LARGEST:g}, and scales must stay above 0"
            )
        return self._replaced(means=means, quats=quats, scales=scales, sh=sh, origin=origin)

    def with_planes(self, planes) -> "SplatCloud":
        """The same splats, printed on planes: one id or (n,) ids, -1 for none.

        A renderer draws the splats of one plane as one layer: where they meet in a pixel, the result does not
        depend on their order. They must be coplanar, as those of a marker are. Raises InputError for anything
        but ints of at least -1.
        """
        ids = _labels(planes, len(self), "planes")
        if (ids < -1).any():
            raise InputError(f"planes must be ids of at least 0, or -1 for none, not {int(ids.min())}")
        _check_one_footprint(ids, self.boxes)
        return self._replaced(planes=ids if (ids >= 0).any() else None)

    def with_boxes(self, boxes=True) -> "SplatCloud":
        """The same splats with box footprints where ``boxes``, one bool or (n,) bools, is True.

        A box is a rectangle of even opacity: its scales are half sides in metres, its edges are filtered by
        the pixel. On a plane (`with_planes`) boxes lie side by side: what they cover of a pixel adds up, so
        those of a partition, their sides parallel, leave no seam. Raises InputError for anything but bools,
        and for a plane of both kinds.
        """
        try:
            mask = np.asarray(boxes)
        except ValueError:  # rows that differ in length
            mask = np.empty(0)
        if mask.dtype != bool or mask.shape not in ((), (len(self),)):
            raise InputError(f"boxes must be one bool or have the shape ({len(self)},) and the type bool")
        mask = np.full(len(self), mask) if mask.ndim == 0 else mask.copy()
        _check_one_footprint(self.planes, mask)
        return self._replaced(boxes=mask if mask.any() else None)

    @staticmethod
    def concatenate(clouds: Sequence["SplatCloud"]) -> "SplatCloud":
        """All splats of several clouds, in order.

        When any has SH, all get SH of the highest degree (colours become degree 0, missing bands 0). Clouds
        that share an origin keep their bits; otherwise a common one is chosen as in the constructor.
        Planes of different clouds stay different planes. ``dropped`` adds up.
        """
        try:
            clouds = list(clouds)
        except TypeError:
            clouds = [None]  # type: ignore[list-item]
        for cloud in clouds:
            if not isinstance(cloud, SplatCloud):
                raise InputError(f"concatenate takes a list of SplatCloud, not of {type(cloud).__name__}")
        dropped: dict[str, int] = {}
        for cloud in clouds:
            for reason, count in cloud.dropped.items():
                dropped[reason] = dropped.get(reason, 0) + count
        filled = [cloud for cloud in clouds if len(cloud)]
        if not filled:
            return (clouds[0] if clouds else SplatCloud.empty())._replaced(dropped=dropped)
        first = filled[0]
        if len(filled) == 1:
            return first._replaced(dropped=dropped)
        joined = {
            name: np.concatenate([getattr(cloud, name) for cloud in filled])
            for name in ("means", "quats", "scales", "opacities", "labels")
        }
        joined["origin"] = first.origin
        if any(not np.array_equal(cloud.origin, first.origin) for cloud in filled):
            world = np.concatenate([cloud.world_means() for cloud in filled])
            joined["means"], joined["origin"] = _choose_origin(world, _single(world), joined["scales"])
        degree = max(cloud.sh_degree for cloud in filled)
        if degree < 0:
            colors, sh = np.concatenate([cloud.colors for cloud in filled if cloud.colors is not None]), None
        else:
            colors, sh = None, np.concatenate([_sh_of_degree(cloud, degree) for cloud in filled])
        planes, boxes = _joined_planes(filled), None
        if any(cloud.boxes is not None for cloud in filled):
            boxes = np.concatenate(
                [np.zeros(len(cloud), bool) if cloud.boxes is None else cloud.boxes for cloud in filled]
            )
        return first._replaced(**joined, planes=planes, boxes=boxes, colors=colors, sh=sh, dropped=dropped)


def _numbers(name: str, value) -> np.ndarray:
    try:
        array = np.asarray(value)
    except ValueError:
        raise InputError(f"{name} must be an array, but its rows differ in length") from None
    if array.dtype.kind not in "fiu" or array.dtype.itemsize > 8:
        raise InputError(f"{name} must be an array of real numbers, not of {array.dtype}")
    return array


def _check_shape(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape == shape:
        return
    hint = ""
    if name == "scales" and array.ndim == 2 and array.shape[1] == 3:
        hint = "; a 3DGS cloud must be flattened first (fidsplat.formats.flatten, or load_ply)"
    wanted = "(n, 3)" if name == "means" else str(shape)
    raise InputError(f"{name} must have the shape {wanted}, but its shape is {array.shape}{hint}")


def _joined_planes(clouds: Sequence[SplatCloud]) -> np.ndarray | None:
    if all(cloud.planes is None for cloud in clouds):
        return None
    joined, first_free = [], 0
    for cloud in clouds:
        ids = np.full(len(cloud), -1, np.int32) if cloud.planes is None else cloud.planes
        joined.append(np.where(ids >= 0, ids + first_free, -1).astype(np.int32))
        first_free = max(first_free, int(joined[-1].max()) + 1)
    return np.concatenate(joined)


def _check_one_footprint(planes: np.ndarray | None, boxes: np.ndarray | None) -> None:
    if planes is None or boxes is None:
        return
    both = np.intersect1d(planes[(planes >= 0) & boxes], planes[~boxes])
    if len(both):
        raise InputError(
            f"plane {both[0]} has boxes and Gaussians, whose coverage follows different rules; "
            "give each kind a plane"
        )


def _labels(labels, n: int, name: str = "labels") -> np.ndarray:
    array = _numbers(name, 0 if labels is None else labels)
    if array.dtype.kind == "f" and array.size:
        raise InputError(f"{name} must be ints, not {array.dtype}")
    if array.shape not in ((), (n,)):
        raise InputError(f"{name} must be one int or have the shape ({n},), but its shape is {array.shape}")
    limits = np.iinfo(np.int32)
    if array.size and (int(array.min()) < limits.min or int(array.max()) > limits.max):
        raise InputError(f"{name} must lie in {limits.min} to {limits.max}")
    return np.full(n, array, np.int32) if array.ndim == 0 else array.astype(np.int32)


def _check_origin(origin) -> np.ndarray:
    array = _numbers("origin", origin).astype(np.float64)
    if array.shape != (3,) or rows_beyond(array, LARGEST) is not None:
        raise InputError(f"origin must be three numbers, at most {LARGEST:g} metres, not {origin!r}")
    return array


def _is_frozen(array) -> bool:
    while isinstance(array, np.ndarray):
        if array.flags.writeable or isinstance(array, np.memmap):
            return False
        array = array.base
    return array is None


def _single(array: np.ndarray) -> np.ndarray:
    """As C-ordered float32 that nobody else can write to; what float32 cannot hold becomes inf."""
    if array.dtype == _F32 and array.flags.c_contiguous and _is_frozen(array):
        return array
    with np.errstate(over="ignore"):
        return np.array(array, dtype=_F32, order="C")


def _choose_origin(
    means: np.ndarray, single: np.ndarray, scales: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(means (n, 3) float32 relative to the origin, origin (3,) float64) for finite means (n, 3) in the
    world.

    ``single`` is the means as float32. The origin is 0 unless the means are not all float32 numbers and lie
    further from 0 than 64 times the cloud's reach, so that float32 would lose at least 6 of its 24 bits.
    Then it is the centre of the bounding box, rounded to a power of two near the reach, which keeps it a
    short number.
    """
    zero = np.zeros(3)
    if means.dtype == _F32 or not len(means) or np.array_equal(single, means):
        return single, zero
    low, high = means.min(axis=0), means.max(axis=0)
    reach = max(float((high - low).max()) / 2, 3.0 * float(scales.max()))
    if max(np.abs(low).max(), np.abs(high).max()) <= 64 * reach:
        return single, zero
    step = 2.0 ** np.floor(np.log2(reach))
    origin = np.round((low / 2 + high / 2) / step) * step
    return _single(means - origin), origin


def _unit(quats: np.ndarray) -> np.ndarray:
    """Quaternions of length 1. Those that are so to float32 rounding keep their bits: twice is the same as
    once."""
    unit = quats  # only a cloud's own array can be written to
    for start in range(0, len(quats), 4096):  # so that millions of them need no copy in float64
        part = slice(start, start + 4096)
        square = square_of(quats[part])
        off = np.abs(square - 1.0) > 2.4e-7
        if off.any():
            unit = unit if unit.flags.writeable else unit.copy()
            unit[part][off] = quats[part][off] / np.sqrt(square[off])[:, None]
    return unit


def _sh_of_degree(cloud: SplatCloud, degree: int) -> np.ndarray:
    sh = np.zeros((len(cloud), (degree + 1) ** 2, 3), _F32)
    if cloud.colors is not None:
        sh[:, 0] = (cloud.colors.astype(np.float64) - 0.5) / C0
    elif cloud.sh is not None:
        sh[:, : cloud.sh.shape[1]] = cloud.sh
    return sh
