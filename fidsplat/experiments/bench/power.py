"""Energy meters: NVIDIA's GPUs by NVML or nvidia-smi, Intel's and AMD's processors by RAPL."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

RAPL = Path("/sys/class/powercap")


def energy_meter(kind: str) -> Callable[[], float] | None:
    """Function that returns the joules that a device of a kind, `gpu` or `cpu`, has used so far; None if the
    machine does not report them.

    GPU: the first GPU. Processor: all packages.
    """
    return _nvml() or _nvidia_smi() if kind == "gpu" else _rapl()


def _rapl(folder: Path = RAPL) -> Callable[[], float] | None:
    packages = [file for file in folder.glob("intel-rapl:*/energy_uj") if file.parent.name.count(":") == 1]

    def joules() -> float:
        return sum(int(file.read_text()) for file in packages) / 1e6

    try:
        return joules if packages and joules() > 0 else None
    except (OSError, ValueError):  # the counters may be readable by root only
        return None


def _nvml() -> Callable[[], float] | None:
    try:
        pynvml = import_module("pynvml")
        pynvml.nvmlInit()
        gpu = pynvml.nvmlDeviceGetHandleByIndex(0)
        pynvml.nvmlDeviceGetTotalEnergyConsumption(gpu)
    except Exception:  # no package, no driver, or a GPU without energy counter
        return None
    return lambda: pynvml.nvmlDeviceGetTotalEnergyConsumption(gpu) / 1e3


def _nvidia_smi() -> Callable[[], float] | None:
    """Energy meter that integrates the power draw at each call; None without nvidia-smi."""
    if shutil.which("nvidia-smi") is None:
        return None
    query = ("nvidia-smi", "-i", "0", "--query-gpu=power.draw", "--format=csv,noheader,nounits")
    state = {"joules": 0.0, "time": time.monotonic()}

    def joules() -> float:
        done = subprocess.run(query, capture_output=True, text=True, check=True)
        now = time.monotonic()
        state["joules"] += float(done.stdout) * (now - state["time"])
        state["time"] = now
        return state["joules"]

    try:
        joules()
    except (OSError, ValueError, subprocess.CalledProcessError):
        return None
    return joules
