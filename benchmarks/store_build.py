"""Building a store from a PLY within a bound of memory: splats a second, and the most memory that it took.

    python benchmarks/store_build.py [--splats 10e6] [--memory 2GiB] [--no-levels] [--json FILE]

Writes a PLY of a city (`fidsplat.worlds.city`) first, which is not counted, then runs `fidsplat store build`
as a process of its own.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path

import numpy as np
from measuring import keep, options, show

import fidsplat as fs
from fidsplat.formats.collect import WINDOW
from fidsplat.splats.harmonics import C0
from fidsplat.worlds.city import City

_FIELDS = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1")
_QUATERNION = tuple(f"rot_{k}" for k in range(4))


def write_ply(city: City, path: Path) -> None:
    """The city's splats as a PLY of 2DGS, part by part."""
    names, source = (*_FIELDS, *_QUATERNION), city.source
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {city.splats}"]
    header += [*(f"property float {name}" for name in names), "end_header", ""]
    with path.open("wb") as stream:
        stream.write("\n".join(header).encode())
        for first in range(0, city.splats, WINDOW):
            count = min(WINDOW, city.splats - first)
            kinds = source.rows.columns.items()
            part = {name: np.empty((count, *shape), kind) for name, (shape, kind) in kinds}
            source.rows.fill(first, part)
            logits = np.log(part["opacities"] / (1 - part["opacities"]))
            rows = [part["means"], (part["colors"] - 0.5) / C0, logits[:, None], np.log(part["scales"])]
            stream.write(np.hstack([*rows, part["quats"]]).astype("<f4").tobytes())


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--splats", type=float, default=10e6)
    parser.add_argument("--memory", default="2GiB")
    parser.add_argument("--no-levels", action="store_true", help="without levels of detail")
    asked = parser.parse_args()
    count = int(asked.splats)
    with tempfile.TemporaryDirectory() as folder:
        ply = Path(folder) / "city.ply"
        write_ply(City(count), ply)
        command = ["store", "build", str(ply), "-o", f"{folder}/city.fss", "--memory", asked.memory]
        begun, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        more = ["--no-levels"] if asked.no_levels else []
        subprocess.run([sys.executable, "-m", "fidsplat", *command, *more], check=True)
        spent, after = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_CHILDREN)
    row = {
        "splats": count,
        "levels": not asked.no_levels,
        "s": spent,
        "cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "peak_bytes": after.ru_maxrss * 1024,
    }
    machine = {"cores": os.cpu_count(), "numpy": np.__version__, "date": date.today().isoformat()}
    keep({**machine, "fidsplat": fs.__version__, "memory": asked.memory, **row}, asked.json)
    show(
        f"{count:,} splats, --memory {asked.memory}, {os.cpu_count()} cores",
        ("seconds", "processor seconds", "splats a second", "most memory"),
        [
            (
                f"{spent:.1f}",
                f"{row['cpu_s']:.1f}",
                f"{count / spent:,.0f}",
                f"{row['peak_bytes'] / 2**30:.2f} GiB",
            )
        ],
    )


if __name__ == "__main__":
    main()
