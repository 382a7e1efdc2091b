"""Run the kernels in oclgrind, an OpenCL interpreter that checks memory accesses, and report invalid reads
and writes, data races between work-items, and uninitialized values.

    python tools/memory_check.py [--log FILE]

Requires oclgrind (tested with 21.10); on Debian: apt-get update && apt-get install oclgrind. The exit status
is 0 if nothing was reported and every frame agrees with the reference. Kernels with injected bugs run first:
the check also fails if oclgrind does not report these.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

# Without optimisation, which may remove the invalid access and inserts LLVM's `freeze`, which oclgrind's
# detection of uninitialized values does not support.
OCLGRIND = ["--data-races", "--uninitialized", "--build-options", "-cl-opt-disable", "--max-errors", "1000"]
INSTALL = "apt-get update && apt-get install oclgrind"

INJECTED = {
    "Invalid read": "a[i] = b[i + 64];",
    "Invalid write": "a[i - 64] = 1;",
    "data race": "a[0] = a[0] + i;",
    "uninitialized": "int x[4]; x[i & 1] = 1; if (x[2 + (b[i] & 1)] > 0) a[i] = 3;",
}
"""bodies of kernels with a bug, by a part of oclgrind's message"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--log", type=Path, help="write oclgrind's messages about the kernels to this file")
    parser.add_argument("--inside", choices=("injected", "frames"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.inside:
        return run_injected() if arguments.inside == "injected" else run_frames()
    if shutil.which("oclgrind") is None:
        print(f"oclgrind must be installed, on Debian by: {INSTALL}", file=sys.stderr)
        return 2
    version = subprocess.run(["oclgrind", "--version"], capture_output=True, text=True).stdout.split()[1]
    print(f"oclgrind {version} {' '.join(OCLGRIND)}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        injected, _ = under_oclgrind("injected", Path(folder))
        missing = [words for words in INJECTED if not any(words in message for message in injected)]
        print(f"injected bugs: {len(INJECTED)}, not reported: {', '.join(missing) or 'none'}", flush=True)
        messages, status = under_oclgrind("frames", Path(folder), arguments.log)
    print(f"errors in the kernels: {sum(messages.values())}")
    for message, count in messages.most_common(20):
        print(f"  {count} x {message}")
    clean = status == 0 and not missing and not messages
    print("clean" if clean else "NOT CLEAN")
    return 0 if clean else 1


def under_oclgrind(part: str, folder: Path, keep: Path | None = None) -> tuple[Counter[str], int]:
    """Run a part of this script in oclgrind; returns its messages with kernel names, and the exit status."""
    log = folder / f"{part}.log"
    command = ["oclgrind", *OCLGRIND, "--log", str(log), sys.executable, __file__, "--inside", part]
    # pyopencl's cache may have kernels compiled with other options
    status = subprocess.run(command, env=os.environ | {"PYOPENCL_NO_CACHE": "1"}).returncode
    text = log.read_text("utf-8", "replace") if log.exists() else ""
    if keep:
        keep.write_text(text, "utf-8")
    found = re.findall(r"^(\S.*)\n\tKernel: (\S+)", text, re.MULTILINE)
    addresses = re.compile(r" (global |local |private )?memory address 0x[0-9a-f]+")
    return Counter(f"{addresses.sub('', message)}, in {kernel}" for message, kernel in found), status


def run_injected() -> int:
    """In oclgrind: run kernels with a bug each."""
    import numpy as np
    import pyopencl as cl

    context = cl.Context(cl.get_platforms()[0].get_devices())
    queue = cl.CommandQueue(context)
    for body in INJECTED.values():
        text = f"kernel void faulty(global int *a, global int *b) {{ int i = get_global_id(0); {body} }}"
        program = cl.Program(context, text).build()
        flags, zeros = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR, np.zeros(64, np.int32)
        buffers = [cl.Buffer(context, flags, hostbuf=zeros) for _ in range(2)]
        program.faulty(queue, (64,), (64,), *buffers)
        queue.finish()
    return 0


def run_frames() -> int:
    """In oclgrind: render frames in both schedules, and compare each with the reference."""
    import fidsplat as fs
    from fidsplat.backends.opencl.buffers import BufferPool

    renderer = fs.Renderer("opencl:oclgrind")
    buffers = []

    class RetainingPool(BufferPool):
        """Pool that releases no buffers: oclgrind reuses addresses, and reports a larger new buffer as
        uninitialized."""

        def allocate(self, name, size):
            buffers.append(super().allocate(name, size))
            return buffers[-1]

    wrong = 0
    for title, work in frames(renderer):
        # new buffers for each frame, which cannot read values of an earlier one
        renderer.backend.pool = RetainingPool(renderer.backend.context, renderer.backend.device)
        start = time.perf_counter()
        error = work()
        wrong += not error < 2e-5
        print(f"  {title:58} {time.perf_counter() - start:5.1f} s, largest error {error:.1e}", flush=True)
    return 1 if wrong else 0


def frames(renderer) -> Iterator[tuple[str, Callable[[], float]]]:
    """Titles, and functions that render a frame and return its largest error beyond the error bounds, in rgb
    and alpha.

    Few splats and few pixels in small tiles: tile lists of 0 to 90 splats, tiles cut by the image border, and
    several work-groups in each launch.
    """
    import numpy as np

    import fidsplat as fs
    from fidsplat.backends.view import View
    from fidsplat.effects import select
    from fidsplat.scenes.random_clouds import random_splats
    from fidsplat.selftest.agreement import ALL_OUTPUTS, FrameSpec, reference_images
    from fidsplat.selftest.clouds import camera, splats

    backend = renderer.backend
    lanes = replace(backend.config, schedule="lanes", lanes=4, tile_width=4, tile_height=8, scan_items=1)
    group = replace(
        backend.config, schedule="group", binning="bin_first", lanes=1, tile_width=8, tile_height=8
    )
    shapes = {
        "lanes": replace(lanes, sort_blocks=3, radix_bits=5),
        "group": replace(group, scan_items=8),
    }

    def task(shape, cloud, view_from, outputs=("rgb", "alpha"), quality=None, budget=None):
        def work() -> float:
            chosen = quality or fs.Quality()
            features = select(cloud, fs.Capture(outputs=outputs, quality=chosen))
            view = View.of(fs.Capture(view_from, quality=chosen, background=(0.1, 0.2, 0.3)), cloud.origin)
            backend.pair_budget, before = budget or backend.pair_budget, backend.pair_budget
            images = backend.pipeline(features, shape).render_view(backend.upload(cloud), view)
            rendered = {name: images.read(name, 0) for name in ("rgb", *features.outputs)}
            backend.pair_budget = before
            truth = reference_images(FrameSpec(cloud, view_from, chosen, outputs))
            worst = 0.0
            for name in {"rgb", "alpha"} & set(rendered):
                error = np.abs(rendered[name] - truth[name])
                error = error.max(-1) if error.ndim > 2 else error
                worst = max(worst, float((error - truth["error_bound"]).max()))
            return worst if all(np.isfinite(image).all() for image in rendered.values()) else float("nan")

        return work

    def arithmetic() -> float:
        numbers = np.linspace(0.5, 1.0, 64)
        results = backend.probe().arithmetic(-numbers, numbers, numbers, numbers)
        return float(np.abs(results["exp"] - np.exp(-numbers)).max())

    yield "the self-test's arithmetic", arithmetic
    small, wide, dot = camera(21, 14, 16.0), camera(37, 3, 20.0), camera(1, 1, 5.0)
    around = random_splats(24, 71, depth=(-1.0, 4.0), scale=(1e-3, 3.0))
    crowded = random_splats(90, 72, depth=(1.0, 3.0), scale=(0.02, 0.2), across=0.2)
    harmonic = fs.SplatCloud(
        around.means,
        around.quats,
        around.scales,
        around.opacities,
        sh=np.random.default_rng(73).normal(0, 0.3, (len(around), 16, 3)),
    )
    far = splats([[1e6, 0, 2], [-3e9, 1e9, 1], [0, 0, 1e9], [0, 0, 1e-3]], (1, 0.2, 0.3, 0), (2e6, 1e6), 0.8)
    planes = crowded.with_coplanar_groups(np.arange(90) % 4 - 1)
    plain = fs.Quality(lowpass="none", samples=2)
    for name, shape in shapes.items():
        yield f"{name}: splats around the camera, all outputs", task(shape, around, small, ALL_OUTPUTS)
        yield f"{name}: a crowded tile, all outputs", task(shape, crowded, small, ALL_OUTPUTS)
        yield f"{name}: the same in bands of 40 pairs", task(shape, crowded, small, ALL_OUTPUTS, budget=40)
        yield f"{name}: no low-pass, 2 x 2 samples", task(shape, around, small, ALL_OUTPUTS, plain)
        yield f"{name}: coplanar splats, all outputs", task(shape, planes, small, ALL_OUTPUTS)
        yield f"{name}: the gsplat preset", task(shape, crowded, small, quality=fs.Quality.named("gsplat"))
        yield f"{name}: spherical harmonics of degree 3", task(shape, harmonic, small)
        yield (
            f"{name}: set-up in float32",
            task(shape, crowded, small, quality=fs.Quality(projection_precision="float32")),
        )
        yield f"{name}: centres 1e7 and more pixels off", task(shape, far, small)
        yield f"{name}: 37 x 3 pixels", task(shape, around, wide)
        yield f"{name}: 1 x 1 pixel, all outputs", task(shape, crowded, dot, ALL_OUTPUTS)
        yield f"{name}: no splats, all outputs", task(shape, fs.SplatCloud.empty(), small, ALL_OUTPUTS)


if __name__ == "__main__":
    sys.exit(main())
