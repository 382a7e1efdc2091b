"""Registration of Intel's OpenCL CPU runtime from pip with the OpenCL loader, and detection of CPU features.

The packages intel-opencl-rt and intel-cmplr-lib-rt are not listed in /etc/OpenCL/vendors, and the loader does
not find their dependencies.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib import metadata
from pathlib import Path

_VENDORS = "OCL_ICD_VENDORS"
"""the loader's environment variable: a folder that replaces /etc/OpenCL/vendors"""
_SYSTEM = Path("/etc/OpenCL/vendors")
_NEEDED = ("libintlc.so.5", "libimf.so", "libirng.so", "libsvml.so")


def intel_library() -> Path | None:
    """Path of Intel's runtime from pip; None if it or intel-cmplr-lib-rt is missing."""
    try:
        files = metadata.files("intel-opencl-rt") or ()
    except metadata.PackageNotFoundError:
        return None
    for file in files:
        library = Path(str(file.locate())).resolve()
        if file.name == "libintelocl.so" and all((library.parent / name).exists() for name in _NEEDED):
            return library
    return None


@cache
def processor_flags() -> frozenset[str]:
    """Feature flags of the processor as Linux names them; empty on other systems."""
    try:
        text = Path("/proc/cpuinfo").read_text("utf-8")
    except OSError:
        return frozenset()
    flags = re.search(r"^flags\s*:(.*)$", text, re.MULTILINE)
    return frozenset(flags[1].split() if flags else ())


@contextmanager
def intel_registered() -> Iterator[None]:
    """Let the loader find Intel's runtime when it first lists platforms. A vendors folder set by the user is
    not replaced."""
    library = None if _VENDORS in os.environ else intel_library()
    if library is None:
        yield
        return
    with tempfile.TemporaryDirectory(prefix="fidsplat-opencl-") as folder:
        for known in _SYSTEM.glob("*.icd"):
            shutil.copy(known, folder)
        (Path(folder) / "fidsplat-intel-cpu.icd").write_text(f"{library}\n", "utf-8")
        with suppress(OSError):  # libraries for another system; the loader skips them
            for name in _NEEDED:
                ctypes.CDLL(str(library.parent / name), ctypes.RTLD_GLOBAL)
        os.environ[_VENDORS] = folder
        try:
            yield
        finally:
            del os.environ[_VENDORS]
