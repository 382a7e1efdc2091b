"""The command line: words in, a command run, an exit status out.

0: done. 1: the run failed. 2: the words or the input cannot be used. Errors are one line on stderr.
"""

import contextlib
import errno
import inspect
import io
import os
import re
import sys
import traceback
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from fidsplat.commands import COMMANDS, CommandTable
from fidsplat.util import interrupts
from fidsplat.util.process_limits import check_imports

ABOUT = """Fiducial markers made of 2D Gaussian splats: make them, set them in scenes, draw them, read them
back.

Examples:
  fidsplat demo                                     all of it, end to end, with pictures and a table
  fidsplat devices                                  what can draw here
  fidsplat marker apriltag:36h11:5 -o tag.ply       a marker as a splat file
  fidsplat render scene.toml -o picture.png         draw a scene
  fidsplat view scene.toml                          look at it in a browser
  fidsplat detect picture.png --scene scene.toml    read it back, with poses
  fidsplat bench                                    what a frame costs here
  fidsplat tradeoff --quick                         what accuracy costs in time
  fidsplat train photos -o scene.ply                splats from pictures with known cameras

`fidsplat COMMAND --help` explains a command. --debug, anywhere, shows where an error arose; --version, alone,
says which fidsplat this is."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status: 0 done, 1 failed, 2 bad input, 130 interrupted, 143
    terminated."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    _open_missing_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that lacks a sign is no reason to stop
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    try:
        with warnings.catch_warnings(), interrupts.handled():
            warnings.showwarning = _show_warning
            interrupts.check()
            try:
                check_imports()
                command = _parse(words)
                interrupts.check()
                status = command.run()
            except Exception:
                interrupts.check()  # it may be a consequence of the signal
                raise
            interrupts.check()
        sys.stdout.flush()
        return status
    except SystemExit as stop:  # help, or words that could not be parsed
        return stop.code if isinstance(stop.code, int) else 2
    except KeyboardInterrupt as stop:
        if not debug:  # what was stopped while it was made may complain when it is thrown away
            sys.unraisablehook = lambda _: None
        terminated = isinstance(stop, interrupts.Terminated)
        return _fail(*(("terminated", 143) if terminated else ("interrupted", 130)))
    except BrokenPipeError:
        _drop_output()  # whoever read it has gone; nothing is left to say to them
        return 1
    except Exception as error:
        if debug:
            traceback.print_exc()
        from fidsplat.util.errors import FidsplatError

        if isinstance(error, FidsplatError):
            return _fail(str(error), error.exit_status)
        if (
            isinstance(error, MemoryError)
            or getattr(error, "errno", None) == errno.ENOMEM
            or (isinstance(error, ImportError) and "failed to map segment" in str(error))
        ):
            return _fail("not enough memory for this; use a smaller picture or fewer splats", 1)
        if isinstance(error, OSError) and error.errno in _SHORTAGES:
            _drop_output()
            where = f" ({error.filename})" if error.filename else ""
            return _fail(f"{error.strerror}{where}; {_SHORTAGES[error.errno]}", 1)
        return _fail(f"{type(error).__name__}: {error} (a fault of fidsplat; --debug shows where)", 1)


_SHORTAGES = {
    errno.ENOSPC: "make room there, or on what the output goes to",
    errno.EDQUOT: "make room there, or on what the output goes to",
    errno.EFBIG: "files may not be larger here; see ulimit -f",
    errno.EROFS: "give a folder that can be written",
    errno.EMFILE: "a process may not have more files open here; see ulimit -n",
    errno.ENFILE: "the system may not have more files open",
    errno.EIO: "the disk or the terminal fails",
}
"""what a machine may lack anywhere, and what would help"""


def _open_missing_streams() -> None:
    """Where stdin, stdout or stderr was closed, the next file that is opened would take its place, and what
    is printed would go into that."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            # the lowest descriptor that is free, which is the one that is missing
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115 it stays open


