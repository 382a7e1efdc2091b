"""A moved marker goes back into its scene file: two lines change, all else stays as it was written."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.errors import InputError
from fidsplat.files import atomic_write
from fidsplat.rotations import matrix_to_quaternion

_HEAD = re.compile(r"^[ \t]*\[.*$", re.MULTILINE)
_MARKERS = re.compile(r"^[ \t]*\[\[[ \t]*markers[ \t]*\]\][ \t]*(?:#.*)?$")
DIGITS = 9
"""of metres and quaternions in the file: nanometres"""


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

    def place(self, number: int, pose: np.ndarray) -> None:
        """Write the pose (4, 4) of marker number, counted from 0.

        Raises:
            InputError: the file has changed meanwhile, cannot be written, or has its markers in a form in
                which their poses are not found.
        """
        if self._read() != self.text:
            raise InputError(f"{self.path} was edited meanwhile; it is read again, and nothing was written")
        text = placed(self.text, number, pose, str(self.path))
        with atomic_write(self.path) as stream:
            stream.write(text.encode("utf-8"))
        self.text = self._seen = text

    def _read(self) -> str:
        try:
            return self.path.read_bytes().decode("utf-8", "replace")
        except OSError as error:
            raise InputError(f"cannot read {self.path}: {error.strerror or error}") from error


def placed(text: str, number: int, pose: np.ndarray, name: str) -> str:
    """The text of a scene file in which marker number, counted from 0, has another pose (4, 4).

    Raises:
        InputError: naming the file, where the marker's table is not found.
    """
    position = [round(float(v), DIGITS) + 0.0 for v in pose[:3, 3]]
    quaternion = [round(float(v), DIGITS) + 0.0 for v in matrix_to_quaternion(pose[:3, :3])]
    heads = list(_HEAD.finditer(text))
    tables = [k for k, head in enumerate(heads) if _MARKERS.match(head[0])]
    new = text
    if number < len(tables):
        k = tables[number]
        end = heads[k + 1].start() if k + 1 < len(heads) else len(text)
        table = text[heads[k].end() : end]
        for key, values in (("position", position), ("quaternion", quaternion)):
            table = _with(table, key, values)
        new = text[: heads[k].end()] + table + text[end:]
    if _parsed(new) != _expected(text, number, position, quaternion):
        raise InputError(
            f"{name}: the pose of marker {number} is not written, as its table is not a plain [[markers]]; "
            f"put position = {position}, quaternion = {quaternion} there"
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
        return tomllib.loads(text)
    except (ValueError, RecursionError):
        return None


def _expected(text: str, number: int, position: list[float], quaternion: list[float]) -> Any:
    """What the file is to say afterwards; something that no file says where there is no such marker."""
    scene = _parsed(text)
    try:
        scene["markers"][number] |= {"position": position, "quaternion": quaternion}
    except (TypeError, KeyError, IndexError):
        return {}, number
    return scene
