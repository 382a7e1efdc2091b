"""Errors for users; the command line prints them as one line with an exit status."""

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

LONGEST = 2000
"""maximum number of characters of a message; longer ones are cut in the middle"""


class FidsplatError(Exception):
    """Base of fidsplat's errors. The text states the problem and the remedy."""

    exit_status = 1

    def __str__(self) -> str:
        text = Exception.__str__(self)  # str() of a KeyError is a repr of the text
        return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"


class InputError(FidsplatError, ValueError):
    """Unusable input: file, spec, pose, size or option. Exit status 2. The text is always one line."""

    exit_status = 2

    def __str__(self) -> str:
        return " ".join(line.strip() for line in super().__str__().splitlines())


class MissingOutputError(InputError, KeyError):
    """An output that was not requested when the frame was rendered; also a KeyError."""


class DeviceError(FidsplatError, RuntimeError):
    """A missing or failed device. Exit status 1."""

    exit_status = 1


class UnknownDeviceError(DeviceError):
    """An unknown device name. Exit status 2."""

    exit_status = 2


@contextmanager
def os_errors(action: str, remedy: str = "") -> Iterator[None]:
    """Convert an OSError within the block to an InputError "ACTION: reason; REMEDY", e.g. for "cannot write
    FILE"."""
    try:
        yield
    except OSError as error:
        reason = f"{action}: {error.strerror or error}"
        raise InputError(f"{reason}; {remedy}" if remedy else reason) from error


@contextmanager
def error_prefix(prefix: str) -> Iterator[None]:
    """Add a prefix, such as the name of a file, to an InputError within the block."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{prefix}: {error}") from error


@contextmanager
def damaged_data(what: str, remedy: str = "") -> Iterator[None]:
    """Convert errors of Python within the block, which parses a file, to an InputError "WHAT is damaged;
    REMEDY"."""
    try:
        yield
    except InputError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, RuntimeError) as error:
        reason = f"{what} is damaged ({type(error).__name__}: {error})"
        raise InputError(f"{reason}; {remedy}" if remedy else reason) from None


@contextmanager
def required_package(what: str, extra: str) -> Iterator[None]:
    """Convert an ImportError within the block to an InputError that names fidsplat's extra."""
    try:
        yield
    except ImportError as error:
        raise InputError(f"{what} must be installed, got: {error}; pip install 'fidsplat[{extra}]'") from None


def unknown(what: str, name: object, known: Iterable[str], within: str = "", likeness: float = 0.6) -> str:
    """Message about an unknown name, with the most similar known name and a list of all.

    Args:
        what: what the name denotes, such as "output".
        within: prefix of the name in the message, such as "camera.".
        likeness: minimum similarity of the suggestion, 0 to 1.
    """
    names = list(known)
    hint = did_you_mean(name, names, likeness)
    shown = repr(within + name if isinstance(name, str) else name)
    listed = (repr(name) if ", " in name else name for name in names)
    valid = f"known: {', '.join(listed)}" if names else "none is known here"
    return f"unknown {what} {shown}{hint}; {valid}"


def did_you_mean(name: object, known: Iterable[str], likeness: float = 0.6) -> str:
    """The most similar known name as a question in brackets, after a space; empty if none is similar."""
    near = closest(str(name), known, likeness)
    return "" if near is None else f" (did you mean {near!r}?)"


def closest(name: str, known: Iterable[str], likeness: float = 0.6) -> str | None:
    """The most similar known name, None if none is similar; known names are in lower case."""
    return next(iter(difflib.get_close_matches(name[:100].lower(), list(known), 1, likeness)), None)


def bytes_words(size: float) -> str:
    """A number of bytes as text in KiB or MiB, for messages."""
    if size < 2**20:
        return f"{size / 2**10:.3g} KiB"
    return f"{size / 2**20:.3g} MiB" if size < 100 * 2**20 else f"{size / 2**20:.0f} MiB"


def counted(count: int, nouns: str) -> str:
    """A count with its noun in the singular or plural: "1 chunk" for 1 and "chunks"."""
    return f"{count:,} {nouns if count != 1 else nouns.removesuffix('s')}"
