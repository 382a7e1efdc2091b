"""Column files and node records of a store during its build."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from fidsplat.store.layout import FAR, NODE, NPY_HEADER, checksum, column_file, row_bytes


class ColumnFiles:
    """Column files, written and read by rows in any order. Thread-safe."""

    def __init__(self, folder: Path, kinds: dict[str, str], shapes: dict[str, tuple[int, ...]]) -> None:
        self._folder, self.kinds, self._shapes = folder, kinds, shapes
        self._files: dict[str, int] = {}

    def __enter__(self) -> ColumnFiles:
        for name in self.kinds:
            file = column_file(self._folder, name)
            self._files[name] = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        return self

    def __exit__(self, *_: object) -> None:
        while self._files:
            os.close(self._files.popitem()[1])

    def write(self, first: int, splats: dict[str, np.ndarray]) -> None:
        """Write splats to rows from `first` on."""
        for name, descriptor in self._files.items():
            data = np.ascontiguousarray(splats[name]).view(np.uint8).reshape(-1).data
            at = NPY_HEADER + first * self._row(name)
            while data:
                written = os.pwrite(descriptor, data, at)
                data, at = data[written:], at + written

    def read(self, first: int, end: int) -> dict[str, np.ndarray]:
        """Read the splats of rows [first, end)."""
        splats = {}
        for name, descriptor in self._files.items():
            row = self._row(name)
            array = np.empty((end - first, *self._shapes[name]), self.kinds[name])
            view, at = array.view(np.uint8).reshape(-1).data, NPY_HEADER + first * row
            while view:
                got = os.preadv(descriptor, [view], at)
                if not got:
                    raise OSError(f"{column_file(self._folder, name)} ends before row {end}")
                view, at = view[got:], at + got
            splats[name] = array
        return splats

    def finish(self, name: str, header: bytes, rows: int) -> None:
        """Write the header of a column and truncate the file after its rows."""
        os.pwrite(self._files[name], header, 0)
        os.ftruncate(self._files[name], NPY_HEADER + rows * self._row(name))

    def _row(self, name: str) -> int:
        return row_bytes(self.kinds[name], self._shapes[name])


def node_record(splats: dict[str, np.ndarray], first: int) -> np.ndarray:
    """(1,) of `NODE`: the record of a chunk whose splats begin at row `first`."""
    node = np.zeros(1, NODE)
    means, largest = splats["means"], splats["scales"].max(axis=1)
    if "thickness" in splats:
        largest = np.maximum(largest, splats["thickness"])
    node["first"], node["count"], node["parent"], node["crc"] = first, len(means), -1, checksum(splats)
    # the boxes are rounded outwards
    far = np.float32(FAR * 1.0001) * largest[:, None]
    node["reach"] = np.nextafter(largest.max(), np.float32(np.inf))
    node["low"], node["high"] = means.min(axis=0), means.max(axis=0)
    below, above = (means - far).min(axis=0), (means + far).max(axis=0)
    node["far_low"] = np.nextafter(below, np.float32(-np.inf))
    node["far_high"] = np.nextafter(above, np.float32(np.inf))
    return node


def enclose(node: np.ndarray, children: np.ndarray) -> None:
    """Extend a node's box and sizes to include its children, so that culling a node also culls them."""
    node["size"] = max(float(node["size"][0]), float(children["size"].max()))
    for name in ("low", "far_low"):
        node[name] = np.minimum(node[name], children[name].min(axis=0))
    for name in ("high", "far_high"):
        node[name] = np.maximum(node[name], children[name].max(axis=0))
    node["reach"] = max(float(node["reach"][0]), float(children["reach"].max()))
