"""Process of one renderer in `fidsplat bench --suite`.

    python -P adapter.py FILE.py [DEVICE]

FILE.py defines a class `Adapter` (benchmarks/adapters/README.md). This file imports only NumPy, so that the
environment of another renderer does not need fidsplat. Requests are JSON lines on stdin, responses JSON lines
on stdout; other output of libraries is redirected to stderr. A response has `error` if the renderer failed.
"""

from __future__ import annotations

import json
import os
import resource
import runpy
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

WARM_UP = 0.01
"""seconds of untimed submissions before a timed submission"""


class Server:
    """Executes requests with an adapter. A request is a dict with the name of a method as `do`."""

    def __init__(self, adapter: Any) -> None:
        self.adapter = adapter
        self.rendered: Any = None

    def load(self, file: str) -> dict:
        """Load a scene into the adapter, which copies it to the device."""
        with np.load(file) as arrays:
            scene = {name: arrays[name] for name in arrays.files}
        self.rendered = None
        begun = time.perf_counter()
        self.adapter.load(scene)
        return {"load_ms": 1e3 * (time.perf_counter() - begun)}

    def frame(self, setting: str, views: list[int], before: list[list[int]] | None = None) -> dict:
        """Render views as one submission, after untimed submissions `before`, which are repeated for WARM_UP
        seconds. Returns milliseconds until completion, and processor time."""
        if before:
            self._repeat(setting, before, WARM_UP)
        begun, busy = time.perf_counter(), time.process_time()
        self.rendered = self.adapter.render(setting, views)
        times = {"ms": 1e3 * (time.perf_counter() - begun), "cpu_ms": 1e3 * (time.process_time() - busy)}
        device = getattr(self.adapter, "device_ms", None)
        return times if device is None else times | {"device_ms": device(self.rendered)}

    def image(self, file: str) -> dict:
        """Write the images of the latest frame (v, h, w, 3); returns the renderer's memory in bytes."""
        np.save(file, np.asarray(self.adapter.read(self.rendered), np.float32))
        device = getattr(self.adapter, "memory", lambda: None)()
        if device is not None:
            return {"memory_bytes": device, "memory_of": "device"}
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        return {"memory_bytes": peak, "memory_of": "process"}

    def burst(self, setting: str, views: list[int], seconds: float) -> dict:
        """Render the same views repeatedly; returns the number of submissions and their seconds."""
        begun = time.perf_counter()
        count = self._repeat(setting, [views], seconds)
        return {"submissions": count, "seconds": time.perf_counter() - begun}

    def _repeat(self, setting: str, submissions: list[list[int]], seconds: float) -> int:
        """Render submissions in turn until the time has passed; returns their number."""
        end, count = time.perf_counter() + seconds, 0
        while time.perf_counter() < end:
            self.adapter.render(setting, submissions[count % len(submissions)])
            count += 1
        return count


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def answer(content: dict) -> None:
        print(json.dumps(content), file=answers, flush=True)

    sys.path.append(str(Path(sys.argv[1]).parents[1]))  # modules that adapters share
    try:
        adapter = runpy.run_path(sys.argv[1])["Adapter"](*sys.argv[2:])
        answer({"facts": adapter.facts, "settings": adapter.settings})
    except (Exception, SystemExit) as error:  # no GPU, package or compiler: the renderer is skipped
        answer({"skipped": f"{type(error).__name__}: {error}".splitlines()[0]})
        return
    server = Server(adapter)
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer(getattr(server, request.pop("do"))(**request))
        except Exception as error:
            answer({"error": f"{type(error).__name__}: {error}".splitlines()[0]})


if __name__ == "__main__":
    main()
