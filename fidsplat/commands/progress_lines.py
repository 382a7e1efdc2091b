"""Progress as lines on stderr, for output that is redirected to a file or pipe."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from dataclasses import dataclass, field
from typing import Any

PERIOD = 30.0
"""seconds between two lines"""


@dataclass
class Task:
    """A task and its progress."""

    description: str
    total: float | None
    """None: unknown"""
    completed: float
    fields: dict[str, Any]
    first: float = field(init=False)
    begun: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.first = self.completed

    def line(self) -> str:
        """Description, amount done and time left, for example `training: 200 of 700, 1 min 20 s left`."""
        elapsed, done = time.monotonic() - self.begun, self.completed - self.first
        if self.total is None:
            amount = f"{duration(elapsed)} so far"
        elif self.total > 1:
            amount = f"{self.completed:,.0f} of {self.total:,.0f}"
        else:
            amount = f"{100 * self.completed:.0f} %"
        if self.total is not None and done > 0:
            amount += f", {duration(max(elapsed * (self.total - self.completed) / done, 0.0))} left"
        head = f"{self.description.strip()}: " if self.description.strip() else ""
        now = str(self.fields.get("now", "")).strip()
        return head + amount + (f" ({now})" if now else "")


class ProgressLines:
    """A line on stderr every 30 seconds, with the interface of rich's Progress."""

    def __init__(self) -> None:
        self._tasks: list[Task] = []
        self._ended: threading.Event | None = None

    def add_task(self, description: str, total: float | None, completed: float = 0.0, **fields: Any) -> int:
        """Add a task; returns its number."""
        self._tasks.append(Task(description, total, completed, fields))
        return len(self._tasks) - 1

    def update(
        self,
        number: int,
        *,
        completed: float | None = None,
        advance: float = 0.0,
        description: str | None = None,
        **fields: Any,
    ) -> None:
        """Update the progress, description or fields of a task."""
        task = self._tasks[number]
        task.completed = (task.completed if completed is None else completed) + advance
        task.description = task.description if description is None else description
        task.fields |= fields

    def advance(self, number: int, advance: float = 1.0) -> None:
        """Advance a task."""
        self.update(number, advance=advance)

    def start(self) -> None:
        """Start printing, by a thread, so that long work between two updates is also reported."""
        self._ended = threading.Event()
        threading.Thread(target=self._print, args=(self._ended,), name="progress", daemon=True).start()

    def stop(self) -> None:
        """Stop printing."""
        if self._ended is not None:
            self._ended.set()

    def __enter__(self) -> ProgressLines:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def _print(self, ended: threading.Event) -> None:
        while not ended.wait(PERIOD):
            with contextlib.suppress(OSError, ValueError):  # stderr is closed
                for task in self._tasks:
                    print(task.line(), file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """A time in words: `45 s`, `12 min 5 s`, `3 h 20 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
