"""Settings of the test bench of tag detectors. Their fields are options of `fidsplat experiment tags`."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from fidsplat.experiments.settings import ShardSettings
from fidsplat.util.arguments import whole_number

QUICK_STEPS, QUICK_VIEWS = 2, 3
STEPS, VIEWS = 10, 24


@dataclass(frozen=True)
class TagSettings(ShardSettings):
    """Scenes, causes, families and detectors of the test bench."""

    out: Path | None = None
    """Folder for results. By default fidsplat-tags, with --quick fidsplat-tags-quick."""
    quick: bool = False
    """Measure two severities of each cause in three views, in minutes."""
    scene: tuple[str, ...] = ()
    """Scene: greenhouse, biker or playbot. By default greenhouse and biker; repeat for several."""
    cause: tuple[str, ...] = ()
    """Cause of failures. By default all; repeat for several."""
    family: tuple[str, ...] = ()
    """Family: apriltag:36h11, aruco:4x4_50 or qr. By default all; repeat for several."""
    detector: tuple[str, ...] = ()
    """Detector, or module:function for your own; repeat for several. By default all installed ones."""
    severities: int | None = None
    """Number of severities from 0 to 1, without 0. By default 10, with --quick 2."""
    views: int | None = None
    """Number of views of each severity. By default 24, with --quick 3."""
    device: str | None = None
    """D: device; see `fidsplat devices` (default: FIDSPLAT_DEVICE, or auto)"""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of threads that detect. By default one per core."""

    @property
    def folder(self) -> Path:
        return self.out or Path("fidsplat-tags" + ("-quick" if self.quick else ""))

    @property
    def steps(self) -> list[float]:
        """Severities above 0 at which each cause is measured."""
        count = self.severities or (QUICK_STEPS if self.quick else STEPS)
        return [round((k + 1) / count, 6) for k in range(count)]

    @property
    def view_count(self) -> int:
        return self.views or (QUICK_VIEWS if self.quick else VIEWS)

    def check(self) -> None:
        """Raise InputError for numbers out of range."""
        for name, highest in (("severities", 1000), ("views", 100_000), ("workers", 1024)):
            if getattr(self, name) is not None:
                whole_number(f"--{name}", getattr(self, name), 1, highest)
