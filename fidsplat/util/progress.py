"""Progress callbacks."""

from collections.abc import Callable
from typing import Any

Progress = Callable[[str, float], Any]
"""callback with the current step and its completed fraction, 0 to 1"""


def no_progress(step: str, fraction: float) -> None:
    """Progress callback that does nothing."""
