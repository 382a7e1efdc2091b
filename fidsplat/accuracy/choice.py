"""The answer of `quality_within`: a quality with its error and time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fidsplat.capture.quality import Quality


@dataclass(frozen=True)
class Choice:
    """A chosen quality, with its error and time, and the origin of these numbers."""

    quality: Quality
    error: float
    """largest absolute error of rgb: measured in the scene, or promised for a class of scenes"""
    ms: float | None
    """median frame time in milliseconds; None if not measured"""
    ms_late: float | None
    """90th percentile of the frame time"""
    source: str
    """`promised`, `measured`, or `cached`: measured earlier and read from the user's cache folder"""
    device: str
    """name of the device"""
    settings: dict[str, Any]
    """settings that differ from `candidates.DEFAULTS`"""
    certified: float | None = None
    """largest value of the output `error`, if it was rendered (`certify`)"""
    remark: str = ""
    """class of scenes of a promise, or why there is no certificate"""

    def as_dict(self) -> dict[str, Any]:
        """All fields except the quality, for JSON."""
        keys = ("error", "ms", "ms_late", "source", "device", "settings", "certified", "remark")
        return {key: getattr(self, key) for key in keys}

    @property
    def summary(self) -> str:
        """One line of text."""
        settings = ", ".join(
            f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"
            for name, value in ({"alpha_cutoff": self.quality.alpha_cutoff} | self.settings).items()
        )
        how = "promised error" if self.source == "promised" else "measured error"
        certified = "" if self.certified is None else f", certified at most {self.certified:.2g}"
        time = "" if self.ms is None else f", {self.ms:.3g} ms a frame"
        remark = f" ({self.remark})" if self.remark else ""
        return f"{settings}: {how} {self.error:.2g}{certified}{time} on {self.device}{remark}"
