"""Write fidsplat/images/apriltag3.npz from the tables of AprilTag 3.

python tools/apriltag3_tables.py PATH/OF/github.com/AprilRobotics/apriltag
"""

import re
import sys
from pathlib import Path

import numpy as np

from fidsplat.images.apriltag3 import STEP, TABLES


def main(folder: Path) -> None:
    arrays = {}
    for path in sorted(folder.glob("tag[SC]*.c")):
        text = path.read_text()
        codes = [int(code, 16) for code in re.findall(r"0x([0-9a-f]+)UL", text)]
        x, y = ([int(at) for at in re.findall(rf"bit_{axis}\[\d+\] = (-?\d+)", text)] for axis in "xy")
        size = 1 << len(x)
        steps = [(b - a) * pow(STEP, -1, size) % size for a, b in zip([0, *codes], codes, strict=False)]
        name = path.stem.removeprefix("tag").lower()
        arrays[f"{name}_xy"] = np.array([x, y], np.int8)
        # planes of bytes compress better: the upper ones are almost constant
        arrays[f"{name}_steps"] = np.ascontiguousarray(np.array(steps, "<u8").view(np.uint8).reshape(-1, 8).T)
    np.savez_compressed(TABLES, **arrays)  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    main(Path(sys.argv[1]))
