"""Small stores with as many chunks and buckets as large ones."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.store import build, build_plan

COUNT = 9_000
SMALL = {"chunk": 500, "memory": 1 << 20}
WINDOW, NOTED = 1000, 3


def two_files(folder: Path) -> list[Path]:
    """Files of COUNT splats each: SH of degree 1 and coplanar groups; labels and 3D Gaussians."""
    first = random_splats(COUNT, 1, sh_degree=1).with_labels(0)
    first = first.with_coplanar_groups(np.where(np.arange(COUNT) % 1000 < 3, np.arange(COUNT) // 3000, -1))
    fs.save_ply(first, folder / "a.ply")
    other = random_splats(COUNT, 2)
    third = (
        other.scales.max(axis=1) * np.array([0.0, 0.1, 2.0])[np.arange(COUNT) % 3]
    )  # also the longest axis
    other = fs.SplatCloud(
        other.means + np.array([5.0, 0, 0]),
        other.quats,
        np.column_stack([other.scales, third]),
        other.opacities,
        colors=other.colors,
        labels=other.labels,
    )
    fs.save_ply(other, folder / "b.ply")
    return [folder / "a.ply", folder / "b.ply"]


def store_fixtures() -> tuple[Any, Any, Any]:
    """Fixtures: builds with many buckets and frequent saves; two files; their store."""

    @pytest.fixture(scope="module", autouse=True)
    def cut():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(build_plan, "_MIN_MEMORY", 0)
            patch.setattr(build_plan, "_MERGE_BYTES", (0, 0.01))
            patch.setattr(build_plan, "WINDOW", WINDOW)
            patch.setattr(build, "_SAVE_EVERY", NOTED)
            yield

    @pytest.fixture(scope="module")
    def files(tmp_path_factory):
        return two_files(tmp_path_factory.mktemp("splats"))

    @pytest.fixture(scope="module")
    def store(cut, files, tmp_path_factory):
        return fs.Store(fs.build_store(files, tmp_path_factory.mktemp("store") / "both.fss", **SMALL))

    return cut, files, store


def contents(folder: Path) -> dict[str, bytes]:
    """Content of the files of a folder, by name."""
    return {file.name: file.read_bytes() for file in folder.iterdir()}
