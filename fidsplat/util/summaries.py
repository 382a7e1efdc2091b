"""What things say of themselves in a notebook."""

import html


class Summarised:
    """Base of what says in a few rows what it holds."""

    def summary(self) -> dict[str, str]:
        """Words by what they are about."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        """The rows as a table, which notebooks show."""
        rows = "".join(
            f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
            f"<td style='text-align:left'>{html.escape(words)}</td></tr>"
            for name, words in self.summary().items()
        )
        return f"<b>{type(self).__name__}</b><table>{rows}</table>"


def point(values) -> str:
    """Coordinates in metres, to four digits."""
    return "(" + ", ".join(f"{float(value):.4g}" for value in values) + ")"
