"""Which of the table's settings to take, by measuring them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from fidsplat.budget.calibrate import Calibration, Times
from fidsplat.budget.table import Setting
from fidsplat.errors import InputError
from fidsplat.quality import Quality

ENOUGH = 4
"""settings that are timed together before one is taken"""
TOO_LONG = 1.5
"""times of the allowed time: a setting whose first frame takes longer is timed no further"""


@dataclass(frozen=True)
class Found:
    """A setting that keeps its bound."""

    setting: Setting
    quality: Quality
    error: float
    """largest absolute error of rgb"""
    times: Times


class Search:
    """Settings, the cheapest first, and a scene on a device to measure them with."""

    def __init__(self, calibration: Calibration, settings: tuple[Setting, ...]) -> None:
        self.calibration, self._settings = calibration, settings
        self.device = calibration.renderer.device.name

    def cheapest_within(self, error: float) -> Found:
        """The fastest here of the first few settings within the error.

        Raises:
            InputError: none is; it says which error is the least.
        """
        hits = []
        # what has not come near the error in any scene of the table is not tried
        for setting, measured in self._measured(s for s in self._settings if s.least <= error):
            if measured <= error:
                hits.append((setting, measured))
            if len(hits) == ENOUGH:
                break
        if hits:
            return min(self._timed(hits), key=lambda found: found.times.median)
        best = sorted(self._settings, key=lambda setting: setting.median)[:ENOUGH]
        least = min((measured for _, measured in self._measured(best)), default=float("nan"))
        raise InputError(
            f"no setting keeps an error of {error:g} for this scene on {self.device}: the least is "
            f"{least:.2g}; allow {least * 1.1:.2g} or more"
        )

    def most_accurate_in(self, ms: float) -> Found:
        """The setting with the least error of those whose frames take at most `ms` milliseconds, nine of ten.

        Raises:
            InputError: none does; it says how long the fastest takes.
        """
        likely, late = [], 0
        for setting, measured in self._measured(self._settings):
            if self.calibration.time(setting.of(self.calibration.base)) <= TOO_LONG * ms:
                likely.append((setting, measured))
            else:
                late += 1
            if late == ENOUGH:
                break
        likely.sort(key=lambda pair: pair[1])
        seen: list[Found] = []
        for start in range(0, len(likely), ENOUGH):
            batch = self._timed(likely[start : start + ENOUGH])
            for found in batch:
                if found.times.late <= ms:
                    return found
            seen += batch
        if not seen:
            first = self._measured(self._settings)
            seen = self._timed([pair for pair, _ in zip(first, range(ENOUGH), strict=False)])
        best = min(seen, key=lambda found: found.times.late)
        raise InputError(
            f"no setting draws this scene in {ms:g} ms on {self.device}; the fastest takes "
            f"{best.times.late:.3g} ms, with an error of {best.error:.2g}"
        )

    def _measured(self, settings: Iterable[Setting]):
        """Those that the device draws, with their errors, as they are asked for."""
        for setting in settings:
            measured = self.calibration.error(setting.of(self.calibration.base))
            if measured is not None:
                yield setting, measured

    def _timed(self, pairs: list[tuple[Setting, float]]) -> list[Found]:
        qualities = [setting.of(self.calibration.base) for setting, _ in pairs]
        times = self.calibration.times(qualities)
        return [
            Found(setting, quality, measured, taken)
            for (setting, measured), quality, taken in zip(pairs, qualities, times, strict=True)
        ]
