"""What a measurement depends on: the sources of the package and of its kernels, the commit, the machine."""

from __future__ import annotations

import hashlib
import os
import pickle
import platform
import subprocess
from collections.abc import Mapping
from datetime import date
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fidsplat import __version__
from fidsplat.util.kernel_files import kernels_folder

_PACKAGE = Path(__file__).resolve().parents[1]
_REBUILDING = {"fidsplat", "numpy", "copyreg"}
"""packages by whose functions pickle makes data again"""
_WITHOUT_SOURCES = {"__pycache__", "_kernels"}
"""folders of the package whose files are not sources of its own; a wheel carries the kernels in one"""


def digest_of(content: object) -> str:
    """16 hexadecimal digits of all that plain data hold; large arrays are not copied.

    Raises PicklingError, AttributeError or TypeError, as pickle does, for content that is no data.
    """
    digest = _Digest()
    _DataPickler(digest, protocol=5).dump(content)
    return digest.sha.hexdigest()[:16]


class _DataPickler(pickle.Pickler):
    """Refuses functions of others and what is called like one: pickle knows them by their names, by which
    another one may be found tomorrow."""

    def persistent_id(self, obj: Any) -> None:
        known = (getattr(obj, "__module__", None) or "").partition(".")[0] in _REBUILDING
        if callable(obj) and not isinstance(obj, type) and not known:
            raise pickle.PicklingError(f"{obj!r} is a function, not data")


class _Digest:
    """A stream that keeps a hash of what is written to it."""

    def __init__(self) -> None:
        self.sha = hashlib.sha256()

    def write(self, data: Any) -> int:
        content = memoryview(data)  # bytes, or a large array where it lies
        self.sha.update(content)
        return content.nbytes


@cache
def code_hash() -> str:
    """16 hexadecimal digits of every source of the package and of the kernels, data and templates included.

    The same in a checkout and in a wheel, where the kernels lie elsewhere.
    """
    found = hashlib.sha256()
    for name, file in sorted(sources().items()):
        content = file.read_bytes()
        found.update(f"{name}\0{len(content)}\0".encode() + content)
    return found.hexdigest()[:16]


def sources() -> dict[str, Path]:
    """The files that `code_hash` covers, by their names relative to `fidsplat` and to `kernels`."""
    found = {}
    for top, folder in (("fidsplat", _PACKAGE), ("kernels", kernels_folder())):
        for file in folder.rglob("*"):
            inside = file.relative_to(folder)
            hidden = file.name.startswith(".") or _WITHOUT_SOURCES & set(inside.parts)
            if file.is_file() and not hidden:
                found[f"{top}/{inside.as_posix()}"] = file
    return found


def run_facts(device: str | None, seed: int, versions: Mapping[str, str] | None = None) -> dict:
    """What the numbers of a run depend on, as plain data.

    Args:
        device: title and driver of what draws; None when nothing is drawn.
        seed: of texts, views and scenes.
        versions: of the packages that take part, by name.
    """
    return {
        "device": device,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "versions": {"fidsplat": __version__, "numpy": version("numpy"), **(versions or {})},
        "commit": commit(),
        "code": code_hash(),
        "seed": seed,
        "date": date.today().isoformat(),
    }


def commit() -> str | None:
    """Commit of the checkout, with "+" when tracked files differ from it; None outside a checkout."""
    here = Path(__file__)

    def git(*words: str) -> str | None:
        done = subprocess.run(["git", "-C", str(here.parent), *words], capture_output=True, text=True)
        return None if done.returncode else done.stdout.strip()

    try:
        # an environment may lie inside somebody else's repository
        if git("ls-files", "--error-unmatch", here.name) is None:
            return None
        head = git("rev-parse", "--short=12", "HEAD")
        return None if head is None else head + ("+" if git("status", "--porcelain", "-uno") else "")
    except OSError:
        return None
