"""Streamed SOG of PlayCanvas: lod-meta.json, a tree of boxes. Each leaf has levels of detail, each level a
range of splats of a SOG folder; level 0 is the finest. Format: developer.playcanvas.com, "Streamed SOG".
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.formats.plain import neighbour
from fidsplat.formats.sog import load_sog_folder, save_sog_folder
from fidsplat.splats.arrays import all_scales
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import InputError, damaged_data
from fidsplat.util.files import from_json, read_input, writable_folder, write_json
from fidsplat.util.limits import check_total

META = "lod-meta.json"
_MAX_META, _MAX_LEVELS = 2**26, 64
_SPLAT = 300
"""bytes of memory per splat that is read"""
_UNIT = 2**19
"""target number of splats per SOG folder; a larger leaf has its own folder"""


@dataclass(frozen=True)
class Span:
    """Range of splats in a file. file: index of `StreamedSog.files`."""

    file: int
    first: int
    count: int


@dataclass(frozen=True, eq=False)
class StreamedSog:
    """Content of a lod-meta.json."""

    path: Path
    levels: int
    files: tuple[Path, ...]
    leaves: tuple[dict[int, Span], ...]
    """ranges by level, for each leaf of the tree"""
    environment: Path | None

    def check_memory(self) -> None:
        """Raise InputError if the splats of all levels take more than half of the machine's memory."""
        count = sum(span.count for leaf in self.leaves for span in leaf.values())
        check_total(f"{self.path} with {count:,} splats", count * _SPLAT, "read a scene of fewer splats")

    def load(self, level: int) -> Iterator[tuple[int, SplatCloud]]:
        """Index and splats of each leaf that has a level, file by file."""
        of_level = [(leaf[level], number) for number, leaf in enumerate(self.leaves) if level in leaf]
        order = sorted(of_level, key=lambda pair: (pair[0].file, pair[0].first))
        for file, group in groupby(order, key=lambda pair: pair[0].file):
            cloud = load_sog_folder(self.files[file])
            for span, number in group:
                yield number, self._part(cloud, span)

    def _part(self, cloud: SplatCloud, span: Span) -> SplatCloud:
        path = self.files[span.file]
        if cloud.dropped:
            raise InputError(
                f"{path} must have valid splats, got {sum(cloud.dropped.values())} invalid ones; write the "
                "file again with splat-transform, which can drop them"
            )
        if span.first + span.count > len(cloud):
            raise InputError(
                f"{self.path}: a range of {path.name} must end by splat {len(cloud)}, got "
                f"{span.first + span.count}"
            )
        rows = slice(span.first, span.first + span.count)
        assert cloud.sh is not None
        shapes = cloud.means[rows], cloud.quats[rows], all_scales(cloud)[rows]
        return SplatCloud(*shapes, cloud.opacities[rows], sh=cloud.sh[rows])


def read_streamed(path: Path) -> StreamedSog:
    """Read a lod-meta.json without its splats. Raises InputError for a damaged file or another version."""
    with damaged_data(f"{path}: the streamed SOG"):
        meta = from_json(read_input(path, _MAX_META))
        if meta.get("version", 1) != 1:
            raise InputError(
                f"{path}: the version of streamed SOG must be 1, got {meta['version']!r}; convert it with "
                "splat-transform"
            )
        levels = int(meta["lodLevels"])
        if not 1 <= levels <= _MAX_LEVELS:
            raise InputError(f"{path}: lodLevels must be 1 to {_MAX_LEVELS}, got {levels}")
        files = tuple(neighbour(path, name) for name in meta["filenames"])
        environment = neighbour(path, meta["environment"]) if meta.get("environment") else None
        leaves = tuple(_leaves(path, meta["tree"], levels, len(files)))
    if not any(0 in leaf for leaf in leaves):
        raise InputError(f"{path} must have splats of level 0, got none")
    return StreamedSog(path, levels, files, leaves, environment)


def _leaves(path: Path, tree: dict[str, Any], levels: int, files: int) -> Iterator[dict[int, Span]]:
    todo = [tree]
    while todo:
        node = todo.pop()
        todo += reversed(node.get("children") or [])
        spans = {}
        for name, entry in (node.get("lods") or {}).items():
            level, span = int(name), Span(*(int(entry[key]) for key in ("file", "offset", "count")))
            if not (0 <= level < levels and 0 <= span.file < files and min(span.first, span.count) >= 0):
                raise InputError(
                    f"{path}: a leaf must refer to levels below {levels} and files below {files}, got {entry}"
                )
            if span.count:
                spans[level] = span
        if spans:
            yield spans


def load_streamed(path: Path) -> SplatCloud:
    """Read level 0 and the environment of a streamed SOG. Raises InputError for damaged files."""
    scene = read_streamed(path)
    scene.check_memory()
    clouds = dict(scene.load(0))
    parts = [clouds[number] for number in sorted(clouds)]
    if scene.environment is not None:
        parts.append(load_sog_folder(scene.environment))
    return SplatCloud.concatenate(parts)


def save_streamed(
    path: Path, leaves: Sequence[tuple[np.ndarray, Sequence[Sequence[SplatCloud]]]], levels: int
) -> None:
    """Write a streamed SOG next to `path`. leaves: box (2, 3) and clouds of each level, for each leaf.

    Raises InputError for a file that cannot be written.
    """
    files: list[str] = []
    children: list[dict[str, Any]] = [
        {"bound": {"min": box[0].tolist(), "max": box[1].tolist()}, "lods": {}} for box, _ in leaves
    ]
    counts = [0] * levels
    for level in range(levels):
        clouds: list[SplatCloud] = []

        def finish(level: int = level, clouds: list[SplatCloud] = clouds) -> None:
            file = f"{level}_{sum(name.startswith(f'{level}_') for name in files)}/meta.json"
            files.append(file)
            target = path.parent / file
            writable_folder(target.parent)
            save_sog_folder(SplatCloud.concatenate(clouds), target)
            clouds.clear()

        for child, (_, of_levels) in zip(children, leaves, strict=True):
            if level >= len(of_levels):
                continue
            first, count = sum(map(len, clouds)), sum(map(len, of_levels[level]))
            if clouds and first + count > _UNIT:
                finish()
                first = 0
            child["lods"][str(level)] = {"file": len(files), "offset": first, "count": count}
            counts[level] += count
            clouds += of_levels[level]
        if clouds:
            finish()
    boxes = np.array([box for box, _ in leaves])
    bound = {"min": boxes[:, 0].min(axis=0).tolist(), "max": boxes[:, 1].max(axis=0).tolist()}
    document = {
        "version": 1,
        "asset": {"generator": "fidsplat"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": levels,
        "environment": None,
        "filenames": files,
        "tree": children[0] if len(children) == 1 else {"bound": bound, "children": children},
    }
    write_json(path, document)
