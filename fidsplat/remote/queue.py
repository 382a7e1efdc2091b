"""Work queue for worker processes that may die; every item is completed exactly once."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Hashable, Iterable, Iterator, Sequence
from typing import Any, Protocol, TypeVar

from fidsplat.util.errors import FidsplatError

ATTEMPTS = 3
"""number of lost workers after which an item counts as the cause"""

Item = TypeVar("Item", bound=Hashable)


class WorkerLost(Exception):
    """The process of an item died; the text is the known cause."""


class Engine(Protocol):
    """Starts workers and submits items to them."""

    def start(self) -> Any:
        """Start a worker; it may still be starting."""
        ...

    def submit(self, worker: Any, item: Any) -> Hashable:
        """Submit an item to a worker; returns a ticket."""
        ...

    def wait(self, tickets: Sequence[Any]) -> Any:
        """The first ticket whose item is done or whose worker died."""
        ...

    def result(self, ticket: Any) -> Any:
        """The result of a ticket's item.

        Raises:
            WorkerLost: its worker died.
            FidsplatError: no worker can do the item.
        """
        ...


def drain(engine: Engine, items: Iterable[Item], workers: int) -> Iterator[tuple[Item, Any]]:
    """Yield every item with its result, in the order of completion. A worker has one item at a time; if it
    dies, a new worker gets the item.

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
                    f"{item} has lost {ATTEMPTS} workers, the last one: {error}; completed results are kept"
                ) from error
            waiting.appendleft(item)
            continue
        idle.append(worker)
        yield item, result
