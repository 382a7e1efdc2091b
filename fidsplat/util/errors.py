"""The two kinds of error that a user meets; the command line turns them into one line and an exit status."""

import difflib
from collections.abc import Iterable

LONGEST = 2000
"""characters of an error's text: one that quotes more of what it was given is cut in its middle"""


class FidsplatError(Exception):
    """Base of every error that fidsplat raises on purpose; its text says what was wrong and what would be
    right."""

    exit_status = 1

    def __str__(self) -> str:
        text = Exception.__str__(self)  # a KeyError's own would be a repr
        return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"


class InputError(FidsplatError, ValueError):
    """The user's input (file, spec, pose, size, option) cannot be used. Exit status 2. Its text is one line,
    whatever it quotes."""

    exit_status = 2

    def __str__(self) -> str:
        return " ".join(line.strip() for line in super().__str__().splitlines())


class MissingOutputError(InputError, KeyError):
    """An output that a frame was not rendered with; to a Mapping, a key that is missing."""


class DeviceError(FidsplatError, RuntimeError):
    """A device is missing, unknown, or failed while it ran. Exit status 1 (2 for an unknown name)."""

    exit_status = 1


class UnknownDeviceError(DeviceError):
    """The name of a device that nothing here answers to."""

    exit_status = 2


def unknown(what: str, name: object, known: Iterable[str], within: str = "", likeness: float = 0.6) -> str:
    """What an error says about a name that is none of those known, the nearest of which it offers.

    Args:
        what: what was named: "output", "quality".
        within: stands before the name, "camera." say, and has no part in the comparison.
        likeness: how like the name the nearest must be to be offered, 0 to 1.
    """
    names = list(known)
    near = difflib.get_close_matches(str(name)[:100].lower(), names, 1, likeness)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    shown = repr(within + name if isinstance(name, str) else name)
    listed = (repr(name) if ", " in name else name for name in names)
    valid = f"known: {', '.join(listed)}" if names else "none is known here"
    return f"unknown {what} {shown}{hint}; {valid}"


def bytes_words(size: float) -> str:
    """Bytes as errors say them, to three digits where they are few."""
    if size < 2**20:
        return f"{size / 2**10:.3g} KiB"
    return f"{size / 2**20:.3g} MiB" if size < 100 * 2**20 else f"{size / 2**20:.0f} MiB"


def several(count: int, things: str) -> str:
    """A number of things, "1 chunk" of "chunks"."""
    return f"{count:,} {things if count != 1 else things.removesuffix('s')}"
