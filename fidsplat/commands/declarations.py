"""Command-line options from dataclasses: rules for tyro, which parses the command line.

The options of a command are its fields and those of the settings that it nests. The docstring of a field is
the help of its option and may begin with a placeholder, as in `FILE.mp4: also write a video`. A type that
several commands share has its help as a string in `Annotated`; a string that begins with -- is a second name
of the option. `-o` is short for a field `out`. Help texts state computed defaults; other defaults are
appended.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import (
    MISSING,
    MISSING_NONPROP,
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from fidsplat.util.arguments import Bytes, Names
from fidsplat.util.errors import InputError

rules = ConstructorRegistry()
"""rules of tyro and of this module"""
_UNSET = "unset"
_PLACEHOLDERS = {int: "N", float: "X", str: "TEXT", Path: "DIR"}
"""placeholders in help by type of value; all paths in settings are folders"""
_VALUE = r"[A-Z][A-Z0-9,=]*(?:\.[a-z0-9.]+)?|\d"
_PLACEHOLDER = re.compile(rf"(?:{_VALUE})(?:[| ](?:{_VALUE}))*|[a-z]+(?:\|[a-z]+)+")
"""form of placeholders in docstrings: FILE.mp4|BAG, WIDTH HEIGHT, NX,NY,NZ, jpeg|png"""


def _shown_default(value: str) -> str:
    return "" if value in (_UNSET, "") else f"(default: {value})"


@rules.primitive_rule
def _optional_value(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Rule for options of type `T | None`: help omits `{None}` and a default of None."""
    kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
    if get_origin(info.type) not in (Union, UnionType) or len(kinds) != 1:
        return None
    inner = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
    if not isinstance(inner, PrimitiveConstructorSpec):
        return None
    return dataclasses.replace(
        inner,
        is_instance=lambda value: value is None or inner.is_instance(value),
        str_from_instance=lambda value: [_UNSET] if value is None else inner.str_from_instance(value),
    )


_UNITS = {"": 1, "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 2**10, "mib": 2**20, "gib": 2**30}


def parse_bytes(option: str, text: str) -> int:
    """Parse a number of bytes with or without a unit."""
    match = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]+)?)\s*([a-z]*)\s*", text.lower())
    size = int(float(match[1]) * _UNITS.get(match[2], 0)) if match else 0
    if size <= 0:
        raise InputError(
            f"{option} must be a number of bytes above 0, got {text!r}; write for example 500MB or 2GiB"
        )
    return size


def _spec(metavar: str, parse: Callable[[str], Any], shown: Callable[[Any], str]) -> PrimitiveConstructorSpec:
    """Specification of a value that is one word on the command line."""
    return PrimitiveConstructorSpec(
        1,
        metavar,
        lambda words: parse(words[0]),
        lambda value: True,
        lambda value: [_UNSET if value is None else shown(value)],
    )


def _shown_bytes(size: int) -> str:
    unit = next((unit for unit in ("GiB", "MiB", "KiB") if size % _UNITS[unit.lower()] == 0), "B")
    return f"{size // _UNITS[unit.lower()]}{unit}"


def _parse_names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(","))


@rules.struct_rule
def describe_fields(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Rule for dataclasses: the docstrings of fields are the help of their options."""
    if not dataclasses.is_dataclass(info.type):
        return None
    hints, texts = get_type_hints(info.type, include_extras=True), _field_docstrings(info.type)
    repeated = tyro.conf.UseAppendAction in info.markers
    options = []
    for field in dataclasses.fields(info.type):
        default = _default_of(field, info.default)
        text = texts.get(field.name)
        kind = _described(field.name, hints[field.name], text, repeated, negated=default is True)
        options.append(StructFieldSpec(field.name, kind, default))
    return StructConstructorSpec(info.type, tuple(options))


def _described(name: str, kind: Any, text: str | None, repeated: bool, negated: bool) -> Any:
    """Type of a field with the description of its option for tyro."""
    base, *marks = get_args(kind) if get_origin(kind) is Annotated else (kind,)
    if dataclasses.is_dataclass(base):
        return kind
    strings = [mark for mark in marks if isinstance(mark, str)]
    aliases = [string for string in strings if string.startswith("--")] + (["-o"] if name == "out" else [])
    text = text or next((string for string in strings if string not in aliases), None)
    kinds = (kind, base, *get_args(base))
    if Bytes in kinds:
        parse = partial(parse_bytes, "--" + name.replace("_", "-"))
        kind = Annotated[base, _spec("SIZE", parse, _shown_bytes), *marks]
    elif Names in kinds:
        kind = Annotated[base, _spec("A,B,...", _parse_names, ",".join), *marks]
    if base is bool:  # a field that is True by default has the option --no-NAME
        text = f"do not {text}" if negated else text
        return Annotated[kind, tyro.conf.arg(help=text, aliases=aliases, help_behavior_hint="")]
    placeholder, _, rest = (text or "").partition(": ")
    if _PLACEHOLDER.fullmatch(placeholder):
        text = rest
    else:
        placeholder = _placeholder(kind, repeated)
    shown = tyro.conf.arg(metavar=placeholder, help=text, aliases=aliases, help_behavior_hint=_shown_default)
    return Annotated[kind, shown]


def _placeholder(kind: Any, repeated: bool) -> str:
    """Placeholder for the values of a type."""
    if get_origin(kind) is Annotated:
        spec = next((mark for mark in get_args(kind) if isinstance(mark, PrimitiveConstructorSpec)), None)
        return spec.metavar if spec else _placeholder(get_args(kind)[0], repeated)
    if get_origin(kind) in (Union, UnionType):
        kind = next(member for member in get_args(kind) if member is not NoneType)
    if get_origin(kind) is tuple:
        return _placeholder(get_args(kind)[0], repeated) + ("" if repeated else "...")
    return _PLACEHOLDERS.get(kind, "TEXT")


def _default_of(field: dataclasses.Field, parent: Any) -> Any:
    """Default of a field, or its value in an instance of its class if there is one."""
    if parent is MISSING:
        return MISSING
    if parent is not MISSING_NONPROP and parent is not None:
        return getattr(parent, field.name)
    if field.default is not dataclasses.MISSING:
        return field.default
    return MISSING_NONPROP if field.default_factory is dataclasses.MISSING else field.default_factory()


@cache
def _field_docstrings(kind: type) -> dict[str, str]:
    """Docstrings of a dataclass's fields, including inherited ones, as help texts: without a capital and a
    full stop."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(definition, ast.ClassDef)
        for field, text in zip(definition.body, definition.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                texts.pop(field.target.id, None)
                if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                    words = " ".join(str(text.value.value).split()).removesuffix(".")
                    lower = words[1:2].islower() or (words[1:2] == " " and not words[2:3].isupper())
                    texts[field.target.id] = words[0].lower() + words[1:] if lower else words
    return texts
