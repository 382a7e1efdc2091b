"""Compiled kernels of one source, with the types of their arguments."""

from __future__ import annotations

import importlib
import threading
import warnings
from collections.abc import Callable, Hashable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import cache
from typing import Any

import pyopencl as cl

from fidsplat.backends.caches import pocl_folder
from fidsplat.backends.opencl.assemble import KernelSource, assemble_test
from fidsplat.backends.opencl.pocl_workarounds import is_pocl, shared_program
from fidsplat.backends.opencl.pocl_workarounds.target_patch import needs_patch, patch_target
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.util import interrupts
from fidsplat.util.errors import DeviceError, FidsplatError

in_background = threading.local()
"""thread-local; `on` is True in threads of BackgroundCompiler, which must not change the warning filters"""


class _InvokerCache(dict[Any, Any]):
    """Replacement in memory for pyopencl's cache of generated Python code, a database without checksums."""

    store_if_not_present = dict.setdefault


@cache
def load_invoker() -> None:
    """Import pyopencl's code for kernel arguments without its database."""
    before, cl._PYOPENCL_NO_CACHE = cl._PYOPENCL_NO_CACHE, True
    invoker = importlib.import_module("pyopencl.invoker")
    cl._PYOPENCL_NO_CACHE = before
    invoker.__dict__["invoker_cache"] = _InvokerCache()


def build_options(device: cl.Device) -> list[str]:
    """Compiler options of all programs, without options that relax IEEE arithmetic."""
    version, target = device.version, device.version
    if needs_patch(version):
        target = patch_target(device.int_ptr, version)
    # pyopencl's cache key contains the version string, which names the processor. A patched target is not in
    # that string, so that an option names the target.
    target = "".join(c if c.isalnum() else "_" for c in target)
    options = ["-cl-std=CL1.2", "-w", f"-DTARGET_{target}"]
    rounds = device.single_fp_config & cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT
    if rounds and not is_pocl(device):
        # for bit-identical images; PoCL needs no option
        options.append("-cl-fp32-correctly-rounded-divide-sqrt")
    if device.platform.name == "NVIDIA CUDA":
        # the projection kernel uses up to 120 registers
        options.append("-cl-nv-maxrregcount=128")
    return options


def build(workspace: Workspace, text: str, *options: str) -> cl.Program:
    """Compile OpenCL C text. Raises DeviceError with the compiler's log."""
    context, options = workspace.context, (*workspace.compiler_options, *options)
    try:
        with ExitStack() as stack:
            if not getattr(in_background, "on", False):
                interrupts.check()
                stack.enter_context(warnings.catch_warnings())
                warnings.simplefilter("ignore", cl.CompilerWarning)
            if is_pocl(workspace.device):
                return shared_program(context, text, options)
            return cl.Program(context, text).build(options=list(options))
    except cl.Error as error:
        raise DeviceError(f"{workspace.info.title} cannot compile the kernels: {error}") from error


class Program:
    """The kernels of one source on one device."""

    def __init__(self, workspace: Workspace, source: KernelSource) -> None:
        self.source, self.programs = source, _compile(workspace, source)
        """`programs`: the OpenCL program of each kernel, by the kernel's name"""
        self.types: dict[str, list[Callable[[Any], Any] | None]] = {}
        """NumPy type of each argument of a kernel; None for a buffer"""
        for kernel, arguments in source.arguments.items():
            self.types[kernel] = types = []
            for argument in arguments.values():
                types.append(None if argument.access else source.scalar_types.dtype(argument.ctype).type)


def _compile(workspace: Workspace, source: KernelSource) -> dict[str, cl.Program]:
    """Compile a source; returns the OpenCL program of each kernel.

    PoCL's cache may return a program without kernels if another process is writing the entry, or was killed
    while writing it. A retry with another option uses another cache entry.
    """
    load_invoker()
    for attempt in range(3):
        options, programs = [f"-DATTEMPT_{attempt}"] if attempt else [], {}
        for program_source in source.programs.values():
            program = build(workspace, program_source.text, *options)
            for kernel in program.all_kernels():
                programs[kernel.function_name] = program
        if source.arguments.keys() <= programs.keys():
            return programs
    raise DeviceError(
        f"{workspace.info.title} returned a program without its kernels; the cache of compiled kernels may "
        f"be damaged; remove {pocl_folder()}"
    )


def compile_test_kernels(
    workspace: Workspace, file: str = "", text: str = "", lanes: int = 0, effects: Sequence[str] = ()
) -> dict[str, cl.Kernel]:
    """Compile a file below kernels/opencl/ or a text after prelude.cl and math.cl, like the stages. lanes:
    SIMD width; 0 for the device's. effects: files that fill hooks."""
    config = replace(workspace.config, lanes=lanes) if lanes else workspace.config
    built = build(workspace, assemble_test(file, config, workspace.info.float64, effects) + text)
    load_invoker()
    return {kernel.function_name: kernel for kernel in built.all_kernels()}


class BackgroundCompiler:
    """Compiles programs in background threads; a process that exits waits for the current one."""

    def __init__(self) -> None:
        self._threads: dict[Hashable, threading.Thread] = {}

    def begin(self, key: Hashable, compile: Callable[[], object]) -> None:
        """Start to compile. Errors are raised only when the program is needed and compiled again."""
        if key in self._threads:
            return
        # not in the thread: `build` changes the filters of all threads
        warnings.filterwarnings("ignore", category=cl.CompilerWarning)
        before = list(self._threads.values())

        def work() -> None:
            in_background.on = True
            for other in before:
                other.join()
            with suppress(FidsplatError, cl.Error):
                compile()

        self._threads[key] = thread = threading.Thread(target=work, name="fidsplat compiles", daemon=False)
        thread.start()

    def wait(self, key: Hashable) -> None:
        """Wait until the compilation of a key has ended, if it has begun."""
        thread = self._threads.get(key)
        if thread is not None and thread is not threading.current_thread():
            thread.join()
            self._threads.pop(key, None)
