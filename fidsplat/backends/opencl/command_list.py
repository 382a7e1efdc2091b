"""Command lists: kernels with bound arguments that are recorded once and submitted many times."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pyopencl as cl

from fidsplat.backends.opencl.buffers import token_of
from fidsplat.backends.opencl.program import Program

_UNKNOWN = object()
"""value of an argument that is not bound, or whose binding was interrupted"""


class Command:
    """One kernel launch: its own kernel object with bound arguments, and its sizes."""

    __slots__ = ("_bound", "_types", "global_size", "kernel", "local_size", "name", "stage")

    def __init__(self, kernel: cl.Kernel, name: str, types: Sequence[Callable[[Any], Any] | None]) -> None:
        """types: the NumPy type of each argument; None for a buffer."""
        self.kernel, self.name, self._types = kernel, name, types
        self._bound: list[object] = [_UNKNOWN] * len(types)
        self.stage = ""
        self.global_size: tuple[int, ...] = ()
        self.local_size: tuple[int, ...] = ()

    def bind(self, index: int, value: Any) -> None:
        """Set an argument unless it already has this value: comparing is faster than setting."""
        scalar = self._types[index]
        identity: object = token_of(value) if scalar is None else value
        bound = self._bound[index]
        if identity is bound or (type(identity) is type(bound) and identity == bound):
            return
        self._bound[index] = _UNKNOWN  # an interrupt between the next two lines leaves the argument unknown
        if scalar is None:
            self.kernel.set_arg(index, value)
        else:  # faster than set_arg, which takes 20 times as long to find the type of a number
            self.kernel._set_arg_buf(index, scalar(value))  # pyright: ignore[reportAttributeAccessIssue]
        self._bound[index] = identity


class CommandList:
    """Kernel launches of one program, in order.

    `record` appends a launch, `launch` appends and submits it, `set` changes arguments by name in all
    launches, `submit` replays the list, `clear` starts another recording, which reuses the kernel objects and
    sets only arguments that differ. The list keeps no buffer alive: its owner compares
    `BufferPool.generation` before a replay.
    """

    def __init__(self, program: Program) -> None:
        self.program = program
        self._commands: list[Command] = []
        self._reusable: dict[str, list[Command]] = {}
        self._launch_counts: dict[str, int] = {}
        """number of launches of each kernel in this recording"""
        self._positions: dict[str, list[tuple[Command, int]]] = {}
        """result of `positions` by the argument's name"""
        self.key: Any = None
        """key for which the recording is valid, set by its owner; `clear` resets it"""

    @property
    def stages(self) -> list[str]:
        """Stage of each launch."""
        return [command.stage for command in self._commands]

    def clear(self) -> None:
        """Remove all commands, so that other launches can be appended."""
        self.key = None
        self._commands, self._launch_counts, self._positions = [], {}, {}

    def record(
        self,
        kernel: str,
        global_size: tuple[int, ...],
        local_size: tuple[int, ...],
        values: Sequence[Any],
        stage: str = "",
    ) -> Command:
        """Append a launch. values: buffers and numbers in the order of the kernel's arguments."""
        number = self._launch_counts.get(kernel, 0)
        commands = self._reusable.setdefault(kernel, [])
        if number == len(commands):
            kernel_object = cl.Kernel(self.program.programs[kernel], kernel)
            commands.append(Command(kernel_object, kernel, self.program.types[kernel]))
        command = commands[number]
        command.stage, command.global_size, command.local_size = stage, global_size, local_size
        for index, value in enumerate(values):
            command.bind(index, value)
        self._launch_counts[kernel] = number + 1
        self._commands.append(command)
        self._positions = {}
        return command

    def launch(
        self,
        queue: cl.CommandQueue,
        kernel: str,
        global_size: tuple[int, ...],
        local_size: tuple[int, ...],
        values: Sequence[Any],
        stage: str = "",
    ) -> cl.Event:
        command = self.record(kernel, global_size, local_size, values, stage)
        return cl.enqueue_nd_range_kernel(queue, command.kernel, global_size, local_size)

    def set(self, values: Mapping[str, Any]) -> None:
        """Change arguments by name, in all commands that have one of that name."""
        for name, value in values.items():
            positions = self._positions.get(name)
            if positions is None:
                positions = self._positions[name] = self.positions(name)
            for command, index in positions:
                command.bind(index, value)

    def submit(self, queue: cl.CommandQueue, first: int = 0, end: int | None = None) -> list[cl.Event]:
        """Enqueue the commands [first, end) in order; by default all."""
        return [
            cl.enqueue_nd_range_kernel(queue, command.kernel, command.global_size, command.local_size)
            for command in self._commands[first:end]
        ]

    def positions(self, name: str) -> list[tuple[Command, int]]:
        """Commands with an argument of that name, and its index."""
        arguments = self.program.source.arguments
        return [
            (command, index)
            for command in self._commands
            for index, argument in enumerate(arguments[command.name])
            if argument == name
        ]
