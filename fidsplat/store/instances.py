"""Instanced stores (scenes in chunks on disk): splats of another store at many poses, without copies."""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fidsplat.splats.rotations import check_similarity, pose_matrix
from fidsplat.store.layout import MAX_SPLATS, PLACES
from fidsplat.store.staging import check_replaceable, clear, staged, store_folder
from fidsplat.store.store import Store
from fidsplat.util.arguments import real_array
from fidsplat.util.errors import InputError
from fidsplat.util.npy import save_npy


def grid_poses(counts: Sequence[int], pitch: Sequence[float]) -> list[np.ndarray]:
    """Poses (4, 4) on a grid along the world's axes; the first is the identity.

    counts: numbers of instances along x, y, z. pitch: distances between them [m].
    """
    if math.prod(counts) > 10_000_000:
        raise InputError(f"a grid must have at most 10,000,000 instances, got {' x '.join(map(str, counts))}")
    steps = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    poses = np.tile(np.eye(4), (len(steps), 1, 1))
    poses[:, :3, 3] = steps * np.asarray(pitch)
    return list(poses)


def place_store(
    store: Store | str | os.PathLike[str],
    out: str | os.PathLike[str],
    poses: Sequence,
    *,
    overwrite: bool = False,
) -> Path:
    """Write a store with instances of another store at many poses, and return its folder.

    The instanced store contains the poses and the relative path of the other store.

    Args:
        store: the store to repeat; it must not be instanced itself.
        out: the new store's folder; its name ends with .fss.
        poses: p rigid matrices (4, 4), or pairs (position, quaternion): the transform of each instance in the
            world.
        overwrite: whether an existing store is replaced.

    Raises:
        InputError: a pose that is not rigid; no pose; an instanced store, or one with coplanar groups; an
            existing store.
    """
    source = store if isinstance(store, Store) else Store(store)
    if source.poses is not None:
        raise InputError(
            f"{source.path} must not have instances itself, got an instanced store; place "
            f"{source.header.store} instead"
        )
    if source.has_coplanar_groups:
        raise InputError(
            f"a store to be instanced must have no coplanar groups (markers), got {source.path}; build it "
            "without markers, and put these into a scene file"
        )
    try:
        matrices = np.stack([real_array("a pose", pose_matrix(pose, "a pose")) for pose in poses])
    except (TypeError, ValueError):
        matrices = np.empty(0)
    if matrices.ndim != 3 or not len(matrices):
        raise InputError(f"poses must be a list of at least one rigid 4x4 matrix, got {str(poses)[:80]}")
    for number, pose in enumerate(matrices):
        check_similarity(pose, f"pose {number}", rigid=True)
    if len(matrices) * len(source) > MAX_SPLATS:
        raise InputError(
            f"a scene must have at most {MAX_SPLATS:,} splats, got {len(matrices)} times {len(source):,}"
        )
    folder = store_folder(out)
    check_replaceable(folder, overwrite)
    with staged(folder) as part:
        clear(part)
        save_npy(part / PLACES, matrices)
        header = replace(
            source.header,
            splats=len(source) * len(matrices),
            rows=source.header.rows * len(matrices),
            store=os.path.relpath(source.path.resolve(), folder.resolve()),
            places_crc=zlib.crc32(matrices.tobytes()),
        )
        header.save(part)
    return folder
