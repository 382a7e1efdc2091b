"""Captured scenes by name: public files, downloaded with a checksum into the user's cache."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Thread

from fidsplat.util.downloads import download
from fidsplat.util.errors import InputError, unknown
from fidsplat.util.files import from_json, user_cache
from fidsplat.util.progress import Progress, no_progress

MIRROR = "FIDSPLAT_SCENES"
"""environment variable with a folder or URL that replaces the address of the files"""
_WAIT = 0.5
"""seconds to wait for a download in the background"""


@dataclass(frozen=True)
class CapturedScene:
    """A public captured scene: author, licence, and files with sizes and checksums."""

    name: str
    title: str
    splats: int
    author: str
    licence: str
    source: str
    url: str
    """address of the folder of its files"""
    open: str
    """name of the file to load"""
    files: dict[str, tuple[int, str]]
    """size in bytes and SHA-256 of each file"""

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(size for size, _ in self.files.values())

    @property
    def credit(self) -> str:
        """Title, author, licence and source, for captions."""
        return f"{self.title} by {self.author}, {self.licence}, {self.source}"


@cache
def captured_scenes() -> dict[str, CapturedScene]:
    """All captured scenes by name."""
    table = from_json(Path(__file__).with_name("captured.json").read_bytes())
    return {name: CapturedScene(name, **fields) for name, fields in table.items()}


def fetch_scene(name: str, progress: Progress = no_progress) -> Path:
    """Path of a captured scene in the user's cache; downloads it on first use, from `MIRROR` if it is set.

    progress: called with the current step and its fraction done, 0 to 1.

    Raises InputError for an unknown name, a failed download or a wrong checksum.
    """
    if name not in captured_scenes():
        raise InputError(unknown("name of a captured scene", name, captured_scenes()))
    scene, folder, done = captured_scenes()[name], user_cache() / "fidsplat" / "scenes", 0
    mirror = os.environ.get(MIRROR)
    url = scene.url if mirror is None else mirror if "://" in mirror else Path(mirror).absolute().as_uri()

    def add(size: int) -> None:
        nonlocal done
        done += size
        progress(f"download {name}", done / scene.size)

    for file, (size, sha256) in scene.files.items():
        download(f"{url.rstrip('/')}/{file}", folder / file, size, sha256, add)
    return folder / scene.open


def fetch_in_background(name: str) -> Callable[[], str]:
    """Download a captured scene in a thread. Returns a function that returns why the scene is missing, or "".

    This module must not import zxing-cpp: a thread that hangs at the end of the process keeps the globals of
    its module alive, which zxing-cpp would report as leaks.
    """
    results: list[str] = []

    def fetch() -> None:
        try:
            fetch_scene(name)
            results.append("")
        except InputError as error:
            results.append(str(error))

    thread = Thread(target=fetch, daemon=True)  # a hanging download must not block the end of the command
    thread.start()

    def missing() -> str:
        thread.join(_WAIT)
        return results[0] if results else f"the download of {name} takes longer than the other views"

    return missing
