"""Escaping of text for Markdown."""

import re

_ACTIVE = re.compile(r"[&<>\[\]!|\\]")
_SPACE = re.compile(r"\s+")


def escaped(text: object) -> str:
    """One line of Markdown in which text makes no HTML, link, image or table cell, by character references.

    Emphasis and code (`*`, `_`, a backtick) stay: they change a typeface, no more.
    """
    return _ACTIVE.sub(lambda found: f"&#{ord(found[0])};", _SPACE.sub(" ", str(text)))
