"""What containers cost a store: chunks of a column read at random places, and whether they are copied.

    python benchmarks/containers.py [--millions 4] [--json FILE]

Needs pyarrow, zarr and h5py (pip install pyarrow zarr h5py), which fidsplat itself does not. Of each: seconds
to write means, quaternions, scales, opacities and colours of so many splats; milliseconds to open; and per
chunk of 32,768 splats, files in the page cache, the time to have its arrays, which is next to none where the
container gives the mapped file itself, and the time to have and add up every number.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path

import numpy as np
from measuring import keep, options, show

CHUNK = 32768
READS = 200


def columns(count: int) -> dict[str, np.ndarray]:
    """Arrays of random splats."""
    generator = np.random.default_rng(0)
    widths = {"means": 3, "quats": 4, "scales": 2, "opacities": 1, "colors": 3}
    return {name: generator.random((count, width), np.float32) for name, width in widths.items()}


def as_npy(folder: Path, arrays: dict[str, np.ndarray]) -> Callable[[], dict]:
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    return lambda: {name: np.load(folder / f"{name}.npy", mmap_mode="r").view(np.ndarray) for name in arrays}


def as_arrow(folder: Path, arrays: dict[str, np.ndarray]) -> Callable[[], dict]:
    import pyarrow as pa

    flat = {
        name: pa.FixedSizeListArray.from_arrays(pa.array(array.reshape(-1)), array.shape[1])
        for name, array in arrays.items()
    }
    table = pa.table(flat)
    with pa.OSFile(str(folder / "a.arrow"), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table, max_chunksize=len(table))

    def opened() -> dict:
        batch = pa.ipc.open_file(pa.memory_map(str(folder / "a.arrow"))).get_batch(0)
        return {
            name: batch.column(name).values.to_numpy().reshape(-1, arrays[name].shape[1]) for name in arrays
        }

    return opened


def as_zarr(folder: Path, arrays: dict[str, np.ndarray]) -> Callable[[], dict]:
    import zarr

    for name, array in arrays.items():
        made = zarr.create_array(
            store=str(folder / name),
            shape=array.shape,
            chunks=(CHUNK, array.shape[1]),
            dtype="float32",
            compressors=None,
        )
        made[:] = array
    return lambda: {name: zarr.open_array(str(folder / name), mode="r") for name in arrays}


def as_hdf5(folder: Path, arrays: dict[str, np.ndarray]) -> Callable[[], dict]:
    import h5py

    with h5py.File(folder / "a.h5", "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array)

    def opened() -> dict:
        file = h5py.File(folder / "a.h5", "r")
        return {name: file[name] for name in arrays}

    return opened


CONTAINERS = {"npy, mapped": as_npy, "Arrow IPC, mapped": as_arrow, "zarr 3": as_zarr, "HDF5": as_hdf5}


def measure(name: str, arrays: dict[str, np.ndarray]) -> dict:
    """One container's row."""
    folder = Path(tempfile.mkdtemp())
    try:
        begun = time.perf_counter()
        opener = CONTAINERS[name](folder, arrays)
        written = time.perf_counter() - begun
        begun = time.perf_counter()
        opened = opener()
        opening = time.perf_counter() - begun
        firsts = np.random.default_rng(1).integers(0, len(arrays["means"]) // CHUNK, READS) * CHUNK
        times = {}
        for what, use in (("have", lambda part: part), ("use", np.sum)):
            begun = time.perf_counter()
            for first in firsts:
                for array in opened.values():
                    use(array[first : first + CHUNK])
            times[what] = (time.perf_counter() - begun) / READS * 1e3
        mapped = isinstance(opened["means"], np.ndarray)
        files = sum(1 for file in folder.rglob("*") if file.is_file())
        return {"container": name, "write_s": written, "open_ms": opening * 1e3, "files": files} | {
            "mapped": mapped,
            "chunk_ms": times["have"],
            "chunk_used_ms": times["use"],
        }
    finally:
        shutil.rmtree(folder)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--millions", type=float, default=4.0)
    asked = parser.parse_args()
    arrays = columns(int(asked.millions * 1e6))
    made = {"date": date.today().isoformat(), "numpy": np.__version__}
    rows = [measure(name, arrays) | {"millions": asked.millions} | made for name in CONTAINERS]
    if asked.json is not None:
        keep(rows, asked.json)
    show(
        f"{asked.millions:g} M splats",
        ("container", "write [s]", "open [ms]", "files", "no copy", "chunk [ms]", "chunk used [ms]"),
        (
            (
                row["container"],
                f"{row['write_s']:.2f}",
                f"{row['open_ms']:.1f}",
                str(row["files"]),
                "yes" if row["mapped"] else "no",
                f"{row['chunk_ms']:.3f}",
                f"{row['chunk_used_ms']:.3f}",
            )
            for row in rows
        ),
    )


if __name__ == "__main__":
    main()
