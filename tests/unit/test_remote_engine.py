"""The engine of Ray by a module in its place, which does work in this process: Ray itself is an extra."""

import sys
from types import ModuleType, SimpleNamespace

import pytest

import fidsplat as fs
from fidsplat.remote.queue import WorkerLost, drain
from fidsplat.remote.ray_engine import ray_engine


class TaskError(Exception):
    def __init__(self, cause):
        super().__init__(str(cause))
        self.cause = cause


class GoneError(Exception):
    pass


class Ticket:
    def __init__(self, value=None, error=None):
        self.value, self.error = value, error


class Actor:
    """A replacement of Ray that calls immediately; its results are tickets."""

    def __init__(self, worker):
        for name in ("do", "title"):
            setattr(self, name, SimpleNamespace(remote=self._call(getattr(worker, name))))

    def _call(self, method):
        def call(make, *words):
            try:
                return Ticket(method(make, *words))
            except Exception as error:
                return Ticket(error=error)

        return call


@pytest.fixture
def cluster(monkeypatch):
    """Two machines with three processors."""
    ray, errors = ModuleType("ray"), ModuleType("ray.exceptions")
    errors.RayError, errors.RayTaskError = GoneError, TaskError
    record = SimpleNamespace(options=[], killed=[], actors=[], address="none", shut=0)

    def get(ticket):
        if isinstance(ticket.error, GoneError):
            raise ticket.error
        if ticket.error is not None:
            raise TaskError(ticket.error)
        return ticket.value

    def start(worker):
        record.actors.append(Actor(worker()))
        return record.actors[-1]

    def remote(worker):
        def options(**given):
            record.options.append(given)
            return SimpleNamespace(remote=lambda: start(worker))

        return SimpleNamespace(options=options)

    ray.exceptions, ray.get, ray.remote = errors, get, remote
    ray.put, ray.kill = lambda value: value, record.killed.append
    ray.wait = lambda tickets, **_: ([tickets[-1]], tickets[:-1])
    ray.cluster_resources = lambda: {"CPU": 3.0}
    ray.nodes = lambda: [{"Alive": True}, {"Alive": True}, {"Alive": False}]
    ray.is_initialized = lambda: False
    ray.init = lambda address, **_: setattr(record, "address", address)
    ray.shutdown = lambda: setattr(record, "shut", record.shut + 1)
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setitem(sys.modules, "ray.exceptions", errors)
    return record


def work(do, titles=("a device",)):
    """Results of workers: the n-th worker has the n-th title, all further ones the last."""
    results = []

    def make():
        title = titles[min(len(results), len(titles) - 1)]
        results.append(SimpleNamespace(title=title))
        doer = do

        class Doer:
            def __call__(self, item):
                return doer(item)

        doing = Doer()
        doing.title = title
        return doing

    return make


def test_items_reach_workers_and_results_come_back(cluster):
    with ray_engine("ray://there:10001", work(lambda item: 10 * item)) as engine:
        assert engine.title == "a device"
        assert engine.workers == 2  # machines that are alive, as there is no GPU
        assert sorted(drain(engine, range(7), engine.workers)) == [(k, 10 * k) for k in range(7)]
    assert cluster.address == "ray://there:10001"
    assert cluster.options[0]["num_cpus"] == 1
    assert cluster.options[0]["num_gpus"] == 0
    assert cluster.killed == cluster.actors
    assert len(cluster.actors) == 2
    assert cluster.shut == 1


def test_one_machine_is_not_an_address(cluster):
    with ray_engine("local", work(str), workers=7) as engine:
        assert cluster.address is None
        assert engine.workers == 7
        assert cluster.options[0]["num_cpus"] == pytest.approx(1 / 3)


def fails(error):
    def do(item):
        raise error

    return do


def test_errors_of_workers(cluster):
    for error, kind, words in (
        (fs.InputError("no such store"), fs.InputError, "^no such store$"),
        (ZeroDivisionError("by zero"), fs.FidsplatError, "a worker failed with ZeroDivisionError: by zero"),
        (GoneError("killed\nfor its memory"), WorkerLost, "^killed for its memory$"),
    ):
        with ray_engine("local", work(fails(error))) as engine:
            ticket = engine.submit(engine.start(), 1)
            with pytest.raises(kind, match=words):
                engine.result(engine.wait([ticket]))


def test_workers_with_another_device_are_refused(cluster):
    with ray_engine("local", work(str, ("a device", "another"))) as engine:
        first, second = engine.start(), engine.start()
        assert engine.result(engine.submit(first, 1)) == "1"
        with pytest.raises(fs.InputError, match=r"must render with a device, .* got another"):
            engine.result(engine.submit(second, 1))


def test_workers_with_other_code_are_refused(cluster, monkeypatch):
    identities = iter([("1", "here"), ("1", "there")])
    monkeypatch.setattr("fidsplat.remote.ray_engine.identity", lambda: next(identities))
    with (
        pytest.raises(fs.InputError, match="must have fidsplat 1 with code here, got 1 with code there"),
        ray_engine("local", work(str)),
    ):
        pass
