"""Argument validation: what public functions are given, checked before anything is computed from it.

Every function raises InputError with one message, `<what> must be <requirement>, got <value>; <remedy>`.
"""

import math
import operator
from collections.abc import Iterable
from numbers import Real
from typing import Any, TypeVar

from fidsplat.util.errors import InputError

T = TypeVar("T")
_LONGEST = 200
"""characters of a value that a message shows"""


def invalid(what: str, requirement: str, value: object, remedy: str = "") -> InputError:
    """The error for a value that does not meet a requirement."""
    try:
        shown = repr(value)
    except Exception:  # an int of more digits than Python prints, a foreign object
        shown = f"a {type(value).__name__}"
    shown = shown if len(shown) <= _LONGEST else shown[:_LONGEST] + " ..."
    return InputError(f"{what} must be {requirement}, got {shown}{'; ' if remedy else ''}{remedy}")


def as_float(value: Any) -> float:
    """A real number as a float; NaN for anything else, an int that no float holds among it."""
    if getattr(value, "shape", None) == () and hasattr(value, "item"):
        value = value.item()  # of NumPy
    if not isinstance(value, Real) or isinstance(value, bool):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


def number(
    what: str,
    value: Any,
    requirement: str = "a finite number",
    low: float = -math.inf,
    high: float = math.inf,
) -> float:
    """A finite number within [low, high], as a float."""
    found = as_float(value)
    if not (math.isfinite(found) and low <= found <= high):
        raise invalid(what, requirement, value)
    return found


def whole_number(what: str, value: Any, low: int, high: int) -> int:
    """A whole number within [low, high], as an int."""
    try:
        found = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        found = None
    if found is None or not low <= found <= high:
        raise invalid(what, f"a whole number from {low} to {high}", value)
    return found


def flag(what: str, value: Any) -> bool:
    """True or False."""
    if isinstance(value, bool) or (type(value).__name__ in ("bool", "bool_") and hasattr(value, "item")):
        return bool(value)
    raise invalid(what, "True or False", value)


def instance(what: str, value: Any, kind: type[T], requirement: str = "", remedy: str = "") -> T:
    """An instance of a class."""
    if not isinstance(value, kind):
        raise invalid(what, requirement or f"a {kind.__name__}", value, remedy)
    return value


def text(what: str, value: Any) -> str:
    """A string that files can hold: without half of a surrogate pair."""
    try:
        if isinstance(value, str):
            value.encode()
            return value
    except UnicodeEncodeError:
        pass
    raise invalid(what, "text", value)


def callback(what: str, value: Any) -> Any:
    """A function, or None."""
    if value is not None and not callable(value):
        raise invalid(what, "a function or None", value)
    return value


def items(what: str, value: Any, kind: type[T], requirement: str) -> tuple[T, ...]:
    """The items of an iterable, all of one class."""
    found = tuple(value) if isinstance(value, Iterable) and getattr(value, "shape", None) != () else None
    if found is None or not all(isinstance(item, kind) for item in found):
        raise invalid(what, requirement, value)
    return found
