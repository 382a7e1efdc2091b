"""Argument validation of public functions.

Every check raises InputError with a message `<what> must be <requirement>, got <value>; <remedy>`.
"""

import math
import operator
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import MISSING, fields, replace
from numbers import Real
from typing import Annotated, Any, TypeVar

import numpy as np

from fidsplat.util.errors import InputError, unknown

T = TypeVar("T")
Bytes = Annotated[int, "bytes"]
"""number of bytes; the command line accepts units"""
Names = Annotated[tuple[str, ...], "separated by commas"]
"""names, separated by commas on the command line"""
LARGEST = 1e15
"""largest length [m] or colour; products of larger numbers would overflow in single precision"""
_LONGEST = 200
"""maximum number of characters of a value in a message"""


def invalid(what: str, requirement: str, value: object, remedy: str = "") -> InputError:
    """The error for a value that does not meet a requirement."""
    try:
        shown = repr(value)
    except Exception:  # an int with too many digits to print, or a foreign object
        shown = f"a {type(value).__name__}"
    shown = shown if len(shown) <= _LONGEST else shown[:_LONGEST] + " ..."
    return InputError(f"{what} must be {requirement}, got {shown}{'; ' if remedy else ''}{remedy}")


def as_float(value: Any) -> float:
    """A real number as a float; NaN for anything else, including an int beyond the range of floats."""
    if getattr(value, "shape", None) == () and hasattr(value, "item"):
        value = value.item()  # NumPy
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
    """Check that a value is a finite number within [low, high], and return it as a float."""
    checked = as_float(value)
    if not (math.isfinite(checked) and low <= checked <= high):
        raise invalid(what, requirement, value)
    return checked


def three_numbers(name: str, value: Any) -> tuple[float, float, float]:
    """Validated tuple of three finite floats."""
    try:
        x, y, z = map(as_float, value)
    except (TypeError, ValueError):
        x = y = z = math.nan
    if not (abs(x) <= LARGEST and abs(y) <= LARGEST and abs(z) <= LARGEST):
        raise invalid(name, f"three finite numbers, at most {LARGEST:g}", value)
    return x, y, z


def direction(name: str, value: Any) -> np.ndarray:
    """Validated direction: a unit vector (3,) float64 of three finite numbers, not all 0."""
    try:
        vector = np.array(three_numbers(name, value))
    except InputError:
        vector = np.zeros(3)
    if not vector.any():
        raise invalid(name, "three finite numbers, not all 0", value)
    return vector / np.linalg.norm(vector)


def whole_number(what: str, value: Any, low: int, high: int) -> int:
    """Check that a value is a whole number within [low, high], and return it as an int."""
    try:
        checked = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        checked = None
    if checked is None or not low <= checked <= high:
        raise invalid(what, f"a whole number from {low} to {high}", value)
    return checked


def flag(what: str, value: Any) -> bool:
    """Check that a value is a bool, and return it."""
    if isinstance(value, bool) or (type(value).__name__ in ("bool", "bool_") and hasattr(value, "item")):
        return bool(value)
    raise invalid(what, "True or False", value)


def instance(what: str, value: Any, kind: type[T], requirement: str = "", remedy: str = "") -> T:
    """Check that a value is an instance of a class, and return it."""
    if not isinstance(value, kind):
        raise invalid(what, requirement or f"a {kind.__name__}", value, remedy)
    return value


def text(what: str, value: Any) -> str:
    """Check that a value is a string that UTF-8 can encode, and return it."""
    try:
        if isinstance(value, str):
            value.encode()
            return value
    except UnicodeEncodeError:
        pass
    raise invalid(what, "text", value)


def callback(what: str, value: Any) -> Any:
    """Check that a value is a function or None, and return it."""
    if value is not None and not callable(value):
        raise invalid(what, "a function or None", value)
    return value


