"""Provenance of a measurement: hash of the sources, commit, machine, versions."""

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
from fidsplat.util.files import kernels_folder

_PACKAGE = Path(__file__).resolve().parents[1]
_REBUILDING = {"fidsplat", "numpy", "copyreg"}
"""packages whose functions are allowed in pickles, as they restore data"""
_WITHOUT_SOURCES = {"__pycache__", "_kernels"}
"""folders of the package to skip: bytecode, and a wheel's copy of the kernels"""


def digest_of(content: object) -> str:
    """SHA-256 of plain data as 16 hexadecimal digits. Raises PicklingError, AttributeError or TypeError for
    functions and other objects."""
    digest = _Digest()
    _DataPickler(digest, protocol=5).dump(content)
    return digest.sha.hexdigest()[:16]


class _DataPickler(pickle.Pickler):
    """Pickler that refuses functions, since a pickle contains only their names."""

    def persistent_id(self, obj: Any) -> None:
        known = (getattr(obj, "__module__", None) or "").partition(".")[0] in _REBUILDING
        if callable(obj) and not isinstance(obj, type) and not known:
            raise pickle.PicklingError(f"{obj!r} is a function, not data")


class _Digest:
    """A stream that hashes the written data."""

    def __init__(self) -> None:
        self.sha = hashlib.sha256()

    def write(self, data: Any) -> int:
        content = memoryview(data)  # bytes, or a large array without a copy
        self.sha.update(content)
        return content.nbytes


@cache
def code_hash() -> str:
    """SHA-256 of all files of the package and the kernels, as 16 hexadecimal digits; equal for a checkout
    and its wheel."""
    sha = hashlib.sha256()
    for name, file in sorted(sources().items()):
        content = file.read_bytes()
        sha.update(f"{name}\0{len(content)}\0".encode() + content)
    return sha.hexdigest()[:16]


def sources() -> dict[str, Path]:
    """Files of `code_hash` by their paths relative to `fidsplat` and `kernels`."""
    files = {}
    for top, folder in (("fidsplat", _PACKAGE), ("kernels", kernels_folder())):
        for file in folder.rglob("*"):
            inside = file.relative_to(folder)
            hidden = file.name.startswith(".") or _WITHOUT_SOURCES & set(inside.parts)
            if file.is_file() and not hidden:
                files[f"{top}/{inside.as_posix()}"] = file
    return files


def run_facts(device: str | None, seed: int, versions: Mapping[str, str] | None = None) -> dict:
    """Provenance of a run as plain data.

    device: title and driver of the rendering device. seed: seed of the run. versions: versions of other
    packages by name.
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
    """Commit of the checkout, with "+" if tracked files differ; None outside a checkout."""
    here = Path(__file__)

    def git(*words: str) -> str | None:
        done = subprocess.run(["git", "-C", str(here.parent), *words], capture_output=True, text=True)
        return None if done.returncode else done.stdout.strip()

    try:
        # a virtual environment may be inside another repository
        if git("ls-files", "--error-unmatch", here.name) is None:
            return None
        head = git("rev-parse", "--short=12", "HEAD")
        return None if head is None else head + ("+" if git("status", "--porcelain", "-uno") else "")
    except OSError:
        return None
