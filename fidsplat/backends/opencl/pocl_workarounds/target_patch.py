"""Patch of PoCL 3.0's target processor in memory: the last resort; FIDSPLAT_NO_POCL_PATCH forbids it.

PoCL 3.0 gets the processor's name from LLVM 14. For a newer processor (AMD Zen 5) the name is "generic", and
every build fails ("unknown target CPU", pocl issues #512, #1049). For Zen 4 it is "znver3" (without AVX-512),
and builds fail or never end. PoCL 3.1 reads POCL_LLVM_CPU_NAME; 3.0 has no such setting. The name is replaced
in the field `llvm_cpu` of PoCL's device record by the name for which PoCL built its kernel library.
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
import struct
import warnings
from pathlib import Path

from fidsplat.backends.opencl.vendors import processor_flags

# the x86 levels of PoCL's "distro" kernel libraries with LLVM's names, best last
_LEVELS = (
    ("x86-64", ()),
    ("core2", ("ssse3", "cx16")),
    ("penryn", ("sse4_1", "cx16")),
    ("sandybridge", ("avx", "cx16", "popcnt")),
    ("ivybridge", ("avx", "cx16", "popcnt", "f16c")),
    ("haswell", ("avx2", "cx16", "popcnt", "abm", "f16c", "fma", "bmi1", "bmi2")),
    ("skylake-avx512", ("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl")),
)
FORBID = "FIDSPLAT_NO_POCL_PATCH"
"""environment variable: any value except 0 forbids the patch"""
_NAME = re.compile(r"PoCL.*-x86_64-[\w-]*gnu-([\w-]+)$")
_RECORD_BYTES = 2048
_patched: dict[int, ctypes.Array] = {}  # kept alive, as PoCL's records point to these strings


def needs_patch(device_version: str) -> bool:
    """Whether a device is driven by PoCL 3.0 and LLVM misidentified its processor."""
    if platform.system() != "Linux" or platform.machine() != "x86_64":
        return False
    name = _name_of_llvm(device_version)
    return name == "generic" or (name.startswith("znver") and _processor_name() == _LEVELS[-1][0])


def why_unpatchable(device_address: int, device_version: str) -> str:
    """Why the PoCL device with its record at this address must not or cannot be patched; empty if it can."""
    if os.environ.get(FORBID, "0") not in ("", "0"):
        return f"the environment variable {FORBID} forbids the patch"
    if device_address in _patched:
        return ""
    try:
        return "" if _field_address(device_address, device_version) else "its record is not that of PoCL 3.0"
    except OSError as error:
        return f"/proc/self/mem cannot be read ({error.strerror or error})"


def patch_target(device_address: int, device_version: str) -> str:
    """Patch the processor name of a PoCL device unless `why_unpatchable` forbids it; returns the name."""
    if device_address not in _patched:
        address = (
            None
            if why_unpatchable(device_address, device_version)
            else _field_address(device_address, device_version)
        )
        if address is None:
            return _name_of_llvm(device_version)
        name = ctypes.create_string_buffer(_processor_name().encode())
        _patched[device_address] = name
        ctypes.c_uint64.from_address(address).value = ctypes.addressof(name)
    return _patched[device_address].value.decode()


def announce_once(cache: Path, text: str) -> None:
    """Warn that the device is patched, once for each folder of compiled kernels."""
    try:
        (cache / "fidsplat-patch-announced").touch(exist_ok=False)
    except FileExistsError:
        return
    except OSError:  # ensure_caches warns of folders that cannot be written
        pass
    warnings.warn(text, stacklevel=4)


def _field_address(device_address: int, device_version: str) -> int | None:
    """The address of the field `llvm_cpu` of a device's record; None if the record is not as expected."""
    wrong = _name_of_llvm(device_version).encode()
    memory = os.open("/proc/self/mem", os.O_RDONLY)
    try:
        record = _read(memory, device_address, _RECORD_BYTES)
        words = struct.unpack(f"<{len(record) // 8}Q", record[: len(record) // 8 * 8])
        fields = [
            index + 1
            for index in range(len(words) - 1)
            if _text(memory, words[index]).startswith(b"x86_64-") and _text(memory, words[index + 1]) == wrong
        ]
    finally:
        os.close(memory)
    return device_address + 8 * fields[0] if len(fields) == 1 else None


def _name_of_llvm(device_version: str) -> str:
    """LLVM's name of the processor, from PoCL's version string; empty if it is not in there."""
    found = _NAME.search(device_version.strip())
    return found[1] if found else ""


def _processor_name() -> str:
    return [name for name, needed in _LEVELS if processor_flags().issuperset(needed)][-1]


def _read(memory: int, address: int, count: int) -> bytes:
    """Bytes of this process's memory; empty where nothing is mapped (a plain pointer would crash)."""
    try:
        return os.pread(memory, count, address)
    except (OSError, OverflowError):
        return b""


def _text(memory: int, address: int) -> bytes:
    if not 4096 < address < 1 << 47:
        return b""
    return _read(memory, address, 32).split(b"\0")[0]
