"""A report as headings, paragraphs, tables and pictures, written as Markdown and as HTML."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass
class Document:
    """Blocks in their order."""

    title: str
    blocks: list[tuple] = field(default_factory=list)

    def heading(self, text: str, level: int = 2) -> None:
        """A heading, 2 to 4."""
        self.blocks.append(("heading", level, text))

    def text(self, text: str) -> None:
        """A paragraph."""
        self.blocks.append(("text", text))

    def table(self, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """A table; its first column is text, the others are numbers."""
        self.blocks.append(("table", tuple(heads), [tuple(row) for row in rows]))

    def picture(self, file: str, title: str) -> None:
        """A picture by its name relative to the report."""
        self.blocks.append(("picture", file, title))

    def markdown(self, folder: str = "") -> str:
        """The document in Markdown; ``folder`` comes before the names of pictures, e.g. "results/"."""
        parts = [f"# {self.title}"]
        for kind, *values in self.blocks:
            if kind == "heading":
                parts.append(f"{'#' * values[0]} {values[1]}")
            elif kind == "text":
                parts.append(values[0])
            elif kind == "picture":
                parts.append(f"![{values[1]}]({folder}{values[0]})")
            else:
                heads, rows = values
                lines = [heads, ("---", *["---:"] * (len(heads) - 1)), *rows]
                parts.append("\n".join("| " + " | ".join(map(_cell, line)) + " |" for line in lines))
        return "\n\n".join(parts) + "\n"

    def html(self, folder: str = "") -> str:
        """The document as one HTML page without scripts; ``folder`` as for `markdown`."""
        parts = [f"<h1>{html.escape(self.title)}</h1>"]
        for kind, *values in self.blocks:
            if kind == "heading":
                parts.append(f"<h{values[0]}>{html.escape(values[1])}</h{values[0]}>")
            elif kind == "text":
                parts.append(f"<p>{html.escape(values[0])}</p>")
            elif kind == "picture":
                source, title = (html.escape(v, quote=True) for v in (folder + values[0], values[1]))
                parts.append(f'<figure><img src="{source}" alt="{title}"></figure>')
            else:
                heads, rows = values
                body = [_html_row("th", heads), *(_html_row("td", row) for row in rows)]
                parts.append("<table>" + "".join(body) + "</table>")
        head = (
            f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(self.title)}</title>'
        )
        return f"{head}<style>{_STYLE}</style><body>" + "\n".join(parts) + "</body></html>\n"


_STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse;margin:1em 0;font-size:13px}"
    "td,th{padding:2px 10px;border-bottom:1px solid #ddd;text-align:right}"
    "td:first-child,th:first-child{text-align:left}img{max-width:100%}"
)


def _cell(text: object) -> str:
    return str(text).replace("|", "\\|")


def _html_row(tag: str, cells: Sequence[str]) -> str:
    return "<tr>" + "".join(f"<{tag}>{html.escape(str(cell))}</{tag}>" for cell in cells) + "</tr>"
