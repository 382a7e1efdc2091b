"""Lets the OpenCL loader find Intel's runtime for CPUs where pip has installed it.

The packages intel-opencl-rt and intel-cmplr-lib-rt bring the libraries, but no file in /etc/OpenCL/vendors
that names them, and the loader would not find those that they need.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path

_VENDORS = "OCL_ICD_VENDORS"
"""the loader's variable: a folder to look into instead of /etc/OpenCL/vendors"""
_SYSTEM = Path("/etc/OpenCL/vendors")
_NEEDED = ("libintlc.so.5", "libimf.so", "libirng.so", "libsvml.so")


def intel_library() -> Path | None:
    """Intel's runtime as pip has installed it; None where it is not, or lacks intel-cmplr-lib-rt."""
    try:
        files = metadata.files("intel-opencl-rt") or ()
    except metadata.PackageNotFoundError:
        return None
    for file in files:
        library = Path(str(file.locate())).resolve()
        if file.name == "libintelocl.so" and all((library.parent / name).exists() for name in _NEEDED):
            return library
    return None


@contextmanager
def intel_among_them() -> Iterator[None]:
    """Within it, the loader's first look for platforms finds that runtime beside those of the system. A
    folder that the user has named is left alone."""
    library = None if _VENDORS in os.environ else intel_library()
    if library is None:
        yield
        return
    with tempfile.TemporaryDirectory(prefix="fidsplat-opencl-") as folder:
        for known in _SYSTEM.glob("*.icd"):
            shutil.copy(known, folder)
        (Path(folder) / "fidsplat-intel-cpu.icd").write_text(f"{library}\n", "utf-8")
        with suppress(OSError):  # libraries for another system: the loader will pass over it
            for name in _NEEDED:
                ctypes.CDLL(str(library.parent / name), ctypes.RTLD_GLOBAL)
        os.environ[_VENDORS] = folder
        try:
            yield
        finally:
            del os.environ[_VENDORS]
