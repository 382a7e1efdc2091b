"""Store: a scene in chunks on disk, memory-mapped."""

from __future__ import annotations

import os
import zlib
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.capture.quality import Quality
from fidsplat.splats.arrays import find_defects
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import check_similarity, matrix_to_quaternion
from fidsplat.store import layout
from fidsplat.store.detail_errors import DetailErrors, allowed_cell_size, load_detail_errors
from fidsplat.store.partial_cloud import PartialCloud, concatenated, transformed
from fidsplat.util.arguments import callback, flag, instance, invalid, real_array, whole_number
from fidsplat.util.arguments import number as checked_number
from fidsplat.util.errors import InputError
from fidsplat.util.files import kind_of, path_of
from fidsplat.util.markup import Summarised, point
from fidsplat.util.npy import load_npy
from fidsplat.util.progress import Progress


class Store(Summarised):
    """Splats on disk, built by `fidsplat store build` or instanced by `fidsplat store place`.

    Splats are read when a view needs them. An instanced store has the splats of another store at several
    poses, pose after pose. A store is thread-safe, and pickled by its path.

    Args:
        path: its folder, e.g. city.fss.

    Raises:
        InputError: the folder is not a store, or incomplete, damaged or of a newer version.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = path_of(path)
        if not self.path.is_dir():
            raise InputError(f"{self.path} must be the folder of a store, got {kind_of(self.path)}")
        header = self.header = layout.read_header(self.path)
        self.poses: np.ndarray | None = None
        """(p, 4, 4) float64 poses of an instanced store"""
        self._folder, column_header = self.path, header
        if header.store is not None:
            self._folder = path_of(self.path / header.store)
            column_header = layout.read_header(self._folder)
            if column_header.identity != header.identity or column_header.store is not None:
                raise InputError(
                    f"{self._folder} has changed since {self.path} was placed; place the store again"
                )
            self.poses = _read_poses(self.path, header.places_crc)
            if (
                replace(
                    column_header,
                    splats=column_header.splats * len(self.poses),
                    rows=column_header.rows * len(self.poses),
                    store=header.store,
                    places_crc=header.places_crc,
                )
                != header
            ):
                raise InputError(
                    f"{self.path / layout.HEADER} does not match the poses of the store; "
                    "place the store again"
                )
        self._own = column_header
        self.nodes = layout.read_nodes(self._folder, column_header)
        """(n,) records of `layout.NODE`: chunks and nodes of levels of detail, of one instance"""
        starts, shapes = self.nodes["first"], layout.shapes_of(column_header.sh_degree)
        self._columns = {
            name: layout.map_column(self._folder, name, kind, (column_header.rows, *shapes[name]), starts)
            for name, kind in column_header.columns.items()
        }
        if self.has_coplanar_groups:  # the host prepares coplanar splats, which must be valid
            rows = self._rows(column_header.pinned, column_header.splats, None)
            if wrong := _unrenderable(rows):
                raise InputError(
                    f"coplanar splats of {self._folder} must be valid, got {wrong}; build the store again"
                )
            if (rows["coplanar_groups"] < 0).any():
                raise InputError(
                    f"coplanar group ids of {self._folder} must be at least 0, got "
                    f"{int(rows['coplanar_groups'].min())}; build the store again"
                )

    def __reduce__(self):
        return Store, (str(self.path.absolute()),)

    def __len__(self) -> int:
        return self.header.splats

    def __repr__(self) -> str:
        instances = "" if self.poses is None else f", {len(self.poses)} instances"
        return f"Store({str(self.path)!r}, {len(self):,} splats{instances})"

    def summary(self) -> dict[str, str]:
        """Content of the store as text, by topic."""
        rows = {"splats": f"{len(self):,}", "chunks": f"{self.chunks:,}"}
        rows["colours"] = "plain" if self.sh_degree < 0 else f"SH of degree {self.sh_degree}"
        if self.poses is not None:
            rows["instances"] = f"{len(self.poses):,} of {self.header.store}"
        if len(self):
            rows["bounds"] = " to ".join(map(point, self.bounds())) + " m"
        return rows | {f"dropped: {why}": f"{n:,}" for why, n in self.header.dropped.items()}

    def facts(self) -> dict[str, Any]:
        """Content of the store as JSON values: splats, chunks, levels of detail, bytes, bounds."""
        header, nodes = self.header, self.nodes
        kinds = {"none": "2D", "all": "3D", "some": "2D and 3D"}
        facts = {"store": str(self.path), "splats": len(self), "kind": kinds[self.ellipsoids]}
        facts |= {"sh_degree": max(self.sh_degree, 0), "chunks": self.chunks, "instances": self.instances}
        facts |= {"instanced_store": header.store, "bytes": self.nbytes, "columns": dict(header.columns)}
        facts |= {"sources": list(header.sources), "left_out": dict(header.dropped), "levels": []}
        for level in np.unique(nodes["level"]).tolist():
            level_nodes = nodes[nodes["level"] == level]
            count = {"nodes": len(level_nodes), "splats": int(level_nodes["count"].sum())}
            row = {name: number * self.instances for name, number in count.items()}
            facts["levels"].append({"level": level, **row, "cell_m": float(np.median(level_nodes["size"]))})
        return facts | {"bounds": list(self.bounds()) if len(self) else None}

    # properties that select kernels (`CloudProperties`)

    @property
    def sh_degree(self) -> int:
        """Degree 0 to 3 of the SH colours, -1 for plain colours."""
        return self.header.sh_degree

    @property
    def has_coplanar_groups(self) -> bool:
        """Whether some splats belong to coplanar groups."""
        return "coplanar_groups" in self._own.columns

    @property
    def footprint(self) -> str:
        """Always `gaussian`: a store has no box splats."""
        return "gaussian"

    @property
    def ellipsoids(self) -> str:
        """Which splats are 3D Gaussians: `none`, `some` or `all`."""
        return self.header.ellipsoids

    @property
    def origin(self) -> np.ndarray:
        """(3,) float64 metres: world position that means are relative to."""
        return np.array(self.header.origin)

    @property
    def identity(self) -> str:
        """Hexadecimal digest of the content; for an instanced store followed by the bytes of its poses."""
        poses = "" if self.poses is None else self.poses.tobytes().hex()
        return self.header.identity + poses

    @property
    def instances(self) -> int:
        """Number of instances: 1 for a store with its own splats."""
        return 1 if self.poses is None else len(self.poses)

    @property
    def chunks(self) -> int:
        """Number of chunks of all instances."""
        return self.instances * int(np.count_nonzero(self.nodes["level"] == 0))

    @property
    def nbytes(self) -> int:
        """Bytes of the files; for an instanced store, of the other store's files."""
        return sum(file.stat().st_size for file in self._folder.iterdir() if file.is_file())

    @property
    def splat_bytes(self) -> int:
        """Bytes of a splat in memory."""
        shapes = layout.shapes_of(self.sh_degree)
        return sum(layout.row_bytes("<f4", shapes[name]) for name in {*self._own.columns, "labels"})

    def bounds(self, sigmas: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
        """Axis-aligned box (min (3,), max (3,)) float64, world, around all splats to `sigmas` standard
        deviations. Raises InputError for an empty store."""
        low, high = self.bounding_boxes(sigmas)
        leaves = np.tile(self.nodes["level"] == 0, self.instances)
        if not leaves.any():
            raise InputError("the store must have at least one splat to have bounds, got none")
        return low[leaves].min(axis=0) + self.origin, high[leaves].max(axis=0) + self.origin

    @cached_property
    def detail_errors(self) -> list[DetailErrors]:
        """Measured errors of the levels of detail; for an instanced store, those of the store it places."""
        return load_detail_errors(self._folder, self.header.identity)

    @property
    def levels(self) -> int:
        """Number of levels of detail above the chunks."""
        return int(self.nodes["level"].max(initial=0))

    def cell_sizes(self, quality: Quality) -> tuple[float, ...]:
        """Projected cell size [samples] below which cells of each level are rendered, from the quality's
        `detail_error`; 0: never. Raises InputError if the errors were not measured."""
        instance("quality", quality, Quality)
        if not self.levels:
            return (0.0,)  # no levels of detail: always exact
        measured = [detail for detail in self.detail_errors if detail.lowpass == quality.lowpass]
        if measured:
            return tuple(
                allowed_cell_size(measured, level, quality.detail_error) for level in range(self.levels + 1)
            )
        raise InputError(
            f"detail_error must be 0 for {self.path}, whose levels of detail were not measured with "
            f"lowpass={quality.lowpass}, got {quality.detail_error:g}; run `fidsplat store measure "
            f"{self._folder} --lowpass {quality.lowpass}`"
        )

    # nodes of all instances: node i of instance p has the number p * len(nodes) + i

    def bounding_boxes(self, sigmas: float) -> tuple[np.ndarray, np.ndarray]:
        """Minimum and maximum corners, (instances * nodes, 3) float64 [m] relative to the origin, of boxes
        around the splats of each node to `sigmas` standard deviations."""
        sigmas = checked_number("sigmas", sigmas, "a number of standard deviations, 0 to 1e6", 0.0, 1e6)
        nodes, fraction = self.nodes, min(sigmas / layout.FAR, 1.0)
        beyond = np.maximum(sigmas - layout.FAR, 0.0) * nodes["reach"].astype(np.float64)[:, None]
        # a box's extent is a convex function of the standard deviations: interpolation bounds it from above
        low = (1 - fraction) * nodes["low"].astype(np.float64) + fraction * nodes["far_low"] - beyond
        high = (1 - fraction) * nodes["high"].astype(np.float64) + fraction * nodes["far_high"] + beyond
        if self.poses is None:
            return low, high
        center, half = (low + high) / 2, (high - low) / 2
        rotations = self.poses[:, :3, :3]
        middles = center @ np.swapaxes(rotations, 1, 2) + self._offsets[:, None]
        low, high = _rounded(middles, half @ np.swapaxes(np.abs(rotations), 1, 2))
        return low.reshape(-1, 3), high.reshape(-1, 3)

    def instance_bounding_boxes(
        self, low: np.ndarray, high: np.ndarray, instances: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Boxes of the other store, given by corners (k, 3), each moved to the pose of an instance (k,)."""
        assert self.poses is not None
        rotations = self.poses[instances, :3, :3]
        center, half = (low + high) / 2, (high - low) / 2
        middles = np.einsum("kij,kj->ki", rotations, center) + self._offsets[instances]
        return _rounded(middles, np.einsum("kij,kj->ki", np.abs(rotations), half))

    @cached_property
    def _offsets(self) -> np.ndarray:
        """(p, 3) float64 metres: translation from the other store's means to each instance's."""
        assert self.poses is not None
        inner, outer = np.array(self._own.origin), self.origin
        return self.poses[:, :3, :3] @ inner + self.poses[:, :3, 3] - outer

    def first_of(self, numbers: np.ndarray) -> np.ndarray:
        """Index (k,) int64 in the complete scene of the first splat of each node; -1 for merged splats (of
        levels of detail). numbers: (k,) numbers of nodes."""
        instance, node = np.divmod(self._checked(numbers), max(len(self.nodes), 1))
        records = self.nodes[node]
        return np.where(records["level"] == 0, records["first"] + instance * self._own.splats, -1)

    def counts(self, numbers: np.ndarray) -> np.ndarray:
        """Numbers of splats (k,) of nodes, by number."""
        return self.nodes["count"][self._checked(numbers) % max(len(self.nodes), 1)]

    def _checked(self, numbers: np.ndarray) -> np.ndarray:
        """Numbers of nodes (k,) as int64. Raises InputError if one does not exist."""
        values, count = real_array("numbers", numbers), self.instances * len(self.nodes)
        if not ((values == np.rint(values)) & (values >= 0) & (values < count)).all():
            raise invalid("numbers", f"whole numbers of nodes, 0 to {count - 1}", numbers)
        return values.astype(np.int64)

    def load(self, number: int, placed: bool = True) -> dict[str, np.ndarray]:
        """Splats of a node, by number, as arrays of a cloud relative to `origin`.

        placed: whether to apply the pose of the instance.
        """
        last = self.instances * len(self.nodes) - 1
        flag("placed", placed)
        instance, node = divmod(whole_number("the number of a node", number, 0, last), len(self.nodes))
        first = int(self.nodes["first"][node])
        return self._rows(first, first + int(self.nodes["count"][node]), instance if placed else None)

    @cached_property
    def pose_rows(self) -> np.ndarray:
        """(p, 16) float64: poses in the layout of `Chunk.pose`; (0, 16) if the store is not instanced."""
        if self.poses is None:
            return np.empty((0, 16))
        rotations = self.poses[:, :3, :3]
        quats = np.stack([matrix_to_quaternion(rotation) for rotation in rotations])
        return np.concatenate([rotations.reshape(-1, 9), self._offsets, quats], axis=1)

    def labels(self) -> set[int]:
        """All labels of the splats. Reads the complete column."""
        if "labels" not in self._columns:
            return {0} if len(self) else set()
        labels: set[int] = set()
        for node in self.nodes[self.nodes["level"] == 0]:  # by chunks, for bounded memory
            rows = self._columns["labels"][node["first"] : node["first"] + node["count"]]
            labels.update(np.unique(rows).tolist())
        return labels

    def last_group(self) -> int:
        """Largest coplanar group id; -1 without groups."""
        if not self.has_coplanar_groups:
            return -1
        return int(self._columns["coplanar_groups"][self._own.pinned : self._own.splats].max(initial=-1))

    def cloud(self) -> SplatCloud:
        """All splats in one cloud, memory-mapped if possible; its frames are bit-identical to the store's."""
        parts = [self._rows(0, self._own.splats, instance) for instance in range(self.instances)]
        return PartialCloud.of(concatenated(parts), self, self.header.dropped)

    def verify(self, progress: Progress | None = None) -> list[str]:
        """Check the checksums and the values of all chunks, and return a description of each defect."""
        callback("progress", progress)
        wrong = []
        for number, node in enumerate(self.nodes):
            first, end = int(node["first"]), int(node["first"] + node["count"])
            rows = {name: array[first:end] for name, array in self._columns.items()}
            kind = "chunk" if node["level"] == 0 else "node"
            if layout.checksum(rows) != node["crc"]:
                wrong.append(f"{kind} {number}, rows {first} to {end - 1}, is damaged: its checksum differs")
            elif values := _unrenderable(rows, merged=node["level"] > 0):
                wrong.append(f"{kind} {number}, rows {first} to {end - 1}, has splats with {values}")
            if progress is not None:
                progress(f"checking {self.path.name}", (number + 1) / len(self.nodes))
        return wrong

    def _rows(self, first: int, end: int, instance: int | None) -> dict[str, np.ndarray]:
        """Splats of rows [first, end) at the pose of an instance; None: as stored."""
        splats = {name: array[first:end] for name, array in self._columns.items()}
        for name in {"sh", "colors"} & set(splats):
            splats[name] = splats[name].astype(np.float32, copy=False)
        if "labels" not in splats:
            splats["labels"] = np.zeros(end - first, np.int32)
        if self.poses is None or instance is None:
            return splats
        return transformed(splats, self.poses[instance, :3, :3], self._offsets[instance])


def _unrenderable(rows: dict[str, np.ndarray], merged: bool = False) -> str:
    """Describe invalid values and their counts; empty if there are none. merged: opacities may exceed 1."""
    names = rows.keys() - {"labels", "coplanar_groups"}
    _, defects = find_defects({name: rows[name].astype(np.float32, copy=False) for name in names})
    if merged:
        defects.pop("opacity outside [0, 1]", None)
    if "thickness" in rows and (thin := int((rows["thickness"] < 0).sum())):
        defects["thickness below 0"] = thin
    return ", ".join(f"{reason}: {count}" for reason, count in defects.items())


def _rounded(middles: np.ndarray, around: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimum and maximum corners of boxes, padded by 1e-6 for the rounding of centres to float32."""
    around = around + 1e-6 * (np.abs(middles) + around)
    return middles - around, middles + around


def _read_poses(folder: Path, crc: int | None) -> np.ndarray:
    try:
        poses = load_npy(folder / layout.PLACES)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{folder / layout.PLACES} cannot be read ({error}); place the store again"
        ) from None
    shaped = poses.dtype == np.float64 and poses.ndim == 3 and poses.shape[1:] == (4, 4) and len(poses) > 0
    if not shaped or zlib.crc32(poses.tobytes()) != crc:
        raise InputError(f"{folder / layout.PLACES} is damaged; place the store again")
    for pose in poses:
        check_similarity(pose, f"a pose of {folder / layout.PLACES}", rigid=True)
    return poses
