"""Warp and the kernel package, imported on first use."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import ModuleType

from fidsplat.backends.checked_cache import check_once
from fidsplat.util.errors import DeviceError
from fidsplat.util.files import kernels_folder
from fidsplat.util.streams import without_stderr

MISSING = "Warp is not installed; install it with: pip install 'fidsplat[warp]' (or pip install warp-lang)"
_PACKAGE = "fidsplat_warp_kernels"
_LOADED = (".o", ".cubin", ".ptx", ".meta")
"""suffixes of compiled kernels in Warp's cache"""


def installed() -> bool:
    """Whether Warp can be imported."""
    return importlib.util.find_spec("warp") is not None


@cache
def load() -> ModuleType:
    """The module `warp`, initialised. Raises DeviceError if it is not installed or cannot be started."""
    if not installed():
        raise DeviceError(MISSING)
    try:
        import warp
    except Exception as error:  # a broken installation, whatever it raises
        raise DeviceError(f"Warp cannot be imported: {error}") from error
    with quiet(), without_stderr():
        warp.init()
    if folder := warp.config.kernel_cache_dir:
        check_once(Path(folder), lambda name: name.endswith(_LOADED), lambda _: True)
    return warp


@contextmanager
def quiet() -> Iterator[None]:
    """A context in which Warp logs warnings only, not the loading of modules."""
    import warp

    level, warp.config.log_level = warp.config.log_level, warp.LOG_WARNING
    try:
        yield
    finally:
        warp.config.log_level = level


@cache
def kernels(name: str) -> ModuleType:
    folder = kernels_folder() / "warp"
    if _PACKAGE not in sys.modules:
        spec = importlib.util.spec_from_file_location(
            _PACKAGE, folder / "__init__.py", submodule_search_locations=[str(folder)]
        )
        if spec is None or spec.loader is None:
            raise DeviceError(f"the Warp kernels are missing from {folder}; reinstall fidsplat")
        package = importlib.util.module_from_spec(spec)
        sys.modules[_PACKAGE] = package
        spec.loader.exec_module(package)
    return importlib.import_module(f"{_PACKAGE}.{name}")
