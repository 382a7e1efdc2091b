"""Progress as lines on stderr, for output that is redirected to a file or pipe."""

from __future__ import annotations

import contextlib
import sys
import threading
from typing import Any

from rich.console import Console
from rich.progress import Progress, Task, TaskID

PERIOD = 30.0
"""seconds between two lines"""


class ProgressLines(Progress):
    """rich's Progress with a line per task every 30 seconds instead of bars."""

    def __init__(self) -> None:
        super().__init__(console=Console(stderr=True))
        self._ended = threading.Event()

    def add_task(self, *words: Any, completed: int = 0, **options: Any) -> TaskID:
        """Add a task. completed: amount that an earlier run has completed."""
        return super().add_task(*words, completed=completed, first=completed, **options)

    def start(self) -> None:
        """Start a thread that prints, so that long work between two updates is reported too."""
        threading.Thread(target=self._print, name="progress", daemon=True).start()

    def stop(self) -> None:
        self._ended.set()

    def _print(self) -> None:
        while not self._ended.wait(PERIOD):
            with contextlib.suppress(OSError, ValueError):  # stderr is closed
                for task in self.tasks:
                    print(line_of(task), file=sys.stderr, flush=True)


def line_of(task: Task) -> str:
    """Description, completed amount and remaining time, as in `training: 200 of 700, 1 min 20 s left`."""
    elapsed, done = task.elapsed or 0.0, task.completed - task.fields["first"]
    if task.total is None:
        amount = f"{duration(elapsed)} so far"
    elif task.total > 1:
        amount = f"{task.completed:,.0f} of {task.total:,.0f}"
    else:
        amount = f"{100 * task.completed:.0f} %"
    if task.remaining is not None and done > 0:
        amount += f", {duration(max(elapsed * task.remaining / done, 0.0))} left"
    head = f"{task.description.strip()}: " if task.description.strip() else ""
    now = str(task.fields.get("now", "")).strip()
    return head + amount + (f" ({now})" if now else "")


def duration(seconds: float) -> str:
    """A duration as text: `45 s`, `12 min 5 s`, `3 h 20 min`."""
    total = round(seconds)
    if total < 60:
        return f"{total} s"
    if total < 3600:
        return f"{total // 60} min {total % 60} s"
    return f"{total // 3600} h {total % 3600 // 60} min"
