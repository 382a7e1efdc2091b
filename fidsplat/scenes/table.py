"""A table of a scene file whose keys, types and lengths are checked, with errors that name the key."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import MISSING, fields
from typing import Any

from fidsplat.util.errors import InputError, unknown

_MISSING = object()


def names_of(kind: type) -> tuple[str, ...]:
    """The keys of a table that says a dataclass."""
    return tuple(field.name for field in fields(kind))


class Table:
    """One TOML table. ``where`` is the file and the path of keys that leads to it, as errors name it.

    Raises InputError at once when it is not a table or holds a key that is not ``known``; the readers below
    raise it for a key that is missing and has no default, or that holds the wrong kind of value.
    """

    def __init__(self, values, file: str, path: str, known: tuple[str, ...]) -> None:
        self._file, self._path = file, path
        if not isinstance(values, dict):
            raise InputError(f"{file}: {path} must be a table, not {_kind(values)}")
        for key in values:
            if key not in known:
                what = "table" if isinstance(values[key], dict) else "key"
                within = self._name("")
                raise InputError(f"{file}: {unknown(what, key, known, within, likeness=0.0)}")
        self._values = values

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def _name(self, key: str) -> str:
        return f"{self._path}.{key}" if self._path else key

    def error(self, key: str, message: str) -> InputError:
        """An error about one key, for the caller to raise."""
        return InputError(f"{self._file}: {self._name(key)} {message}")

    @contextmanager
    def at(self, key: str = "") -> Iterator[None]:
        """Put this file and table, or key of it, before the text of an InputError that comes from inside."""
        try:
            yield
        except InputError as error:
            raise InputError(f"{self._file}: {self._name(key) if key else self._path}: {error}") from error

    def _get(self, key: str, default: Any) -> Any:
        if key in self._values:
            return self._values[key]
        if default is _MISSING:
            raise self.error(key, "is missing")
        return default

    def text(self, key: str, default: Any = _MISSING) -> Any:
        """A string that is not empty, or the default."""
        value = self._get(key, default)
        if key in self._values and (not isinstance(value, str) or not value):
            raise self.error(key, f"must be text, not {_kind(value)}")
        return value

    def texts(self, key: str, default: Any = _MISSING) -> Any:
        """A tuple of one or more strings, or the default."""
        value = self._get(key, default)
        if key not in self._values:
            return value
        if not isinstance(value, list) or not value or not all(isinstance(part, str) for part in value):
            raise self.error(key, f"must be a list of one or more texts, not {_kind(value)}")
        return tuple(value)

    def whole(self, key: str, default: Any = _MISSING) -> Any:
        """An int of at most 64 bits, as TOML has them, or the default."""
        value = self._get(key, default)
        if key in self._values and not (_is_whole(value) and value.bit_length() < 64):
            raise self.error(key, f"must be a whole number of at most 64 bits, not {_kind(value)}")
        return value

    def number(self, key: str, default: Any = _MISSING, infinite: bool = False) -> Any:
        """A finite float (or, where allowed, an infinite one), or the default."""
        value = self._get(key, default)
        if key not in self._values:
            return value
        return self._number(key, value, infinite)

    def numbers(self, key: str, count: int, default: Any = _MISSING) -> Any:
        """A tuple of ``count`` finite floats, or the default."""
        value = self._get(key, default)
        if key not in self._values:
            return value
        return self._vector(key, value, count)

    def any_numbers(self, key: str, default: Any = _MISSING) -> Any:
        """A tuple of finite floats, however many, or the default."""
        value = self._get(key, default)
        if key not in self._values:
            return value
        if not isinstance(value, list):
            raise self.error(key, f"must be a list of numbers, not {_kind(value)}")
        return self._vector(key, value, len(value))

    def matrix(self, key: str) -> list[tuple[float, ...]]:
        """Four rows of four finite floats."""
        value = self._get(key, _MISSING)
        if not isinstance(value, list) or len(value) != 4:
            raise self.error(key, f"must be a list of 4 rows of 4 numbers, not {_kind(value)}")
        return [self._vector(f"{key}[{i}]", row, 4) for i, row in enumerate(value)]

    def values(self, kind: type) -> dict[str, Any]:
        """What the table says of a dataclass, in the types of its fields; their ranges it checks itself.

        A field without a default must be said, and one that is infinite by default may be. One with a default
        factory has a table of its own, and is left out.
        """
        readers: dict[str, Callable[[str], Any]] = {
            "int": self.whole,
            "str": self.text,
            "tuple[float, float, float]": lambda key: self.numbers(key, 3),
            "tuple[float, ...]": self.any_numbers,
        }
        said = {}
        for field in fields(kind):
            said_elsewhere = field.default_factory is not MISSING
            if said_elsewhere or (field.name not in self and field.default is not MISSING):
                continue
            wanted = str(field.type).removesuffix(" | None")
            if " | " in wanted:  # the reader is that of what is there
                found = type(self._get(field.name, _MISSING))
                wanted = {str: "str", list: "tuple[float, ...]"}.get(found, "float")
            infinite = field.default == math.inf
            read = readers.get(wanted, lambda key, infinite=infinite: self.number(key, infinite=infinite))
            said[field.name] = read(field.name)
        return said

    def table(self, key: str, known: tuple[str, ...]) -> "Table":
        """The table under a key; an empty one when there is none."""
        return Table(self._values.get(key, {}), self._file, self._name(key), known)

    def tables(self, key: str, known: tuple[str, ...]) -> "list[Table]":
        """The array of tables under a key; none when there is none."""
        values = self._values.get(key, [])
        if not isinstance(values, list):
            raise self.error(key, f"must be written [[{key}]], not as {_kind(values)}")
        return [Table(value, self._file, f"{self._name(key)}[{i}]", known) for i, value in enumerate(values)]

    def _vector(self, key: str, value, count: int) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) != count:
            raise self.error(key, f"must be a list of {count} numbers, not {_kind(value)}")
        return tuple(self._number(f"{key}[{i}]", part, False) for i, part in enumerate(value))

    def _number(self, key: str, value, infinite: bool) -> float:
        if not (_is_whole(value) or isinstance(value, float)):
            raise self.error(key, f"must be a number, not {_kind(value)}")
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if math.isnan(number) or (math.isinf(number) and not infinite):
            raise self.error(key, f"must be a finite number, not {value!r}")
        return number


def _is_whole(value) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _kind(value) -> str:
    """A value as an error shows it: its text when that is short, else its kind."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."
