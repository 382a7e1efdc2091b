"""What was measured is kept in the user's cache folder, so that the same question costs nothing again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.errors import InputError
from fidsplat.files import atomic_write, from_json, user_cache


def folder() -> Path:
    """Where answers are kept: fidsplat/budget in the user's cache folder."""
    return user_cache() / "fidsplat" / "budget"


def digest(*parts: Any) -> str | None:
    """The key of a question: of plain values, arrays and dataclasses of them. None where something in it has
    no value of its own, as a function of time that moves a camera."""
    state = hashlib.blake2b(digest_size=16)
    try:
        _feed(state, parts)
    except TypeError:
        return None
    return state.hexdigest()


def load(key: str | None) -> dict[str, Any] | None:
    """What was kept under a key; None if nothing, or if the file is damaged."""
    if key is None:
        return None
    try:
        kept = from_json((folder() / f"{key}.json").read_text("utf-8"))
    except (OSError, ValueError):
        return None
    return kept if isinstance(kept, dict) else None


def save(key: str | None, value: dict[str, Any]) -> None:
    """Keep something under a key. Where the folder cannot be written nothing is kept: it is only a cache."""
    if key is None:
        return
    try:
        folder().mkdir(parents=True, exist_ok=True)
        with atomic_write(folder() / f"{key}.json") as stream:
            stream.write(json.dumps(value, indent=1, allow_nan=False).encode())
    except (OSError, InputError):
        pass


def _feed(state, value: Any) -> None:
    state.update(type(value).__name__.encode() + b"\0")
    if isinstance(value, np.ndarray):
        state.update(f"{value.dtype.str}{value.shape}".encode())
        state.update(np.ascontiguousarray(value).data)
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            state.update(field.name.encode() + b"\0")
            _feed(state, getattr(value, field.name))
    elif isinstance(value, Mapping):
        for key, item in value.items():
            _feed(state, (key, item))
    elif isinstance(value, Sequence) and not isinstance(value, (str, bytes)):
        state.update(f"{len(value)}".encode())
        for item in value:
            _feed(state, item)
    elif value is None or isinstance(value, (str, bytes, bool, int, float)):
        state.update(repr(value).encode() + b"\0")
    else:
        raise TypeError(f"a {type(value).__name__} has no value of its own")
