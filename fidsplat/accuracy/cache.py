"""Cache of the qualities that `fs.quality_within` has measured and chosen, in the user's cache folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fidsplat.util.errors import InputError
from fidsplat.util.files import from_json, read_text, user_cache, write_json


def folder() -> Path:
    """The cache folder."""
    return user_cache() / "fidsplat" / "quality_within"


def load(key: str | None) -> dict[str, Any] | None:
    """The value of a key; None if there is none or its file is damaged."""
    if key is None:
        return None
    try:
        value = from_json(read_text(folder() / f"{key}.json"))
    except (OSError, ValueError):
        return None
    return value if isinstance(value, dict) else None


def save(key: str | None, value: dict[str, Any]) -> None:
    """Store the value of a key. Errors of writing are ignored."""
    if key is None:
        return
    try:
        folder().mkdir(parents=True, exist_ok=True)
        write_json(folder() / f"{key}.json", value, indent=1)
    except (OSError, InputError):
        pass
