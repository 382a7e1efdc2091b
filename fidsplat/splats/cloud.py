"""SplatCloud: validated, read-only arrays of the splats of a scene."""

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fidsplat.splats.arrays import (
    F32,
    OPTIONAL,
    as_float32,
    check_color_range,
    check_one_footprint,
    check_origin,
    check_shape,
    choose_origin,
    drop_report,
    find_defects,
    joined_arrays,
    joined_groups,
    present_arrays,
    real_numbers,
    rows_beyond,
    unit_quaternions,
    whole_numbers,
    with_thinnest_last,
)
from fidsplat.splats.harmonics import MAX_DEGREE, colors_of_degree, rotation_of_coefficients, sh_basis
from fidsplat.splats.rotations import (
    check_similarity,
    matrix_to_quaternion,
    pose_matrix,
    quaternion_multiply,
    quaternion_to_matrix,
)
from fidsplat.util.arguments import LARGEST, PickledByFields, number
from fidsplat.util.errors import InputError
from fidsplat.util.markup import Summarised, point

__all__ = ["SplatCloud", "sh_basis"]


@dataclass(frozen=True, init=False, eq=False, repr=False)
class SplatCloud(PickledByFields, Summarised):
    """2D Gaussian splats (disks), and 3D ones (ellipsoids) where the thickness is above 0. Arrays are
    read-only."""

    means: np.ndarray
    """(n, 3) float32, metres, centres relative to ``origin``"""
    quats: np.ndarray
    """(n, 4) float32, unit (w, x, y, z); the rotation's columns are tangent u, tangent v, normal"""
    scales: np.ndarray
    """(n, 2) float32, metres, standard deviations along the tangents, above 0"""
    opacities: np.ndarray
    """(n,) float32 in [0, 1]"""
    colors: np.ndarray | None
    """(n, 3) float32 RGB in display space; None if ``sh`` is set"""
    sh: np.ndarray | None
    """(n, k, 3) float32, k = (degree + 1)^2, in the convention of ``sh_basis``; None if ``colors`` is set"""
    labels: np.ndarray
    """(n,) int32"""
    origin: np.ndarray
    """(3,) float64, metres, world position that means are relative to"""
    coplanar_groups: np.ndarray | None = None
    """(n,) int32, or None: splats with the same id >= 0 are coplanar and composited without an order
    (`with_coplanar_groups`); -1 for splats in no group"""
    boxes: np.ndarray | None = None
    """(n,) bool, or None if all are False: True for a box splat, with uniform opacity in |u|, |v| <= 1 and
    ``scales`` as half sides (`with_boxes`), False for a Gaussian"""
    thickness: np.ndarray | None = None
    """(n,) float32, metres, or None if all are 0: standard deviation along the normal, above 0 for a 3D
    Gaussian, 0 for a disk or a box splat"""
    dropped: dict[str, int] = field(default_factory=dict)
    """reason -> number of splats dropped by the constructor"""

    def __init__(
        self, means, quats, scales, opacities, colors=None, sh=None, labels=None, origin=None, *, source=None
    ):
        """Validate and freeze n splats.

        means (n, 3) metres; quats (n, 4) wxyz of any length but 0; scales (n, 2) metres, or (n, 3) with
        ``thickness`` as the third, 0 for a disk; opacities (n,) in [0, 1]; exactly one of colors (n, 3) and
        sh (n, 1 | 4 | 9 | 16, 3); labels: an int or (n,) ints, default 0.

        origin None: means are world coordinates; float32 means are stored unchanged with origin 0; float64
        means get an origin if float32 would lose precision. origin (3,): means are relative to it.

        A splat that cannot be rendered (a value that is not finite or, except in quaternions, beyond 1e15,
        |q|^2 < 1e-30, a scale <= 0 or a thickness < 0, an opacity outside [0, 1]) is dropped and counted in
        ``dropped`` by its first reason; one warning reports the counts and names ``source``, e.g. a file.
        Arrays are copied unless they are float32 and read-only, including their base. Raises InputError,
        naming the array, for a wrong shape or type.
        """
        given_means = real_numbers("means", means)
        n = given_means.shape[0] if given_means.ndim else -1
        check_shape("means", given_means, (n, 3))
        arrays = {"quats": real_numbers("quats", quats), "scales": real_numbers("scales", scales)}
        arrays["opacities"] = real_numbers("opacities", opacities)
        thick = arrays["scales"].shape == (n, 3)
        shapes: dict[str, tuple[int, ...]] = {"quats": (n, 4), "opacities": (n,)}
        shapes["scales"] = (n, 3) if thick else (n, 2)
        if (colors is None) == (sh is None):
            raise InputError("exactly one of colors (n, 3) and sh (n, k, 3) must be given, got both or none")
        if colors is not None:
            arrays["colors"] = check_color_range(real_numbers("colors", colors))
            shapes["colors"] = (n, 3)
        else:
            arrays["sh"] = real_numbers("sh", sh)
            k = arrays["sh"].shape[1] if arrays["sh"].ndim == 3 else 0
            if k not in [(d + 1) ** 2 for d in range(MAX_DEGREE + 1)]:
                got = arrays["sh"].shape
                raise InputError(f"sh must have the shape ({n}, k, 3), k = 1, 4, 9 or 16, got shape {got}")
            shapes["sh"] = (n, k, 3)
        for name, array in arrays.items():
            check_shape(name, array, shapes[name])
        new_labels = whole_numbers(labels, n)

        float32 = {name: as_float32(array) for name, array in {"means": given_means, **arrays}.items()}
        valid, dropped = find_defects(float32)
        if valid is not None:
            float32 = {name: array[valid] for name, array in float32.items()}
            given_means = float32["means"] if given_means.dtype == F32 else given_means[valid]
            new_labels = new_labels[valid]
            warnings.warn(drop_report(dropped, n, source), stacklevel=2)
        if thick:
            float32["thickness"] = as_float32(float32["scales"][:, 2])
            float32["scales"] = as_float32(float32["scales"][:, :2])
        self._finish(given_means, float32, new_labels, origin, dropped)

    @classmethod
    def from_validated(
        cls,
        means,
        quats,
        scales,
        opacities,
        sh=None,
        labels=None,
        thickness=None,
        *,
        colors=None,
        origin,
        dropped,
    ) -> "SplatCloud":
        """A cloud of validated arrays, without a copy: means float32 or float64, quats of any length above 0,
        and either sh or colors. dropped: counts of a reader."""
        cloud = object.__new__(cls)
        float32 = {"quats": quats, "scales": scales, "opacities": opacities, "colors": colors, "sh": sh}
        float32["means"] = means if means.dtype == F32 else as_float32(means)
        if thickness is not None:
            float32["thickness"] = thickness
        cloud._finish(
            means, float32, whole_numbers(None, len(means)) if labels is None else labels, origin, dropped
        )
        return cloud

    def _finish(self, means, float32: dict[str, np.ndarray], labels, origin, dropped: dict[str, int]) -> None:
        """Normalise quaternions, choose the origin, freeze validated arrays. means: in the caller's type."""
        float32["quats"] = unit_quaternions(float32["quats"])
        if "thickness" in float32 and not float32["thickness"].any():
            del float32["thickness"]
        if origin is not None:
            new_origin = check_origin(origin)
        else:  # chosen without the dropped splats
            float32["means"], new_origin = choose_origin(means, float32["means"], float32["scales"])
        self._set(**dict.fromkeys(OPTIONAL) | float32, labels=labels, origin=new_origin, dropped=dropped)

    def _set(self, **values) -> None:
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)

    def _replaced(self, **values) -> "SplatCloud":
        """A copy with some arrays replaced by validated values."""
        cloud = object.__new__(SplatCloud)
        old = {name: getattr(self, name) for name in self.__dataclass_fields__}
        cloud._set(**old | {"dropped": dict(self.dropped)} | values)
        return cloud

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        color = "colors" if self.sh is None else f"SH degree {self.sh_degree}"
        return f"SplatCloud({len(self)} splats, {color}, origin {tuple(self.origin.tolist())})"

    def summary(self) -> dict[str, str]:
        """Readable summary of the contents."""
        kinds = {"none": "2D", "all": "3D", "some": "2D and 3D"}
        rows = {"splats": f"{len(self):,}, {kinds[self.ellipsoids]}"}
        rows["colours"] = "plain" if self.sh is None else f"SH of degree {self.sh_degree}"
        if len(self):
            rows["bounds"] = " to ".join(map(point, self.bounds())) + " m"
            rows["labels"] = f"{len(np.unique(self.labels)):,} different"
        return rows | {f"dropped: {why}": f"{count:,}" for why, count in self.dropped.items()}

    @property
    def sh_degree(self) -> int:
        """Degree 0 to 3 of the SH colours, -1 for plain colours."""
        return -1 if self.sh is None else int(np.sqrt(self.sh.shape[1])) - 1

    @property
    def plain_colors(self) -> np.ndarray | None:
        """Colours (n, 3) float32 that do not depend on the direction; None with SH above degree 0."""
        if self.sh is None or self.sh_degree > 0:
            return self.colors
        return colors_of_degree({"sh": self.sh}, -1)["colors"]

    @property
    def has_coplanar_groups(self) -> bool:
        """Whether some splats are in coplanar groups."""
        return self.coplanar_groups is not None

    @property
    def ellipsoids(self) -> str:
        """Which splats are 3D Gaussians: `none`, `some` or `all`."""
        if self.thickness is None:
            return "none"
        return "all" if (self.thickness > 0).all() else "some"

    @property
    def footprint(self) -> str:
        """`gaussian`, `box`, or `mixed` for both kinds."""
        if self.boxes is None:
            return "gaussian"
        return "box" if self.boxes.all() else "mixed"

    @staticmethod
    def empty() -> "SplatCloud":
        """An empty cloud with plain colours and origin 0."""
        zero = np.zeros
        return SplatCloud(zero((0, 3)), zero((0, 4)), zero((0, 2)), zero(0), colors=zero((0, 3)))

    def world_means(self) -> np.ndarray:
        """Centres (n, 3) float64 in the world, metres."""
        return self.means + self.origin

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """World bounding box (min (3,), max (3,)) float64 of Gaussians to 3 sigma and of boxes to their
        corners. Raises InputError for an empty cloud."""
        if not len(self):
            raise InputError("the cloud must have at least one splat to have bounds, got none")
        half = self.half_extents(3.0)
        return (self.means - half).min(axis=0) + self.origin, (self.means + half).max(axis=0) + self.origin

    def half_extents(self, sigmas: float) -> np.ndarray:
        """Half extents (n, 3) float64 [m] along world axes: Gaussians to `sigmas`, box splats to corners."""
        sigmas = number("sigmas", sigmas, "a number of standard deviations, 0 to 1e6", 0.0, 1e6)
        rotations = quaternion_to_matrix(self.quats)
        axes = rotations[:, :, :2] * (sigmas * self.scales.astype(np.float64))[:, None, :]
        squares = (axes * axes).sum(axis=2)
        if self.thickness is not None:
            squares += (rotations[:, :, 2] * (sigmas * self.thickness.astype(np.float64))[:, None]) ** 2
        if self.boxes is None:
            return np.sqrt(squares)
        corners = np.abs(rotations[:, :, :2] * self.scales.astype(np.float64)[:, None, :]).sum(axis=2)
        return np.where(self.boxes[:, None], corners, np.sqrt(squares))

    def flattened(self) -> "SplatCloud":
        """The cloud with its 3D Gaussians flattened to disks; the thinnest axis becomes the normal.

        For renderers of 2D Gaussians. Captured scenes of thick splats lose their haze (docs/experiments.md).
        """
        if self.thickness is None:
            return self
        quats, scales, rows = self.quats.copy(), self.scales.copy(), self.thickness > 0
        all_scales = np.column_stack([scales[rows], self.thickness[rows]])
        rotated, sorted_scales = with_thinnest_last(quats[rows], all_scales)
        quats[rows], scales[rows] = rotated, sorted_scales[:, :2]
        return self._replaced(quats=unit_quaternions(quats), scales=scales, thickness=None)

    def with_labels(self, labels) -> "SplatCloud":
        """A copy with other labels, one int or (n,) ints. Raises InputError for anything else."""
        return self._replaced(labels=whole_numbers(labels, len(self)))

    def transformed(self, matrix) -> "SplatCloud":
        """The cloud transformed by a 4x4 rotation, uniform scale and translation, or by a pose (position,
        quaternion w, x, y, z); SH colours rotate too.

        A cloud with an origin keeps its means small: the origin moves. Raises InputError for any other
        matrix, such as a reflection.
        """
        rotation, scale, translation = check_similarity(pose_matrix(matrix, "the transform"), "the transform")
        local = self.means @ (scale * rotation).T
        if self.origin.any():
            means, origin = as_float32(local), scale * rotation @ self.origin + translation
        else:
            world = local + translation
            means, origin = choose_origin(world, as_float32(world), self.scales * scale)
        quats = unit_quaternions(quaternion_multiply(matrix_to_quaternion(rotation), self.quats).astype(F32))
        sh = self.sh
        if sh is not None and sh.shape[1] > 1:
            sh = rotation_of_coefficients(self.sh_degree, rotation).astype(F32) @ sh
        scales = as_float32(self.scales * scale)
        thickness = None if self.thickness is None else as_float32(self.thickness * scale)
        within = all(rows_beyond(array, LARGEST) is None for array in (means, scales))
        if not (within and (scales > 0).all()):
            raise InputError(
                f"transformed means and scales must be at most {LARGEST:g} and scales above 0, got means up "
                f"to {np.abs(means).max():g} and scales from {scales.min():g} to {scales.max():g} after a "
                f"transform of scale {scale:g}; use another scale or translation"
            )
        return self._replaced(
            means=means, quats=quats, scales=scales, thickness=thickness, sh=sh, origin=origin
        )

    def with_coplanar_groups(self, groups) -> "SplatCloud":
        """A copy with coplanar groups: one id or (n,) ids, -1 for no group.

        Renderers composite the splats of a group as one layer, so that the result does not depend on their
        order. The splats of a group must be coplanar. Raises InputError for anything but ints of at least -1.
        """
        ids = whole_numbers(groups, len(self), "coplanar_groups")
        if (ids < -1).any():
            raise InputError(
                f"coplanar groups must be ids of at least 0, or -1 for none, got {int(ids.min())}"
            )
        check_one_footprint(ids, self.boxes)
        if self.thickness is not None and ((ids >= 0) & (self.thickness > 0)).any():
            raise InputError(
                "splats in coplanar groups must have a thickness of 0, got up to "
                f"{self.thickness[ids >= 0].max():g}; give 3D Gaussians the group -1"
            )
        return self._replaced(coplanar_groups=ids if (ids >= 0).any() else None)

    def with_boxes(self, boxes: bool | np.ndarray = True) -> "SplatCloud":
        """A copy with box splats where ``boxes``, one bool or (n,) bools, is True.

        A box is a rectangle of uniform opacity: its scales are half sides in metres, its edges are filtered
        by the pixel. In a coplanar group the coverage of boxes adds up, so a partition into boxes with
        parallel sides has no seams. Raises InputError for anything but bools, and for a group of both kinds.
        """
        try:
            mask = np.asarray(boxes)
        except ValueError:
            raise InputError("boxes must be an array, got rows of different lengths") from None
        if mask.dtype != bool or mask.shape not in ((), (len(self),)):
            raise InputError(
                f"boxes must be one bool or have the shape ({len(self)},) and the type bool, got "
                f"{mask.dtype} of shape {mask.shape}"
            )
        mask = np.full(len(self), mask) if mask.ndim == 0 else mask.copy()
        check_one_footprint(self.coplanar_groups, mask)
        if self.thickness is not None and (self.thickness[np.flatnonzero(mask)] > 0).any():
            raise InputError("boxes must have a thickness of 0, got 3D Gaussians among them")
        return self._replaced(boxes=mask if mask.any() else None)

    @staticmethod
    def concatenate(clouds: Sequence["SplatCloud"]) -> "SplatCloud":
        """All splats of several clouds, in order.

        If a cloud has SH, all are converted to SH of the highest degree (colours to degree 0, missing bands
        to 0). Means of clouds with the same origin stay bit-identical; otherwise a common origin is chosen as
        in the constructor. Coplanar groups of different clouds stay different. ``dropped`` is summed.
        """
        try:
            clouds = list(clouds)
        except TypeError:
            clouds = [None]  # type: ignore[list-item]
        for cloud in clouds:
            if not isinstance(cloud, SplatCloud):
                raise InputError(f"clouds must be a list of SplatCloud, got {type(cloud).__name__}")
        dropped = dict(sum((Counter(cloud.dropped) for cloud in clouds), Counter[str]()))
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
            joined["means"], joined["origin"] = choose_origin(world, as_float32(world), joined["scales"])
        degree = max(cloud.sh_degree for cloud in filled)
        if degree < 0:
            colors, sh = np.concatenate([cloud.colors for cloud in filled if cloud.colors is not None]), None
        else:
            sh = [colors_of_degree(present_arrays(cloud), degree)["sh"] for cloud in filled]
            colors, sh = None, np.concatenate(sh)
        joined |= {"coplanar_groups": joined_groups(filled), "boxes": joined_arrays(filled, "boxes", bool)}
        joined["thickness"] = joined_arrays(filled, "thickness", F32)
        return first._replaced(**joined, colors=colors, sh=sh, dropped=dropped)
