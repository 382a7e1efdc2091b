"""Launches that are made again and again, with hardly anything else from one time to the next."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, TypeAlias

import pyopencl as cl

from fidsplat.backends.opencl.declare import Argument
from fidsplat.backends.opencl.program import Program, put_argument
from fidsplat.backends.opencl.workspace import token_of

Launch: TypeAlias = tuple[Any, ...]
"""kernel, size, work-group, values of the arguments, and the first work-item where it is not 0"""


class _Place:
    """Where an argument goes."""

    __slots__ = ("mark", "takers")

    def __init__(self) -> None:
        self.takers: list[tuple[cl.Kernel, int, Any]] = []
        """kernels, with its places and types there"""
        self.mark: object = None
        """what it was last"""


class Launches:
    """A row of launches of one program, by kernels of its own whose arguments stay bound.

    It holds no buffers: who makes it knows how long those are there that were given (`BufferPool.state`).
    """

    def __init__(self, program: Program) -> None:
        self._program = program
        self._kernels: dict[str, cl.Kernel] = {}
        self._row: list[tuple[cl.Kernel, tuple[int, ...], tuple[int, ...], tuple[int, ...] | None]] = []
        self._places: dict[str, _Place] = {}
        """of the arguments that may change"""

    def arguments(self, kernel: str) -> tuple[Argument, ...]:
        """Of a kernel of the program."""
        return self._program.source.arguments[kernel]

    def keep(self, row: Sequence[Launch], changing: Collection[str]) -> None:
        """The launches from now on, each of another kernel. changing: names of arguments that `put` may
        change."""
        self._row = []  # an interrupt on the way leaves none
        self._places = {name: _Place() for name in changing}
        made = []
        for name, size, group, values, *first in row:
            if name not in self._kernels:
                self._kernels[name] = cl.Kernel(self._program.kernels[name].program, name)
            kernel = self._kernels[name]
            offset = (first[0], *(0 for _ in size[1:])) if first and first[0] else None
            made.append((kernel, size, group, offset))
            arguments = self.arguments(name)
            for index, (argument, value) in enumerate(zip(arguments, values, strict=True)):
                scalar = self._program.type_of(name, index)
                put_argument(kernel, index, value, scalar)
                if argument.name in self._places:
                    self._places[argument.name].takers.append((kernel, index, scalar))
        self._row = made

    def put(self, given: Mapping[str, Any]) -> None:
        """Sets those arguments that are others than the last time."""
        for name, value in given.items():
            place = self._places[name]
            # a buffer's token: what is remembered does not keep the buffer
            mark = token_of(value) if isinstance(value, cl.Buffer) else value
            if mark == place.mark:
                continue
            place.mark = None  # an interrupt on the way leaves it unknown
            for kernel, index, scalar in place.takers:
                put_argument(kernel, index, value, scalar)
            place.mark = mark

    def launch(self, queue: cl.CommandQueue) -> list[cl.Event]:
        """The launches in their order."""
        return [cl.enqueue_nd_range_kernel(queue, *one) for one in self._row]
