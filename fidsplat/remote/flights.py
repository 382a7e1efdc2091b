"""Rendering of flights by workers, which send image files to the caller, because they may not share a disk
with it."""

from __future__ import annotations

import pickle
import socket
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fidsplat.remote.queue import Engine, drain
from fidsplat.render.flight import Flight, FlightFolder
from fidsplat.render.output_files import save_output, suffixes_of
from fidsplat.render.renderer import Renderer
from fidsplat.store.store import Store
from fidsplat.util.errors import FidsplatError, InputError
from fidsplat.util.files import write_file

Files = dict[tuple[str, str], bytes]
"""bytes of an image's files by output and suffix"""


@dataclass(frozen=True, eq=False)
class FlightWork:
    """Picklable constructor of a worker's renderer of a flight. Workers read stores at the same path."""

    flight: Flight
    device: str
    memory_budget: int | None = None

    def __call__(self) -> FlightRenderer:
        return FlightRenderer(self)

    def __reduce__(self):
        stores = {str(store.path.resolve()): store.identity for store in self.flight.scene.stores}
        return PackedWork, (pickle.dumps(self.flight), stores, self.device, self.memory_budget)


@dataclass(frozen=True)
class PackedWork:
    """Pickled `FlightWork`; the worker checks the stores before it unpickles the flight."""

    flight: bytes
    stores: dict[str, str]
    """identities by path"""
    device: str
    memory_budget: int | None

    def __call__(self) -> FlightRenderer:
        """Open the device; raise InputError if a store is missing on the worker, or differs."""
        for path, identity in self.stores.items():
            try:
                same = Store(path).identity == identity
            except InputError as error:
                raise InputError(
                    f"workers must have access to all stores, got on {socket.gethostname()}: {error}; copy "
                    "the store there, or render without --ray"
                ) from None
            if not same:
                raise InputError(
                    f"{path} on {socket.gethostname()} must be the same store as here, got another; copy it "
                    "there, or render without --ray"
                )
        return FlightWork(pickle.loads(self.flight), self.device, self.memory_budget)()


class FlightRenderer:
    """Renderer of a flight's frames, with the splats on the device."""

    def __init__(self, work: FlightWork) -> None:
        self._flight = work.flight
        self._renderer = Renderer(work.device, work.memory_budget)
        self._resident = self._renderer.upload(work.flight.scene)
        self.title = self._renderer.device.title

    def __call__(self, k: int) -> Files:
        flight = self._flight
        frame = self._renderer.render(self._resident, flight.captures[k])
        contents: Files = {}
        with tempfile.TemporaryDirectory() as folder:
            for name in frame.outputs:
                files: dict[Path, str] = {}

                def place(output: str, suffix: str, files: dict[Path, str] = files) -> Path:
                    files[path := Path(folder, f"{output}{suffix}")] = suffix
                    return path

                save_output(name, frame[name], place, flight.capture.sensor.bits)
                contents |= {(name, suffix): path.read_bytes() for path, suffix in files.items()}
        return contents


def render_flight(folder: FlightFolder, engine: Engine, workers: int) -> Iterator[int]:
    """Render the missing frames of a flight on workers, write their files, and yield the number of each
    completed frame. Raises FidsplatError like `drain`."""
    for k, files in drain(engine, folder.remaining(), workers):
        for (name, suffix), content in _checked(files, k, folder.flight.capture.outputs).items():
            write_file(folder.file(k, name, suffix), content)
        yield k


def _checked(files: Any, k: int, outputs: Sequence[str]) -> Files:
    """The files of frame k from a worker. Raises FidsplatError for anything else."""
    expected = {(name, suffix) for name in outputs for suffix in suffixes_of(name)}
    complete = isinstance(files, dict) and files.keys() == expected
    if not complete or not all(isinstance(content, bytes) and content for content in files.values()):
        raise FidsplatError(
            f"the reply of a worker must be the files of the outputs of image {k}, got other data; "
            "install the same fidsplat there"
        )
    return files
