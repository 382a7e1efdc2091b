"""What was measured is kept in the user's cache folder, so that the same question costs nothing again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write, from_json, read_text, user_cache


def folder() -> Path:
    """Where answers are kept: fidsplat/accuracy in the user's cache folder."""
    return user_cache() / "fidsplat" / "budget"


def load(key: str | None) -> dict[str, Any] | None:
    """What was kept under a key; None if nothing, or if the file is damaged."""
    if key is None:
        return None
    try:
        kept = from_json(read_text(folder() / f"{key}.json"))
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
