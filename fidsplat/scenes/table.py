"""TOML tables with checked keys, types and lengths; errors contain the key."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields
from typing import Any

from fidsplat.util.errors import InputError, unknown

_MISSING = object()


def names_of(kind: type) -> tuple[str, ...]:
    """Names of the fields of a dataclass, which are the keys of its table."""
    return tuple(field.name for field in fields(kind))


class Table:
    """A TOML table, with its file and the path of its key.

    Raises InputError for another value or a key that is not ``known``; methods raise it for a missing key
    without a default and for a value of the wrong type.
    """

    def __init__(self, values, file: str, path: str, known: tuple[str, ...]) -> None:
        self._file, self._path = file, path
        if not isinstance(values, dict):
            raise InputError(f"{file}: {path} must be a table, got {_kind(values)}")
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
        """An InputError about one key."""
        return InputError(f"{self._file}: {self._name(key)} {message}")

    @contextmanager
    def at(self, key: str = "") -> Iterator[None]:
        """Prefix InputErrors of the block with the file and this table, or one of its keys."""
        try:
            yield
        except InputError as error:
            message, name = str(error), self._name(key) if key else self._path
            if message.startswith(f"{self._file}: "):
                raise
            # messages often begin with the last part of the name
            message = message.removeprefix(f"{name.rpartition('.')[2]}: ")
            raise InputError(f"{self._file}: {name}: {message}") from error

    def _get(self, key: str, default: Any) -> Any:
        if key in self._values:
            return self._values[key]
        if default is _MISSING:
            raise self.error(key, "is missing")
        return default

    def text(self, key: str, default: Any = _MISSING) -> Any:
        """A non-empty string, or the default."""
        value = self._get(key, default)
        if key in self._values and (not isinstance(value, str) or not value):
            raise self.error(key, f"must be text, got {_kind(value)}")
        return value

    def is_text(self, key: str) -> bool:
        """Whether the value of a key is a string."""
        return isinstance(self._values.get(key), str)

    def of_kind(self, kinds: Mapping[str, type], key: Callable[[str], str] = str) -> "tuple[type, Table]":
        """The class that the key `kind` names, and the table restricted to its fields.

        key: function from the name of a field to its key.
        """
        name = self.text("kind")
        if name not in kinds:
            raise self.error("kind", f"must be {', '.join(kinds)}, got {name!r}")
        known = ("kind", *map(key, names_of(kinds[name])))
        return kinds[name], Table(self._values, self._file, self._path, known)

    def texts(self, key: str, default: Any = _MISSING) -> Any:
        """A tuple of one or more strings, or the default."""
        value = self._get(key, default)
        if key not in self._values:
            return value
        if not isinstance(value, list) or not value or not all(isinstance(part, str) for part in value):
            raise self.error(key, f"must be a list of one or more texts, got {_kind(value)}")
        return tuple(value)

    def whole(self, key: str, default: Any = _MISSING) -> Any:
        """An int of at most 64 bits, or the default."""
        value = self._get(key, default)
        if key in self._values and not (_is_whole(value) and value.bit_length() < 64):
            raise self.error(key, f"must be a whole number of at most 64 bits, got {_kind(value)}")
        return value

    def number(self, key: str, default: Any = _MISSING, infinite: bool = False) -> Any:
        """A finite float, or with `infinite` also an infinite one, or the default."""
        value = self._get(key, default)
        return self._number(key, value, infinite) if key in self._values else value

    def numbers(self, key: str, count: int, default: Any = _MISSING) -> Any:
        """A tuple of ``count`` finite floats, or the default."""
        value = self._get(key, default)
        return self._vector(key, value, count) if key in self._values else value

    def any_numbers(self, key: str, default: Any = _MISSING) -> Any:
        """A tuple of finite floats of any length, or the default."""
        value = self._get(key, default)
        if key not in self._values:
            return value
        if not isinstance(value, list):
            raise self.error(key, f"must be a list of numbers, got {_kind(value)}")
        return self._vector(key, value, len(value))

    def matrix(self, key: str) -> list[tuple[float, ...]]:
        """Four rows of four finite floats."""
        value = self._get(key, _MISSING)
        if not isinstance(value, list) or len(value) != 4:
            raise self.error(key, f"must be a list of 4 rows of 4 numbers, got {_kind(value)}")
        return [self._vector(f"{key}[{i}]", row, 4) for i, row in enumerate(value)]

    def values(self, kind: type, key: Callable[[str], str] = str) -> dict[str, Any]:
        """Values of the fields of a dataclass, in their types.

        Fields without a default are required. Fields with a default factory have their own table and are
        omitted. A value may be infinite only if the default is. key: function from a field's name to its key.
        """
        readers: dict[str, Callable[[str], Any]] = {
            "int": self.whole,
            "str": self.text,
            "tuple[float, float, float]": lambda key: self.numbers(key, 3),
            "tuple[float, ...]": self.any_numbers,
            "tuple[str, ...]": self.texts,
        }
        values = {}
        for field in fields(kind):
            has_own_table = field.default_factory is not MISSING
            name = key(field.name)
            if has_own_table or (name not in self and field.default is not MISSING):
                continue
            type_name = str(field.type).removesuffix(" | None")
            if " | " in type_name:  # by the type of the value
                value_type = type(self._get(name, _MISSING))
                type_name = {str: "str", list: "tuple[float, ...]"}.get(value_type, "float")
            infinite = field.default == math.inf
            read = readers.get(type_name, lambda key, infinite=infinite: self.number(key, infinite=infinite))
            values[field.name] = read(name)
        return values

    def table(self, key: str, known: tuple[str, ...]) -> "Table":
        """The table of a key; empty if absent."""
        return Table(self._values.get(key, {}), self._file, self._name(key), known)

    def tables(self, key: str, known: tuple[str, ...]) -> "list[Table]":
        """The array of tables of a key; empty if absent."""
        values = self._values.get(key, [])
        if not isinstance(values, list):
            raise self.error(key, f"must be written [[{key}]], got {_kind(values)}")
        return [Table(value, self._file, f"{self._name(key)}[{i}]", known) for i, value in enumerate(values)]

    def _vector(self, key: str, value, count: int) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) != count:
            raise self.error(key, f"must be a list of {count} numbers, got {_kind(value)}")
        return tuple(self._number(f"{key}[{i}]", part, False) for i, part in enumerate(value))

    def _number(self, key: str, value, infinite: bool) -> float:
        if not (_is_whole(value) or isinstance(value, float)):
            raise self.error(key, f"must be a number, got {_kind(value)}")
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if math.isnan(number) or (math.isinf(number) and not infinite):
            raise self.error(key, f"must be a finite number, got {value!r}")
        return number


def _is_whole(value) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _kind(value) -> str:
    """Short description of a value for an error message."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."
