"""Safe readers of untrusted .npy and .npz files, and an atomic writer.

`numpy.load` allocates the size that a header declares, may skip the checksums of a .npz file, and raises
arbitrary errors for a damaged header. These readers allocate at most the size of the file.
"""

from __future__ import annotations

import ast
import math
import os
from collections.abc import Collection
from pathlib import Path
from zipfile import ZIP_STORED, BadZipFile, ZipFile

import numpy as np

from fidsplat.util.files import atomic_write, open_input

_MAGIC = b"\x93NUMPY\x01\x00"


def load_npy(file: Path) -> np.ndarray:
    """Read the array of a .npy file, read-only. Raises ValueError for damaged data or Python objects."""
    with open_input(file) as stream:
        return _array(stream.read())


def save_npy(file: Path, array: np.ndarray) -> None:
    """Write an array as a .npy file, atomically."""
    with atomic_write(file) as stream:
        np.save(stream, array)


def load_npz(file: Path, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Read all or named arrays of a .npz file of `numpy.savez`, read-only, and check their CRC-32.

    Raises ValueError if an array is missing, damaged, compressed or contains Python objects.
    """
    with open_input(file) as stream:
        try:
            with ZipFile(stream) as members:
                entries = members.infolist()
                if any(entry.compress_type != ZIP_STORED for entry in entries):
                    raise ValueError(
                        "it must be uncompressed, got compressed arrays; write it with numpy.savez"
                    )
                if sum(entry.file_size for entry in entries) > os.fstat(stream.fileno()).st_size:
                    raise ValueError("its arrays must be smaller than the file, got larger ones")
                members_by_name = {entry.filename.removesuffix(".npy"): entry for entry in entries}
                return {
                    name: _array(members.read(members_by_name[name])) for name in names or members_by_name
                }
        except KeyError as error:
            raise ValueError(f"the array {error} is missing") from None
        except (BadZipFile, EOFError, RuntimeError, OverflowError) as error:  # RuntimeError: encrypted
            raise ValueError(str(error)) from None


def _array(content: bytes) -> np.ndarray:
    length = int.from_bytes(content[8:10], "little")
    if content[:8] != _MAGIC:
        raise ValueError(f"its arrays must have the NumPy format version 1.0, got {content[:8]!r}")
    try:
        header = ast.literal_eval(content[10 : 10 + length].decode("latin-1").strip())
        dtype, shape = np.lib.format.descr_to_dtype(header["descr"]), header["shape"]
        order = "F" if header["fortran_order"] else "C"
        size = math.prod(shape) * dtype.itemsize
        if dtype.hasobject or not dtype.itemsize or size != len(content) - 10 - length:
            raise ValueError
        return np.ndarray(shape, dtype, content, 10 + length, order=order)
    except Exception:  # SyntaxError, MemoryError, RecursionError and others of Python's parser and NumPy
        raise ValueError("the header of an array is damaged, or does not fit its data") from None
