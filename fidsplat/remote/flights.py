"""Flights that are drawn by workers: pictures come back as the bytes of their files, as no disk is shared."""

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
from fidsplat.util.files import atomic_write

Files = dict[tuple[str, str], bytes]
"""content of a picture's files by output and suffix"""


@dataclass(frozen=True, eq=False)
class FlightWork:
    """What a worker needs to draw pictures of a flight; called there, it opens the device. Stores are not
    sent: a worker reads them where they are here."""

    flight: Flight
    device: str
    memory_budget: int | None = None

    def __call__(self) -> FlightDrawer:
        return FlightDrawer(self)

    def __reduce__(self):
        stores = {str(store.path.resolve()): store.identity for store in self.flight.scene.stores}
        return PackedWork, (pickle.dumps(self.flight), stores, self.device, self.memory_budget)


@dataclass(frozen=True)
class PackedWork:
    """Work as it is sent. It is unpacked where it is called, so that what is missing there can be said."""

    flight: bytes
    stores: dict[str, str]
    """identities by path"""
    device: str
    memory_budget: int | None

    def __call__(self) -> FlightDrawer:
        """Raises InputError where a store is not at its path, or another one is."""
        for path, identity in self.stores.items():
            try:
                same = Store(path).identity == identity
            except InputError as error:
                raise InputError(
                    f"workers read stores from a disk that they share, and on {socket.gethostname()} "
                    f"{error}; put it there, or draw without --ray"
                ) from None
            if not same:
                raise InputError(
                    f"on {socket.gethostname()} {path} is another store than here; put the same there, or "
                    "draw without --ray"
                )
        return FlightWork(pickle.loads(self.flight), self.device, self.memory_budget)()


class FlightDrawer:
    """Draws pictures of a flight, whose splats stay on the device."""

    def __init__(self, work: FlightWork) -> None:
        self._flight = work.flight
        self._renderer = Renderer(work.device, work.memory_budget)
        self._resident = self._renderer.upload(work.flight.scene)
        self.title = self._renderer.device.title

    def __call__(self, k: int) -> Files:
        """The files of picture k."""
        flight = self._flight
        frame = self._renderer.render(self._resident, flight.captures[k])
        found: Files = {}
        with tempfile.TemporaryDirectory() as folder:
            for name in frame.outputs:
                files: dict[Path, str] = {}

                def place(output: str, suffix: str, files: dict[Path, str] = files) -> Path:
                    files[path := Path(folder, f"{output}{suffix}")] = suffix
                    return path

                save_output(name, frame[name], place, flight.capture.sensor.bits)
                found |= {(name, suffix): path.read_bytes() for path, suffix in files.items()}
        return found


def draw(folder: FlightFolder, engine: Engine, workers: int) -> Iterator[int]:
    """Let workers draw what is left of a flight; yields the number of each picture once its files are whole
    here. Raises FidsplatError as `drain` does."""
    for k, files in drain(engine, folder.left(), workers):
        for (name, suffix), content in _checked(files, k, folder.flight.capture.outputs).items():
            with atomic_write(folder.file(k, name, suffix)) as stream:
                stream.write(content)
        yield k


def _checked(files: Any, k: int, outputs: Sequence[str]) -> Files:
    """What a worker sent of picture k. Raises FidsplatError for anything but the files of its outputs."""
    wanted = {(name, suffix) for name in outputs for suffix in suffixes_of(name)}
    whole = isinstance(files, dict) and files.keys() == wanted
    if not whole or not all(isinstance(content, bytes) and content for content in files.values()):
        raise FidsplatError(
            f"the reply of a worker must be the files of the outputs of image {k}, got something else; "
            "install the same fidsplat there"
        )
    return files
