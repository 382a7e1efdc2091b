"""Stores of places: another store's splats many times, without their bytes."""

from __future__ import annotations

import os
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fidsplat.splats.rotations import check_similarity
from fidsplat.store.folders import emptied, filled, refuse_existing, store_folder
from fidsplat.store.layout import MAX_SPLATS, PLACES
from fidsplat.store.store import Store
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write
from fidsplat.util.scalars import real_array


def place_store(
    store: Store | str | os.PathLike[str],
    out: str | os.PathLike[str],
    poses: Sequence,
    *,
    overwrite: bool = False,
) -> Path:
    """Write a store that has another's splats at many places, and return its folder: it holds the poses
    alone, and names the other by the way to it.

    Args:
        store: what stands there; no store of places itself.
        out: the new store's folder; its name ends with .fss.
        poses: (p, 4, 4), rigid: the motion of the world that takes the store's splats to each place.
        overwrite: whether a store that is there is replaced.

    Raises:
        InputError: a pose that is not rigid; no pose; a store of places, or with printed planes; a store that
            is there.
    """
    source = store if isinstance(store, Store) else Store(store)
    if source.poses is not None:
        raise InputError(f"{source.path} is a store of places itself; place {source.header.store} instead")
    if source.has_planes:
        raise InputError(
            f"{source.path} has splats that are printed on planes, which are placed once; put markers into a "
            "scene file"
        )
    try:
        given = np.stack([real_array("a pose", pose) for pose in poses])
    except (TypeError, ValueError):
        given = np.empty(0)
    if given.ndim != 3 or not len(given):
        raise InputError("poses must be a list of rigid 4x4 matrices, one at least")
    for number, pose in enumerate(given):
        check_similarity(pose, f"pose {number}", rigid=True)
    if len(given) * len(source) > MAX_SPLATS:
        raise InputError(
            f"{len(given)} places of {len(source):,} splats are too many: a scene has at most {MAX_SPLATS:,}"
        )
    folder = store_folder(out)
    refuse_existing(folder, overwrite)
    with filled(folder) as part:
        emptied(part)  # of a build that was stopped
        with atomic_write(part / PLACES) as stream:
            np.save(stream, given)
        header = replace(
            source.header,
            splats=len(source) * len(given),
            rows=source.header.rows * len(given),
            store=os.path.relpath(source.path.resolve(), folder.resolve()),
            places_crc=zlib.crc32(given.tobytes()),
        )
        header.save(part)
    return folder
