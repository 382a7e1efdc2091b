"""Conversion between stores and streamed SOG, with levels of detail."""

from __future__ import annotations

import os
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

import numpy as np

from fidsplat.formats.sog_streamed import META, read_streamed, save_streamed
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import colors_of_degree
from fidsplat.store.build_plan import MAX_CHUNK
from fidsplat.store.columns import ColumnFiles, enclose, node_record
from fidsplat.store.layout import Header, npy_header, shapes_of, write_nodes
from fidsplat.store.staging import staged
from fidsplat.store.store import Store
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of
from fidsplat.util.progress import Progress

_LEAF = 2**18
"""maximum splats of a leaf of streamed SOG, unless a chunk has more"""
_GRID = 64
"""number of grid cells along the largest extent, for the estimated area of a scene"""


def is_streamed(inputs: object) -> bool:
    """Whether the inputs of a store are a single streamed SOG."""
    if isinstance(inputs, Sequence) and not isinstance(inputs, str) and len(inputs) == 1:
        inputs = inputs[0]
    return isinstance(inputs, (str, os.PathLike)) and path_of(inputs).name.lower() == META


def import_streamed(path: Path, folder: Path, progress: Progress) -> None:
    """Write a store with the chunks and levels of a streamed SOG; raise InputError for an environment."""
    scene = read_streamed(path)
    scene.check_memory()
    if scene.environment is not None:
        raise InputError(
            f"{path} must have no environment for a store, got {scene.environment}; add it to a scene file "
            "next to it"
        )
    depths = [next(k for k in range(scene.levels + 1) if k not in leaf) for leaf in scene.leaves]
    clouds = [dict(scene.load(level)) for level in range(max(depths))]
    degree = max(cloud.sh_degree for level in clouds for cloud in level.values())
    columns = {name: "<f4" for name in ("means", "quats", "scales", "opacities", "sh", "thickness")}
    area = _area(np.concatenate([cloud.means for cloud in clouds[0].values()]))
    nodes, rows = [], 0
    with staged(folder) as part, ColumnFiles(part, columns, shapes_of(degree)) as files:
        of_node: list[tuple[int, int]] = []  # leaf and level
        for level, of_level in enumerate(clouds):
            size = np.sqrt(area / sum(map(len, of_level.values()))) if level else 0.0
            for number in sorted(of_level):
                if level >= depths[number]:
                    continue
                interrupts.check()
                arrays = _arrays(of_level[number], degree)
                step = MAX_CHUNK if level == 0 else len(of_level[number])
                for first in range(0, len(of_level[number]), step):
                    rows_of = {name: arrays[name][first : first + step] for name in columns}
                    node = node_record(rows_of, rows)
                    node["level"], node["size"] = level, size
                    files.write(rows, rows_of)
                    rows += len(rows_of["means"])
                    nodes.append(node)
                    of_node.append((number, level))
                progress("write the store", level / len(clouds))
        records = np.concatenate(nodes)
        place = {(number, level): k for k, (number, level) in enumerate(of_node)}
        for k, (number, level) in enumerate(of_node):
            records["parent"][k] = place.get((number, level + 1), -1)
        for k in np.argsort(records["level"], kind="stable"):
            if (above := records["parent"][k]) >= 0:
                enclose(records[above : above + 1], records[k : k + 1])
        for name, kind in columns.items():
            files.finish(name, npy_header(kind, (rows, *shapes_of(degree)[name])), rows)
        chunks = records["level"] == 0
        Header(
            splats=int(records["count"][chunks].sum()),
            rows=rows,
            pinned=int(records["count"][chunks].sum()),
            chunk=int(records["count"][chunks].max()),
            origin=(0.0, 0.0, 0.0),
            sh_degree=degree,
            columns=columns,
            ellipsoids="some",
            nodes_crc=write_nodes(part, records),
            identity=sha256(records.tobytes()).hexdigest(),
            sources=(path.name,),
        ).save(part)


def _arrays(cloud: SplatCloud, degree: int) -> dict[str, np.ndarray]:
    thickness = np.zeros(len(cloud), np.float32) if cloud.thickness is None else cloud.thickness
    columns = {"means": cloud.means, "sh": cloud.sh}
    return {
        "means": cloud.means.astype(np.float32),
        "quats": cloud.quats,
        "scales": cloud.scales,
        "opacities": cloud.opacities,
        "thickness": thickness,
    } | colors_of_degree({name: array for name, array in columns.items() if array is not None}, degree)


def _area(means: np.ndarray) -> float:
    """Approximate area [m2] of the surfaces of a scene: faces of the occupied cells of a grid."""
    low = means.min(axis=0)
    edge = max(float((means.max(axis=0) - low).max()) / _GRID, 1e-9)
    return len(np.unique(((means - low) / edge).astype(np.int64), axis=0)) * edge * edge


def export_streamed(store: Store, path: Path) -> None:
    """Write a store as streamed SOG with its levels, at the path of lod-meta.json.

    A leaf of the file is a node of the store that represents at most 262,144 splats. Coarser levels, coplanar
    groups and labels are omitted. Raises InputError for an instanced store.
    """
    if store.poses is not None:
        raise InputError(
            f"a store written as streamed SOG must have no instances, got {len(store.poses):,}; write the "
            "store of which they are instances"
        )
    nodes, origin = store.nodes, np.array(store.origin)
    level, parent = nodes["level"], nodes["parent"]
    scene = np.where(level == 0, nodes["count"], 0).astype(np.int64)
    for k in np.argsort(level, kind="stable"):
        if parent[k] >= 0:
            scene[parent[k]] += scene[k]
    small = (scene <= _LEAF) | (level == 0)
    tops = np.flatnonzero(small & ((parent < 0) | ~small[parent]))
    children: dict[int, list[int]] = {}
    for k, above in enumerate(parent.tolist()):
        children.setdefault(above, []).append(k)
    leaves, levels = [], 1
    for top in tops.tolist():
        of_levels, row = [], [top]
        while row:
            of_levels.append(row)
            row = [below for k in row for below in children.get(k, [])]
        of_levels.reverse()
        levels = max(levels, len(of_levels))
        box = np.array([nodes["far_low"][top], nodes["far_high"][top]], np.float64) + origin
        leaves.append((box, [[_cloud(store, k, origin) for k in row] for row in of_levels]))
    save_streamed(path, leaves, levels)


def _cloud(store: Store, number: int, origin: np.ndarray) -> SplatCloud:
    rows = store.load(number)
    colors = {name: rows[name] for name in ("sh", "colors") if name in rows}
    scales = rows["scales"]
    if "thickness" in rows:
        scales = np.column_stack([scales, rows["thickness"]])
    opacities = np.minimum(rows["opacities"], 1.0)  # merged splats may exceed 1
    return SplatCloud(rows["means"], rows["quats"], scales, opacities, origin=origin, **colors)
