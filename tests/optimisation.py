"""Tests compile kernels for CPUs with little optimisation, in half the time and with the same bits
(tests/compile/test_optimised.py). `pytest --optimised` compiles them as users do.

A plugin of pytest, which conftest.py names.
"""

import gc
import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

import fidsplat as fs
from fidsplat.backends.warp import runtime

_OPENCL = {"PYOPENCL_BUILD_OPTIONS": "-cl-opt-disable"}
"""read by pyopencl at each build, and by processes that tests start"""


def pytest_addoption(parser):
    words = "compile kernels as users do; without it they are hardly optimised, unless there is a GPU"
    parser.addoption("--optimised", action="store_true", help=words)


def pytest_configure(config):
    if not config.getoption("--optimised") and not _has_gpu():
        compile_quickly()


def compile_quickly() -> None:
    """From now on this process compiles with hardly any optimisation."""
    os.environ.update(_OPENCL)
    if runtime.installed():
        config = runtime.load().config
        # and without its thresholds for inlining. Level 0 compiles in yet half the time, but there an image
        # of 320 x 240 pixels takes 3 s
        config.optimization_level, config.cpu_compiler_flags = 1, "-march=native"
        # so 0 is for what runs once per splat or once per pixel, more than half of all that is compiled
        for name in (
            "project",
            "project_backward",
            "tile_lists",
            "resolve",
            "sensor",
            "background",
            "shutter",
        ):
            module = runtime.kernels(name)
            module.STRICT = {**module.STRICT, "optimization_level": 0}
        _memoise_overloads()
        _one_instance()


def _memoise_overloads() -> None:
    """Warp compares the types of an argument list with each overload of a builtin function anew at each call,
    30 times as often as there are different ones."""
    codegen = importlib.import_module("warp._src.codegen")
    if not hasattr(codegen, "func_match_args") or hasattr(codegen.func_match_args, "cache_of_tests"):
        return
    match, results = codegen.func_match_args, {}

    def matches(function, types, named, *further, **options):
        try:
            stripped = map(codegen.strip_reference, types)
            key = function, (*stripped,), *named.items(), *further, *options.items()
            known = results.get(key)
        except TypeError:  # a type that cannot be a key
            return match(function, types, named, *further, **options)
        if known is None:
            known = results[key] = match(function, types, named, *further, **options)
        return known

    matches.cache_of_tests = results
    codegen.func_match_args = matches


def _one_instance() -> None:
    """Warp compiles a kernel twice: for any arrays, and for contiguous arrays, where it is faster. The
    first version serves both, and is compiled in seven eighths of the time."""
    codegen = importlib.import_module("warp._src.codegen")
    for name in ("cpu_linear_contiguous_specialization_candidate", "cpu_linear_tid_specialization_candidate"):
        if hasattr(codegen, name):
            setattr(codegen, name, lambda *_: False)


def pytest_collection_finish():
    # Warp makes and drops syntax trees while it compiles: going through all tests' objects each time that the
    # interpreter looks for garbage would take a sixth of that
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)


@contextmanager
def as_users_compile() -> Iterator[None]:
    """Within it OpenCL kernels are compiled as users have them, and in processes that it starts all are."""
    variables = {name: os.environ.pop(name) for name in _OPENCL if name in os.environ}
    try:
        yield
    finally:
        os.environ.update(variables)


@pytest.fixture
def optimised():
    """For tests of large images, which PoCL renders more slowly than it compiles: within
    `as_users_compile`."""
    with as_users_compile():
        yield


def level() -> str:
    """How this process compiles kernels."""
    warp = runtime.load().config.optimization_level if runtime.installed() else None
    actual = (os.environ.get("PYOPENCL_BUILD_OPTIONS"), warp)
    return "as users have it" if actual == (None, None) else "hardly"


def _has_gpu() -> bool:
    return any(info.usable and info.kind == "gpu" for info in fs.devices())