def _drop_output() -> None:
    """Say no more on stdout, not even by Python at its end."""
    with contextlib.suppress(OSError, ValueError):  # what has no descriptor is not flushed there either
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _parse(words: list[str]):
    """The command object of the words. Raises SystemExit: 0 after help or the version, 2 after one line about
    what is wrong."""
    import tyro

    from fidsplat import __version__
    from fidsplat.commands.output import optional_values
    from fidsplat.util.errors import InputError, unknown

    if not words:
        raise InputError(
            "no command; try `fidsplat demo` first, which makes, draws and reads markers here, then "
            "`fidsplat view fidsplat-demo/scene.toml`; "
            f"`fidsplat --help` explains: {', '.join(COMMANDS)}"
        )
    if words == ["--version"]:
        print(f"fidsplat {__version__}")
        raise SystemExit(0)
    known: Mapping[str, type] = COMMANDS
    kind: Any = None
    about, program = ABOUT, "fidsplat"
    while words and words[0] in known:
        kind, program = known[words[0]], f"{program} {words[0]}"
        about = inspect.cleandoc(kind.__doc__ or "")
        known, words = getattr(kind, "PARTS", {}), words[1:]
    if not hasattr(kind, "run"):  # a group of commands
        if words and words[0] in ("-h", "--help"):
            print(_group_help(program, about, known))
            raise SystemExit(0)
        given = unknown("command", words[0], known) if words else f"no command; known: {', '.join(known)}"
        raise InputError(f"{given}; see {program} --help")
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            config = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
            # tyro runs lines that begin with a letter together; a space before each keeps them as they are
            about = "\n".join(f" {line}" for line in about.splitlines())
            return tyro.cli(
                kind, prog=program, description=about, args=words, config=config, registry=optional_values
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        refused = stop.__context__
        while refused is not None and not isinstance(refused, InputError):
            refused = refused.__context__
        message = str(refused) if refused else f"{_one_line(said.getvalue())}; see {program} --help"
        raise InputError(message) from None


def _group_help(program: str, about: str, commands: Mapping[str, type]) -> str:
    """The help of a group: what it is about, and its commands with their first docstring lines."""
    width = max(map(len, commands)) + 2
    lines = [f"usage: {program} COMMAND ...", "", about, "", "Commands:"]
    for name in commands:
        summary = (
            commands.summary(name)
            if isinstance(commands, CommandTable)
            else str(commands[name].__doc__).partition("\n")[0]
        )
        lines.append(f"  {name:{width}}{summary}")
    return "\n".join(lines)


_NO_NUMBER = re.compile(r"Error parsing (\S+): .*(int\(\) with base 10|string to float): ('.*?'|\".*?\")")


def _one_line(box: str) -> str:
    """tyro's boxed message as one line: what is wrong, the nearest option if it names one, where to read
    more."""
    lines = [line.strip(" │") for line in box.splitlines()]
    parts: list[list[str]] = [[]]
    for line in lines:
        # the box is Unicode, or has its title above a line of hyphens where the terminal knows ASCII only
        if line.startswith("╭") or set(line) == {"-"} or set(line) == {"─"}:
            parts.append([])
        elif line and not line.startswith("╰"):
            parts[-1].append(line)
    parts = parts[1:]
    message = " ".join(parts[0]) or "these words make no command"
    if found := _NO_NUMBER.search(message):
        kind = "a whole number" if found[2].startswith("int") else "a number"
        message = f"{found[1]} is {found[3]}; give {kind}"
    for part in parts[1:]:
        if part and part[0].startswith("Perhaps you meant"):
            message += f"; perhaps {part[1]}"
        elif part and part[0].startswith("Available subcommands"):
            message += f"; {' '.join(part)}"
    return message


def _fail(message: str, status: int) -> int:
    with contextlib.suppress(OSError):  # stderr may be full or closed too
        print("fidsplat: " + " ".join(message.split()), file=sys.stderr)
    return status


def _show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    print(f"fidsplat: warning: {' '.join(str(message).split())}", file=sys.stderr)
