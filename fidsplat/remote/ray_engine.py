"""Workers by Ray: actors on the machines of a cluster, each of which keeps what its items share."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from fidsplat import __version__
from fidsplat.remote.queue import WorkerLost
from fidsplat.util import interrupts
from fidsplat.util.errors import FidsplatError, InputError
from fidsplat.util.provenance import code_hash

Make = Callable[[], Callable[[Any], Any]]
"""plain data that a worker calls once; what it returns does an item"""


class Worker:
    """What runs in a process of the cluster."""

    def __init__(self) -> None:
        self._do: Callable[[Any], Any] | None = None

    def title(self, make: Make, asked_by: tuple[str, str]) -> str:
        """What draws here: `title` of what was made."""
        return self._made(make, asked_by).title

    def do(self, make: Make, asked_by: tuple[str, str], item: Any) -> tuple[str, str, Any]:
        """This host, what draws here, and what was made of an item."""
        made = self._made(make, asked_by)
        return socket.gethostname(), made.title, made(item)

    def _made(self, make: Make, asked_by: tuple[str, str]) -> Any:
        if self._do is None:
            if (here := identity()) != asked_by:
                raise InputError(
                    f"the worker on {socket.gethostname()} has fidsplat {here[0]}, code {here[1]}, and this "
                    f"is {asked_by[0]}, code {asked_by[1]}; install the same there"
                )
            self._do = make()
        return self._do


def identity() -> tuple[str, str]:
    """Version and code of fidsplat here: workers must have the same, or their pictures would be others."""
    return __version__, code_hash()


class RayEngine:
    """As `Engine`.

    Args:
        make: of what workers do; its result has a `title`, which must be the same everywhere.
        workers: how many; None: one for each GPU of the cluster, else one for each machine.
    """

    def __init__(self, make: Make, workers: int | None) -> None:
        ray = _ray()
        there = ray.cluster_resources()
        gpus, cores = int(there.get("GPU", 0)), int(there.get("CPU", 0))
        machines = sum(node["Alive"] for node in ray.nodes())
        self.workers = workers or gpus or machines
        # of what there are fewer of than workers several share one; what finds no place would wait for ever
        self._actor = ray.remote(Worker).options(
            num_cpus=_share(cores, self.workers),
            num_gpus=_share(gpus, self.workers),
            max_restarts=0,
            scheduling_strategy="SPREAD",
        )
        self._make, self._asked_by = ray.put(make), identity()
        self._actors: list[Any] = []
        self._spare: list[Any] = []
        first = self.start()
        self.title: str = self._get(first.title.remote(self._make, self._asked_by))
        """what draws"""
        self._spare.append(first)

    def start(self) -> Any:
        """A worker, which may still be on its way."""
        if self._spare:
            return self._spare.pop()
        self._actors.append(self._actor.remote())
        return self._actors[-1]

    def submit(self, worker: Any, item: Any) -> Any:
        """Give a worker an item; returns a ticket."""
        return worker.do.remote(self._make, self._asked_by, item)

    def wait(self, tickets: Sequence[Any]) -> Any:
        """The first of them that is done."""
        while not (done := _ray().wait(list(tickets), num_returns=1, timeout=interrupts.PERIOD)[0]):
            interrupts.check()
        return done[0]

    def result(self, ticket: Any) -> Any:
        """What was made of a ticket's item. Raises WorkerLost, FidsplatError."""
        host, title, result = self._get(ticket)
        if title != self.title:
            raise InputError(
                f"the worker on {host} draws with {title}, another with {self.title}, whose pictures differ "
                "in their last bits; name one kind with --device"
            )
        return result

    def close(self) -> None:
        """Let the workers go."""
        for actor in self._actors:
            _ray().kill(actor)

    def _get(self, ticket: Any) -> Any:
        from ray.exceptions import RayError, RayTaskError  # type: ignore[import-not-found]

        self.wait([ticket])
        try:
            return _ray().get(ticket)
        except RayTaskError as error:
            cause = error.cause
            if isinstance(cause, FidsplatError):
                raise cause from None
            raise FidsplatError(f"a worker failed with {type(cause).__name__}: {cause}") from error
        except RayError as error:  # killed, for its memory too, or its machine is gone with what it had made
            raise WorkerLost(" ".join(str(error).split())[:500]) from error


def _share(count: int, workers: int) -> float:
    """What of a core or a GPU a worker gets, so that all find a place."""
    return 1 / -(-workers // count) if count else 0


@contextmanager
def ray_engine(address: str, make: Make, workers: int | None = None) -> Iterator[RayEngine]:
    """Workers of the cluster at an address: `local` starts one on this machine, `auto` is the one that runs
    here, `ray://HOST:10001` or `HOST:6379` another.

    Raises:
        InputError: there is no such cluster, the extra `ray` is missing, workers have another fidsplat.
        FidsplatError: workers die before they begin.
    """
    ray = _ray()
    own = not ray.is_initialized()
    if own:
        try:
            ray.init(
                None if address == "local" else address,
                log_to_driver=False,
                logging_level=logging.ERROR,
                **({"include_dashboard": False} if address == "local" else {}),
            )
        except (ConnectionError, ValueError, RuntimeError, OSError) as error:
            why = " ".join(str(error).split())[:300]
            raise InputError(
                f"no Ray cluster at {address}: {why}; give --ray local, or ray://HOST:10001"
            ) from None
    try:
        try:
            engine = RayEngine(make, workers)
        except WorkerLost as error:
            raise FidsplatError(f"a worker died before it began: {error}") from error
        try:
            yield engine
        finally:
            engine.close()
    finally:
        if own:
            ray.shutdown()


def _ray() -> Any:
    try:
        import ray  # type: ignore[import-not-found]
    except ImportError:
        raise InputError("--ray needs Ray; pip install 'fidsplat[ray]', here and on the workers") from None
    return ray
