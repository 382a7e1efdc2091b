"""A marker or a splat file that was moved goes back into its scene file: two lines change, all else stays as
it was written."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fidsplat.splats.rotations import matrix_to_quaternion, rigid_matrix
from fidsplat.store.layout import SUFFIX as STORE
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write, read_input

_HEAD = re.compile(r"^[ \t]*\[.*$", re.MULTILINE)
_TABLES = {
    kind: re.compile(rf"^[ \t]*\[\[[ \t]*{kind}[ \t]*\]\][ \t]*(?:#.*)?$") for kind in ("markers", "splats")
}
_WORDS = {"markers": "marker", "splats": "splat file"}
_STILL = (1.0, 0.0, 0.0, 0.0)
DIGITS = 9
"""of metres and quaternions in the file: nanometres"""


class Body(NamedTuple):
    """A splat file of a scene file."""

    table: int
    """number of its [[splats]]"""
    file: str
    pose: np.ndarray
    """(4, 4) where the file's frame lies, without its scale"""


class SceneFile:
    """A scene file on disk."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.text = self._read()
        """that of the scene which is shown: it alone is written back"""
        self._seen = self.text

    def changed(self) -> str | None:
        """What it holds now, if somebody else has written it since this was last asked."""
        text = self._read()
        known, self._seen = self._seen, text
        return None if text == known else text

    def bodies(self) -> list[Body]:
        """The splat files, in the order of the scene's clouds; stores stay where they were built."""
        tables = (_parsed(self.text) or {}).get("splats", ())
        return [
            Body(
                k,
                table["file"],
                rigid_matrix(table.get("position", (0, 0, 0)), table.get("quaternion", _STILL)),
            )
            for k, table in enumerate(tables)
            if not table["file"].lower().endswith(STORE)
        ]

    def place(self, number: int, pose: np.ndarray, kind: str = "markers") -> None:
        """Write the pose (4, 4) of table number, counted from 0, of the markers or splats.

        Raises:
            InputError: the file has changed meanwhile, cannot be written, or has its tables in a form in
                which their poses are not found.
        """
        if self._read() != self.text:
            raise InputError(f"{self.path} was edited meanwhile; it is read again, and nothing was written")
        text = placed(self.text, number, pose, str(self.path), kind)
        with atomic_write(self.path.resolve()) as stream:  # a link stays one
            stream.write(text.encode("utf-8"))
        self.text = self._seen = text

    def _read(self) -> str:
        return read_input(self.path).decode("utf-8", "replace")


def placed(text: str, number: int, pose: np.ndarray, name: str, kind: str = "markers") -> str:
    """The text of a scene file in which table number, counted from 0, of the markers or splats has another
    pose (4, 4).

    Raises:
        InputError: naming the file, where the table is not found.
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
            f"{name}: the pose of {_WORDS[kind]} {number} is not written, as its table is not a plain "
            f"[[{kind}]]; put position = {position}, quaternion = {quaternion} there"
        )
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
    """What the file is to say afterwards; something that no file says where there is no such table."""
    scene = _parsed(text)
    try:
        scene[kind][number] |= {"position": position, "quaternion": quaternion}
    except (TypeError, KeyError, IndexError):
        return {}, number
    return scene
