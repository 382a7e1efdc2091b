"""What images hold where nothing is drawn."""

_NONE = {"label": -1, "splat_id": -1}


def blank(name: str) -> int:
    """Of an output, by its name: no label, no splat, or 0."""
    return _NONE.get(name, 0)
