"""Markdown and HTML of text, summaries and tables."""

import html
import re
from collections.abc import Iterable

_ACTIVE = re.compile(r"[&<>\[\]!|\\]")
_SPACE = re.compile(r"\s+")


def escaped(text: object) -> str:
    """Text as one line of Markdown, with the characters of HTML, links, images and tables escaped.

    Emphasis and code (`*`, `_`, a backtick) are not escaped, as they change only the typeface.
    """
    return _ACTIVE.sub(lambda found: f"&#{ord(found[0])};", _SPACE.sub(" ", str(text)))


class Summarised:
    """Base of classes with a short summary, which notebooks display as a table."""

    def summary(self) -> dict[str, str]:
        """Short descriptions by name."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        """The summary as an HTML table."""
        rows = "".join(
            f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
            f"<td style='text-align:left'>{html.escape(words)}</td></tr>"
            for name, words in self.summary().items()
        )
        return f"<b>{type(self).__name__}</b><table>{rows}</table>"


def html_table(heads: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """An HTML table of texts with a header."""
    lines = [("th", heads), *(("td", row) for row in rows)]
    return "".join(
        "<tr>" + "".join(f"<{tag}>{html.escape(str(cell))}</{tag}>" for cell in cells) + "</tr>"
        for tag, cells in lines
    ).join(("<table>", "</table>"))


def point(values) -> str:
    """Coordinates with four significant digits."""
    return "(" + ", ".join(f"{float(value):.4g}" for value in values) + ")"
