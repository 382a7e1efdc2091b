"""Work queue for worker processes that may fail; every item is completed exactly once."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Hashable, Iterable, Iterator, Sequence
from typing import Any, Protocol, TypeVar

from fidsplat.util.errors import FidsplatError

ATTEMPTS = 3
"""number of lost workers after which an item is not tried again"""

Item = TypeVar("Item", bound=Hashable)


class WorkerLost(Exception):
    """The process of a worker has ended; the text is the cause, if known."""


class Engine(Protocol):
    """Starts workers and submits items to them."""

    def start(self) -> Any:
        """Start a worker, without waiting for it."""
        ...

    def submit(self, worker: Any, item: Any) -> Hashable:
        """Submit an item to a worker; returns a ticket."""
        ...

    def wait(self, tickets: Sequence[Any]) -> Any:
        """Wait for the first ticket whose item is done or whose worker is lost."""
        ...

    def result(self, ticket: Any) -> Any:
        """The result of a ticket's item.

        Raises:
            WorkerLost: its worker is lost.
            FidsplatError: the item cannot be processed.
        """
        ...


def drain(engine: Engine, items: Iterable[Item], workers: int) -> Iterator[tuple[Item, Any]]:
    """Yield every item with its result, in the order of completion. A worker processes one item at a time; if
    the worker is lost, another one receives the item.

    Raises:
        FidsplatError: an item cannot be processed, or `ATTEMPTS` workers are lost with it.
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
                    f"{item} has lost {ATTEMPTS} workers, the last one: {error}; completed results are kept"
                ) from error
            waiting.appendleft(item)
            continue
        idle.append(worker)
        yield item, result
