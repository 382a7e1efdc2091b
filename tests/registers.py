"""Resources of the base's kernels on an NVIDIA GPU: registers, spills, private and local memory.

    PYTHONPATH=. python tests/registers.py [--device opencl:nvidia] [--record]

Prints them, by kernel; --record writes them into tests/compile/registers.json too, under the GPU's generation
(sm_90) and with the driver's version, for tests/compile/test_registers.py. Only the driver that it was
recorded with is held to a record: another one has another compiler.
"""

from __future__ import annotations

import argparse
import json
import re
import secrets
from pathlib import Path

import pyopencl as cl

import fidsplat as fs
from fidsplat.backends.opencl.assemble import assemble
from fidsplat.backends.opencl.device import OpenCLBackend
from fidsplat.backends.opencl.program import build
from fidsplat.effects import select
from fidsplat.util.errors import DeviceError

RECORD = Path(__file__).parent / "compile" / "registers.json"
Numbers = dict[str, dict[str, int]]
_ENTRY = re.compile(r"Compiling entry function '(\w+)' for 'sm_\w+'")
_STACK = r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads"
_USED = re.compile(r"Used (\d+) registers")


def generation(backend: OpenCLBackend) -> str | None:
    """sm_90 and the like; None if it is no GPU of NVIDIA's."""
    device = backend.device
    if device.platform.name != "NVIDIA CUDA":
        return None
    return f"sm_{device.compute_capability_major_nv}{device.compute_capability_minor_nv}"


def of_log(log: str) -> Numbers:
    """Figures of ptxas --verbose for each kernel: registers; bytes of stack, spill_stores and spill_loads."""
    names_and_texts = _ENTRY.split(log)[1:]
    numbers: Numbers = {}
    for name, text in zip(names_and_texts[::2], names_and_texts[1::2], strict=True):
        # functions that are not inlined have properties of their own
        stack = re.search(rf"Function properties for {name}\b\D*{_STACK}", text)
        used = _USED.search(text)
        if stack and used:
            keys = ("registers", "stack", "spill_stores", "spill_loads")
            numbers[name] = dict(zip(keys, map(int, (used[1], *stack.groups())), strict=True))
    return numbers


def measure(backend: OpenCLBackend) -> Numbers:
    """By kernel of the base: figures of the log, and the private and local memory that OpenCL reports.

    Raises:
        DeviceError: the driver's log does not say.
    """
    features = select(fs.SplatCloud.empty(), fs.Capture(quality=fs.Quality(lowpass="none")))
    # the driver keeps what it has compiled, and has no log of what it kept: a kernel that is new each time
    name = f"unlike_{secrets.token_hex(8)}"
    unlike = f"kernel void {name}(global int *out) {{ out[0] = 1; }}\n"
    texts = [program.text + unlike for program in assemble(features, backend.config).programs.values()]
    return dict(sorted(one for text in texts for one in _of_text(backend, text, name).items()))


def _of_text(backend: OpenCLBackend, text: str, name: str) -> Numbers:
    """The same of the kernels of a text; `name` is the one that makes it new."""
    program = build(backend, text, "-cl-nv-verbose")
    log = program.get_build_info(backend.device, cl.program_build_info.LOG)
    numbers = of_log(log)
    info = cl.kernel_work_group_info
    for kernel in program.all_kernels():
        if kernel.function_name == name:
            numbers.pop(name, None)
        elif kernel.function_name not in numbers:
            raise DeviceError(f"the build log does not tell the registers of {kernel.function_name}: {log!r}")
        else:
            numbers[kernel.function_name] |= {
                "private": kernel.get_work_group_info(info.PRIVATE_MEM_SIZE, backend.device),
                "local": kernel.get_work_group_info(info.LOCAL_MEM_SIZE, backend.device),
            }
    return numbers


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="opencl:nvidia")
    parser.add_argument("--record", action="store_true")
    options = parser.parse_args()
    backend = fs.Renderer(options.device).backend
    kind = generation(backend) if isinstance(backend, OpenCLBackend) else None
    if kind is None:
        parser.error(f"{options.device} is no GPU of NVIDIA's, and only their driver tells registers")
    entry = {"driver": backend.device.driver_version, "kernels": measure(backend)}
    print(json.dumps({kind: entry}, indent=1))
    if options.record:
        known = json.loads(RECORD.read_text("utf-8"))
        RECORD.write_text(json.dumps(known | {kind: entry}, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
