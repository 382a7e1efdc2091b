"""Workers of a Ray cluster: actors, each with the state that its items share."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from fidsplat import __version__
from fidsplat.remote.queue import WorkerLost
from fidsplat.util import interrupts
from fidsplat.util.errors import FidsplatError, InputError, required_package
from fidsplat.util.provenance import code_hash

Make = Callable[[], Callable[[Any], Any]]
"""picklable object that a worker calls once; it returns the function that processes an item"""


class Worker:
    """Ray actor that processes items."""

    def __init__(self) -> None:
        self._do: Callable[[Any], Any] | None = None

    def title(self, make: Make, caller: tuple[str, str]) -> str:
        """Title of the device of this worker."""
        return self._open(make, caller).title

    def do(self, make: Make, caller: tuple[str, str], item: Any) -> tuple[str, str, Any]:
        """Host name, title of the device, and result of an item."""
        work = self._open(make, caller)
        return socket.gethostname(), work.title, work(item)

    def _open(self, make: Make, caller: tuple[str, str]) -> Any:
        if self._do is None:
            if (here := identity()) != caller:
                raise InputError(
                    f"the worker on {socket.gethostname()} must have fidsplat {caller[0]} with code "
                    f"{caller[1]}, got {here[0]} with code {here[1]}; install the same version there"
                )
            self._do = make()
        return self._do


def identity() -> tuple[str, str]:
    """Version and code hash of fidsplat, which must be equal on all workers, so that their images agree."""
    return __version__, code_hash()


class RayEngine:
    """Engine (`fidsplat.remote.queue`) that processes items on the workers of a Ray cluster.

    Args:
        make: called once by each worker; returns the function that processes an item. The function has the
            attribute `title`, which must be equal on all workers.
        workers: number of workers; None for one per GPU of the cluster, else one per machine.
    """

    def __init__(self, make: Make, workers: int | None) -> None:
        ray = _ray()
        there = ray.cluster_resources()
        gpus, cores = int(there.get("GPU", 0)), int(there.get("CPU", 0))
        machines = sum(node["Alive"] for node in ray.nodes())
        self.workers = workers or gpus or machines
        # fractions of fewer cores and GPUs, as Ray never starts an actor without its resources
        self._actor = ray.remote(Worker).options(
            num_cpus=_per_worker(cores, self.workers),
            num_gpus=_per_worker(gpus, self.workers),
            max_restarts=0,
            scheduling_strategy="SPREAD",
        )
        self._make, self._caller = ray.put(make), identity()
        self._actors: list[Any] = []
        self._spare: list[Any] = []
        first = self.start()
        self.title: str = self._get(first.title.remote(self._make, self._caller))
        """title of the device"""
        self._spare.append(first)

    def start(self) -> Any:
        """Start a worker, without waiting for it."""
        if self._spare:
            return self._spare.pop()
        self._actors.append(self._actor.remote())
        return self._actors[-1]

    def submit(self, worker: Any, item: Any) -> Any:
        """Submit an item to a worker; returns a ticket."""
        return worker.do.remote(self._make, self._caller, item)

    def wait(self, tickets: Sequence[Any]) -> Any:
        """The first ticket that is done."""
        while not (done := _ray().wait(list(tickets), num_returns=1, timeout=interrupts.PERIOD)[0]):
            interrupts.check()
        return done[0]

    def result(self, ticket: Any) -> Any:
        """The result of a ticket's item. Raises WorkerLost or FidsplatError."""
        host, title, result = self._get(ticket)
        if title != self.title:
            raise InputError(
                f"all workers must render with {self.title}, as images of other devices differ in their last "
                f"bits, got {title} on {host}; select one device with --device"
            )
        return result

    def close(self) -> None:
        """Stop the workers."""
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
        except RayError as error:  # killed, out of memory, or its machine is gone
            raise WorkerLost(" ".join(str(error).split())[:500]) from error


def _per_worker(count: int, workers: int) -> float:
    """Fraction of a core or GPU per worker, so that all workers can run."""
    return 1 / -(-workers // count) if count else 0


@contextmanager
def ray_engine(address: str, make: Make, workers: int | None = None) -> Iterator[RayEngine]:
    """Context with the workers of a cluster.

    address: `local` starts a cluster on this machine, `auto` connects to the running cluster of this machine,
    `ray://HOST:10001` or `HOST:6379` to that of another.

    Raises:
        InputError: no such cluster, the extra `ray` is missing, or workers have another version of fidsplat.
        FidsplatError: workers end while they start.
    """
    ray = _ray()
    is_own = not ray.is_initialized()
    if is_own:
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
                f"--ray must be the address of a Ray cluster, got {address}: {why}; for example local, or "
                "ray://HOST:10001"
            ) from None
    try:
        try:
            engine = RayEngine(make, workers)
        except WorkerLost as error:
            raise FidsplatError(
                f"a worker died while it started: {error}; check that fidsplat works on its machine"
            ) from error
        try:
            yield engine
        finally:
            engine.close()
    finally:
        if is_own:
            ray.shutdown()


def _ray() -> Any:
    with required_package("Ray", "ray"):
        import ray  # type: ignore[import-not-found]
    return ray