def items(what: str, value: Any, kind: type[T], requirement: str) -> tuple[T, ...]:
    """Check that a value is an iterable of instances of a class, and return its items."""
    checked = tuple(value) if isinstance(value, Iterable) and getattr(value, "shape", None) != () else None
    if checked is None or not all(isinstance(item, kind) for item in checked):
        raise invalid(what, requirement, value)
    return checked


def settings_with(kind: type[T], settings: T | None, changes: dict[str, Any]) -> T:
    """A settings dataclass (None: its defaults) with changes by field name; an unknown name is an error."""
    if settings is not None:
        instance("settings", settings, kind)
    known = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    for name in changes:
        if name not in known:
            raise InputError(unknown("setting", name, known))
    return replace(kind() if settings is None else settings, **changes)  # type: ignore[type-var]


def parse_settings(what: str, kind: type, parts: Iterable[str]) -> dict[str, Any]:
    """Values of a dataclass's fields from texts `key=value`, in the types of the fields."""
    settings = {}
    for part in parts:
        name, equals, value = (text.strip() for text in part.partition("="))
        if not equals:
            raise InputError(f"{what} must be settings as key=value, got {part!r}")
        settings[name] = parse_setting(what, kind, name, value)
    return settings


def parse_setting(what: str, kind: type, name: str, text: str) -> Any:
    """Value of a dataclass's field from a text, by the field's annotation; spaces separate numbers."""
    types = {field.name: str(field.type) for field in fields(kind)}
    if name not in types:
        raise InputError(unknown(f"setting of {what}", name, types))
    if types[name].endswith("| None") and text.lower() == "none":
        return None
    kinds = types[name].removesuffix(" | None").split(" | ")
    convert = {"int": int, "str": str, "float": float}.get(kinds[0], _numbers)
    try:
        if len(kinds) > 1:  # text or numbers
            with suppress(ValueError):
                return _numbers(text)
        return convert(text)
    except ValueError:
        required = {int: "a whole number", float: "a number"}.get(convert, "numbers separated by spaces")
        raise InputError(f"{what}: {name} must be {required}, got {text!r}") from None


def _numbers(text: str) -> float | tuple[float, ...]:
    first, *others = map(float, text.split() or [""])
    return (first, *others) if others else first


def changes_of(settings: Any) -> dict[str, Any]:
    """Fields of a dataclass that differ from their defaults, with tuples as lists."""
    values = {field.name: (getattr(settings, field.name), field.default) for field in fields(settings)}
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, (value, default) in values.items()
        if default is MISSING or value != default
    }


def from_fields(what: str, kind: type[T], values: dict[str, Any]) -> T:
    """An instance of a dataclass from values by field name; a missing field is an error."""
    for field in fields(kind):  # type: ignore[arg-type]
        if field.default is MISSING and field.default_factory is MISSING and field.name not in values:
            raise InputError(f"{what}: {field.name} must be given, got none; add {field.name}=...")
    return kind(**values)


class PickledByFields:
    """Base of frozen dataclasses that are pickled and copied by their fields, with read-only arrays."""

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)


def python_scalars(data: Any) -> None:
    """Convert NumPy scalars in the fields of a dataclass, frozen or not, to Python numbers, in place."""
    for field in fields(data):
        value = getattr(data, field.name)
        if isinstance(value, np.generic):
            object.__setattr__(data, field.name, value.item())


def array_of(what: str, value: Any, requirement: str, kinds: str = "fiub") -> np.ndarray:
    """Convert a value to an array of any shape, without a copy if possible.

    kinds: allowed values of `dtype.kind`.
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # for example rows of different lengths
        raise invalid(what, requirement, value) from None
    if array.dtype.kind not in kinds:
        raise invalid(what, requirement, value)
    return array


def real_array(what: str, value: Any, requirement: str = "an array of real numbers") -> np.ndarray:
    """Convert a value to a float64 array of any shape."""
    return array_of(what, value, requirement).astype(np.float64)
