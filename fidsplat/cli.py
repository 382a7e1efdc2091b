"""The command line: parse arguments, run a command, return its exit status.

Exit status 0: done; 1: the run failed; 2: invalid arguments or input. Errors are one line on stderr.
"""

import contextlib
import errno
import inspect
import io
import re
import sys
import traceback
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from fidsplat.commands import COMMANDS, CommandTable
from fidsplat.util import interrupts, streams
from fidsplat.util.limits import check_imports

ABOUT = """Make fiducial markers of 2D Gaussian splats, place them in scenes, render and detect them.

Examples:
  fidsplat demo                                     make, render and detect markers, with a table
  fidsplat devices                                  list the devices of this machine
  fidsplat marker apriltag:36h11:5 -o tag.ply       make a marker as a splat file
  fidsplat render scene.toml -o image.png           render a scene
  fidsplat view scene.toml                          show a scene in a browser
  fidsplat detect image.png --scene scene.toml      detect markers, with poses and errors
  fidsplat bench                                    time frames of standard scenes
  fidsplat tradeoff --quick                         measure time and error of the quality settings
  fidsplat train photos -o scene.ply                train splats on images with known cameras

`fidsplat COMMAND --help` explains a command. --debug, at any position, prints the traceback of an error.
`fidsplat --version` prints the version."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status: 0 done, 1 failed, 2 bad input, 130 interrupted, 143
    terminated."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    streams.open_missing()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal may lack a character
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
                interrupts.check()  # a signal may have caused the error
                raise
            interrupts.check()
        sys.stdout.flush()
        return status
    except SystemExit as stop:  # help or version
        return stop.code if isinstance(stop.code, int) else 2
    except KeyboardInterrupt as stop:
        if not debug:  # destructors of half-constructed objects may raise
            sys.unraisablehook = lambda _: None
        terminated = isinstance(stop, interrupts.Terminated)
        return _fail(*(("terminated", 143) if terminated else ("interrupted", 130)))
    except BrokenPipeError:
        streams.discard_stdout()  # the reader has closed the pipe
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
            return _fail("not enough memory; use a smaller image or fewer splats", 1)
        if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
            return _fail(
                f"the name of a file must have at most 255 bytes, got {str(error.filename)[:100]}...", 2
            )
        if isinstance(error, OSError) and error.errno in _SHORTAGES:
            streams.discard_stdout()
            where = f" ({error.filename})" if error.filename else ""
            return _fail(f"{error.strerror}{where}; {_SHORTAGES[error.errno]}", 1)
        return _fail(f"{type(error).__name__}: {error} (a fault of fidsplat; --debug shows where)", 1)


_SHORTAGES = {
    errno.ENOSPC: "free space there or on the disk of the output",
    errno.EDQUOT: "free space there or on the disk of the output",
    errno.EFBIG: "raise the limit on file sizes with ulimit -f",
    errno.EROFS: "give a writable folder",
    errno.EACCES: "change the permissions of its folder, or give another path",
    errno.EPERM: "change the permissions of its folder, or give another path",
    errno.ELOOP: "give the path without symbolic links",
    errno.EMFILE: "raise the limit on open files with ulimit -n",
    errno.ENFILE: "the system's limit on open files is reached",
    errno.EIO: "the disk or the terminal failed",
}
"""remedies for errors of the operating system, which any command may raise"""


def _parse(words: list[str]):
    """Parse arguments to a command object. Raises InputError, or SystemExit after help or the version."""
    from fidsplat import __version__
    from fidsplat.util.errors import InputError, unknown

    if not words:
        raise InputError(
            "no command; try `fidsplat demo` first, which makes, renders and detects markers, then "
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
    import tyro

    from fidsplat.commands.declarations import rules

    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed):
            config = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
            # tyro joins lines that begin with a letter; a space before each line prevents it
            about = "\n".join(f" {line}" for line in about.splitlines())
            return tyro.cli(kind, prog=program, description=about, args=words, config=config, registry=rules)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        refused = stop.__context__
        while refused is not None and not isinstance(refused, InputError):
            refused = refused.__context__
        message = str(refused) if refused else f"{_one_line(printed.getvalue())}; see {program} --help"
        raise InputError(message) from None


def _group_help(program: str, about: str, commands: Mapping[str, type]) -> str:
    """Help of a command group: its description, and the first docstring line of each of its commands."""
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


_NOT_A_NUMBER = re.compile(r"Error parsing (\S+): .*(int\(\) with base 10|string to float): ('.*?'|\".*?\")")


def _one_line(box: str) -> str:
    """Convert tyro's boxed message to one line: the error and the most similar option."""
    lines = [line.strip(" │") for line in box.splitlines()]
    parts: list[list[str]] = [[]]
    for line in lines:
        # a terminal without Unicode gets the title above a line of hyphens instead of a box
        if line.startswith("╭") or set(line) == {"-"} or set(line) == {"─"}:
            parts.append([])
        elif line and not line.startswith("╰"):
            parts[-1].append(line)
    parts = parts[1:]
    message = " ".join(parts[0]) or "the arguments are not a command"
    if found := _NOT_A_NUMBER.search(message):
        kind = "a whole number" if found[2].startswith("int") else "a number"
        message = f"{found[1]} must be {kind}, got {found[3]}"
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
