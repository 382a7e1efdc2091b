"""List the functions of fidsplat that a frame of a tag enters.

    python benchmarks/frame_functions.py [--device D] [--list]

Counts functions, lambdas and comprehensions of the package with `sys.setprofile` during `Renderer.render`
of a tag of 27 splats at 64 x 48 pixels: for the first frame, which uploads the cloud and compiles the
kernels, and for a replayed frame of the uploaded cloud with a new capture. `--list` prints them with their
numbers of calls. Python 3.12 and newer count no comprehensions, as they have no frame of their own.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import CodeType

import fidsplat as fs

_PACKAGE = str(Path(fs.__file__).parent)
_OPTIMIZED = 1
"""flag of code objects that are not bodies of modules and classes"""


def entered(call: Callable[[], object]) -> Counter[CodeType]:
    """Number of calls of each code object of the package during a call."""
    calls: Counter[CodeType] = Counter()

    def count(frame, event: str, _) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(_PACKAGE) and code.co_flags & _OPTIMIZED:
            calls[code] += 1

    sys.setprofile(count)
    try:
        call()
    finally:
        sys.setprofile(None)
    return calls


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="opencl:pocl")
    parser.add_argument("--list", action="store_true", help="list the functions")
    options = parser.parse_args()
    cloud = fs.marker("apriltag:36h11:5", size=0.16).cloud
    cameras = [
        fs.Camera.look_at(64, 48, 1.0, position=(0.001 * k, 0, -0.4), target=(0, 0, 0)) for k in range(4)
    ]
    renderer = fs.Renderer(options.device)
    counts = {"first frame": entered(lambda: renderer.render(cloud, cameras[0]))}
    resident = renderer.upload(cloud)
    for camera in cameras[:3]:  # rendered, recorded, and replayed
        renderer.render(resident, camera).wait()
    counts["replayed frame"] = entered(lambda: renderer.render(resident, cameras[3]))
    for frame, calls in counts.items():
        named = sum(not code.co_name.startswith("<") for code in calls)
        files = len({code.co_filename for code in calls})
        print(f"{frame}: {len(calls)} functions in {files} files, {named} of them with a name")
        for code in sorted(calls, key=lambda code: (code.co_filename, code.co_firstlineno)):
            if options.list:
                place = f"{Path(code.co_filename).relative_to(_PACKAGE)}:{code.co_firstlineno}"
                print(f"{calls[code]:6} {place} {code.co_qualname}")


if __name__ == "__main__":
    main()
