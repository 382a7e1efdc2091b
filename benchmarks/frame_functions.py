"""Count the functions of fidsplat that a frame of a tag enters, and time its warm frames.

    python benchmarks/frame_functions.py [--device D] [--list]

Counts code objects (functions, lambdas and comprehensions) of the package with `sys.setprofile` around
`Renderer.render` of a tag of 27 splats at 64 x 48 pixels, the capture included: for the first frame, which
uploads the cloud and compiles the kernels, and for a warm frame of an uploaded cloud from another camera. To
compare with a commit, set PYTHONPATH to a folder with its files.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import CodeType

import numpy as np

import fidsplat as fs

_PACKAGE = str(Path(fs.__file__).parent)
_ROUNDS = 1000


def camera(number: int) -> fs.Camera:
    """One of several cameras in front of the tag."""
    pose = np.eye(4)
    pose[:3, 3] = 0.001 * (number % 7), 0.0, 0.4
    return fs.Camera.pinhole(64, 48, 60.0, 60.0, 32.0, 24.0, world_to_camera=pose)


def entered(call: Callable[[], object]) -> list[CodeType]:
    """Code objects of the package that a call enters, without bodies of modules and classes."""
    found: set[CodeType] = set()

    def enter(frame, event: str, _) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(_PACKAGE) and code.co_flags & 1:  # CO_OPTIMIZED
            found.add(code)

    sys.setprofile(enter)
    try:
        call()
    finally:
        sys.setprofile(None)
    return sorted(found, key=lambda code: (code.co_filename, code.co_firstlineno))


def report(what: str, codes: list[CodeType], listed: bool) -> None:
    """Print the number of functions and files, and their names if `listed`."""
    named = sum(not code.co_name.startswith("<") for code in codes)
    files = len({code.co_filename for code in codes})
    print(f"{what}: {len(codes)} functions in {files} files, {named} of them with a name")
    for code in codes if listed else ():
        print(f"    {Path(code.co_filename).relative_to(_PACKAGE)}:{code.co_firstlineno} {code.co_qualname}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="opencl:pocl")
    parser.add_argument("--list", action="store_true", help="list the functions")
    options = parser.parse_args()
    cloud, cameras = fs.marker("apriltag:36h11:5", size=0.16).cloud, [camera(k) for k in range(7)]
    renderer = fs.Renderer(options.device)
    report("first frame", entered(lambda: renderer.render(cloud, cameras[0])), options.list)
    resident = renderer.upload(cloud)
    for _ in range(2):
        for each in cameras[1:]:
            renderer.render(resident, each).wait()
    report("warm frame", entered(lambda: renderer.render(resident, cameras[0])), options.list)
    times = []
    for k in range(_ROUNDS):
        start = time.perf_counter()
        _ = renderer.render(resident, cameras[k % 7])["rgb"]
        times.append(time.perf_counter() - start)
    low, median = (1e6 * float(np.quantile(times, share)) for share in (0.05, 0.5))
    print(f"time of a warm frame with its image: {low:.0f} us at the quantile 0.05, {median:.0f} us median")


if __name__ == "__main__":
    main()
