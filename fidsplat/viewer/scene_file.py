"""Editor of scene files: writes a pose or a new marker, and keeps all other lines."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fidsplat.splats.rotations import matrix_to_quaternion, rigid_matrix
from fidsplat.store.layout import SUFFIX as STORE
from fidsplat.util.errors import InputError
from fidsplat.util.files import read_input, write_file

_HEAD = re.compile(r"^[ \t]*\[.*$", re.MULTILINE)
_TABLES = {
    kind: re.compile(rf"^[ \t]*\[\[[ \t]*{kind}[ \t]*\]\][ \t]*(?:#.*)?$") for kind in ("markers", "splats")
}
_NAMES = {"markers": "marker", "splats": "splat file"}
_IDENTITY = (1.0, 0.0, 0.0, 0.0)
DIGITS = 9
"""decimal digits of metres and quaternions in the file"""


class SplatFile(NamedTuple):
    """A splat file of a scene."""

    table: int
    """index of its [[splats]] table"""
    file: str
    pose: np.ndarray
    """(4, 4) pose of the file's frame, without scale"""


class SceneFile:
    """A scene file on disk."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.text = self._read()
        """text of the displayed scene; a file with another text is not written"""
        self._last_read = self.text

    def changed(self) -> str | None:
        """The text if another program has changed it since the last call, or else None."""
        text = self._read()
        known, self._last_read = self._last_read, text
        return None if text == known else text

    def splat_files(self) -> list[SplatFile]:
        """Splat files in the order of the scene's clouds; stores cannot be moved."""
        tables = (_parsed(self.text) or {}).get("splats", ())
        return [
            SplatFile(
                k,
                table["file"],
                rigid_matrix(table.get("position", (0, 0, 0)), table.get("quaternion", _IDENTITY)),
            )
            for k, table in enumerate(tables)
            if not table["file"].lower().endswith(STORE)
        ]

    def write_pose(self, number: int, pose: np.ndarray, kind: str = "markers") -> None:
        """Write the pose (4, 4) of a table, by its index among the markers or splats.

        Raises:
            InputError: the file has changed, cannot be written, or has no plain table of that index.
        """
        self._write(with_pose(self.text, number, pose, str(self.path), kind))

    def add_marker(self, block: str) -> None:
        """Append a [[markers]] table.

        Raises:
            InputError: the file has changed, cannot be written, or declares its markers in another way.
        """
        self._write(with_marker(self.text, block, str(self.path)))

    def _write(self, text: str) -> None:
        if self._read() != self.text:
            raise InputError(
                f"{self.path} was edited by another program; it is loaded again, and nothing was written"
            )
        write_file(self.path.resolve(), text)  # preserves symbolic links
        self.text = self._last_read = text

    def _read(self) -> str:
        return read_input(self.path).decode("utf-8", "replace")


def with_pose(text: str, number: int, pose: np.ndarray, name: str, kind: str = "markers") -> str:
    """Text of a scene file with another pose (4, 4) of a table, by its index among the markers or splats.

    Raises:
        InputError: no plain table of that index; the message names the file.
    """
    position = [round(float(v), DIGITS) + 0.0 for v in pose[:3, 3]]
    quaternion = [round(float(v), DIGITS) + 0.0 for v in matrix_to_quaternion(pose[:3, :3])]
    heads = list(_HEAD.finditer(text))
    tables = [k for k, head in enumerate(heads) if _TABLES[kind].match(head[0])]
    new = text
    if number < len(tables):
        k = tables[number]
        end = heads[k + 1].start() if k + 1 < len(heads) else len(text)
        table = text[heads[k].end() : end]
        for key, values in (("position", position), ("quaternion", quaternion)):
            table = _with(table, key, values)
        new = text[: heads[k].end()] + table + text[end:]
    if _parsed(new) != _expected(text, kind, number, position, quaternion):
        raise InputError(
            f"{name}: {_NAMES[kind]} {number} must be a plain [[{kind}]] table, got another form; write "
            f"position = {position}, quaternion = {quaternion} there yourself"
        )
    return new


def with_marker(text: str, block: str, name: str) -> str:
    """Text of a scene file with one more [[markers]] table at its end.

    Raises:
        InputError: the file declares its markers in another way; the message names it.
    """
    new = f"{text.rstrip()}\n\n{block}" if text.strip() else block
    before, table, after = (_parsed(content) for content in (text, block, new))
    if before is None or after != before | {"markers": [*before.get("markers", ()), *table["markers"]]}:
        lines = ", ".join(line for line in block.splitlines()[1:] if line)
        raise InputError(f"{name}: markers must be [[markers]] tables; write there yourself: {lines}")
    return new


def _with(table: str, key: str, values: list[float]) -> str:
    line = f"{key} = {values}"
    pattern = re.compile(rf"^([ \t]*){key}[ \t]*=[ \t]*\[[^\]]*\]", re.MULTILINE)
    if pattern.search(table):
        return pattern.sub(lambda found: found[1] + line, table, count=1)
    return f"\n{line}{table}"


def _parsed(text: str) -> Any:
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))
    except (ValueError, RecursionError):
        return None


def _expected(text: str, kind: str, number: int, position: list[float], quaternion: list[float]) -> Any:
    """The content that the edited text must have; if the table does not exist, a value that differs from all
    contents."""
    scene = _parsed(text)
    try:
        scene[kind][number] |= {"position": position, "quaternion": quaternion}
    except (TypeError, KeyError, IndexError):
        return {}, number
    return scene
