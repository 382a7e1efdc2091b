"""A queue of work for processes that may die: every item is done, none twice."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Hashable, Iterable, Iterator, Sequence
from typing import Any, Protocol, TypeVar

from fidsplat.util.errors import FidsplatError

ATTEMPTS = 3
"""workers that an item may lose before it is the item that is at fault"""

Item = TypeVar("Item", bound=Hashable)


class WorkerLost(Exception):
    """The process that had an item is gone; its text says what is known of it."""


class Engine(Protocol):
    """Starts workers and hands them items."""

    def start(self) -> Any:
        """A worker, which may still be on its way."""
        ...

    def submit(self, worker: Any, item: Any) -> Hashable:
        """Give a worker an item; returns a ticket."""
        ...

    def wait(self, tickets: Sequence[Any]) -> Any:
        """The first of them whose item is done, or whose worker is gone."""
        ...

    def result(self, ticket: Any) -> Any:
        """What was made of a ticket's item.

        Raises:
            WorkerLost: its worker died.
            FidsplatError: the item cannot be done, by no worker.
        """
        ...


def drain(engine: Engine, items: Iterable[Item], workers: int) -> Iterator[tuple[Item, Any]]:
    """Every item with what was made of it, in the order in which they are done. A worker has one item at a
    time; where it dies another takes its place and its item.

    Raises:
        FidsplatError: an item cannot be done, or has lost `ATTEMPTS` workers.
    """
    waiting, lost = deque(items), Counter()
    idle: list[Any] = []
    running: dict[Any, tuple[Any, Item]] = {}
    while waiting or running:
        while waiting and len(running) < workers:
            item = waiting.popleft()
            worker = idle.pop() if idle else engine.start()
            running[engine.submit(worker, item)] = worker, item
        ticket = engine.wait(list(running))
        worker, item = running.pop(ticket)
        try:
            result = engine.result(ticket)
        except WorkerLost as error:
            lost[item] += 1
            if lost[item] == ATTEMPTS:
                raise FidsplatError(
                    f"{item} has lost {ATTEMPTS} workers, the last of which: {error}; what was done before "
                    "stays"
                ) from error
            waiting.appendleft(item)
            continue
        idle.append(worker)
        yield item, result
