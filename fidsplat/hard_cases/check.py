"""The self-test of a device: all hard cases, its arithmetic, and a picture of the worst case."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from fidsplat.backends.base import DeviceInfo
from fidsplat.errors import DeviceError
from fidsplat.hard_cases import GROUPS
from fidsplat.hard_cases.agreement import TOLERANCE, Difference, Picture, compare, truth_of
from fidsplat.hard_cases.arithmetic import Arithmetic, measure
from fidsplat.hard_cases.case import Case, Finding
from fidsplat.hard_cases.invariance import draw
from fidsplat.render import Renderer


@dataclass(frozen=True)
class Worst:
    """The picture of the suite that is furthest from the reference."""

    title: str
    device: np.ndarray
    """(h, w, 3) rgb"""
    reference: np.ndarray
    certificate: np.ndarray
    """(h, w)"""
    rank: tuple[bool, float]
    """whether it fails, and its largest error"""


@dataclass(frozen=True)
class CaseResult:
    """One case on one device."""

    case: Case
    pictures: int
    uncertified: dict[str, float]
    """output -> largest error beyond the certificate"""
    largest: dict[str, float]
    """output -> largest error, certified ones included"""
    findings: tuple[Finding, ...]
    wrong: tuple[str, ...]
    """what does not hold, in words; empty when all of it does"""
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether all of it holds."""
        return not self.wrong


@dataclass(frozen=True)
class GroupResult:
    """The cases of one letter."""

    letter: str
    cases: tuple[CaseResult, ...]

    @property
    def title(self) -> str:
        """What the group is about."""
        return GROUPS[self.letter]

    @property
    def pictures(self) -> int:
        """Pictures compared with the reference."""
        return sum(case.pictures for case in self.cases)

    @property
    def passed(self) -> bool:
        """Whether all its cases do."""
        return all(case.passed for case in self.cases)

    def error(self, kind: str, *outputs: str) -> float | None:
        """Largest `uncertified` or `largest` error of these outputs; None without a picture."""
        errors = [getattr(case, kind) for case in self.cases]
        values = [case[name] for case in errors for name in outputs if name in case]
        return max(values, key=_rank) if values else None


@dataclass(frozen=True)
class CheckResult:
    """What a device's self-test found."""

    device: DeviceInfo
    arithmetic: Arithmetic | None
    cases: tuple[CaseResult, ...]
    worst: Worst | None
    seconds: float

    @property
    def groups(self) -> list[GroupResult]:
        """The cases by letter."""
        return [
            GroupResult(letter, chosen)
            for letter in GROUPS
            if (chosen := tuple(case for case in self.cases if case.case.group == letter))
        ]

    @property
    def failures(self) -> list[str]:
        """What does not hold, in words."""
        measured = self.arithmetic.findings if self.arithmetic else []
        return [
            *(f"arithmetic: {f.what} is {f.value:.3g}, above {f.bound:.3g}" for f in measured if not f.holds),
            *(f"{case.case.name}: {words}" for case in self.cases for words in case.wrong),
        ]

    @property
    def passed(self) -> bool:
        """Whether everything holds."""
        return not self.failures

    def as_dict(self) -> dict:
        """Everything but the pictures, for JSON."""
        arithmetic = self.arithmetic
        return {
            "device": self.device.name,
            "title": self.device.title,
            "platform": self.device.platform,
            "version": self.device.version,
            "passed": self.passed,
            "seconds": self.seconds,
            "arithmetic": arithmetic
            and {"float64": arithmetic.float64, "denormals": arithmetic.denormals, "ulp": arithmetic.ulp},
            "tolerance": TOLERANCE,
            "failures": self.failures,
            "cases": [
                {
                    "name": result.case.name,
                    "title": result.case.title,
                    "trigger": result.case.trigger,
                    "passed": result.passed,
                    "pictures": result.pictures,
                    "uncertified_error": result.uncertified,
                    "largest_error": result.largest,
                    "findings": [
                        {"what": f.what, "value": f.value, "bound": f.bound, "holds": f.holds}
                        for f in result.findings
                    ],
                    "seconds": result.seconds,
                }
                for result in self.cases
            ],
        }


def run_check(
    renderer: Renderer, cases: Iterable[Case], tell: Callable[[str], None] = lambda doing: None
) -> CheckResult:
    """Run cases on a device. What the device cannot do at all fails its case; the others go on.

    Args:
        tell: is told what is being done, before each case.
    """
    begun = time.perf_counter()
    tell("arithmetic")
    arithmetic = measure(renderer)
    results, seen = [], _Seen()
    for case in cases:
        tell(f"{case.name}: {case.title}")
        results.append(run_case(renderer, case, seen))
    seconds = time.perf_counter() - begun
    return CheckResult(renderer.device, arithmetic, tuple(results), seen.worst, seconds)


@dataclass
class _Seen:
    """The worst picture so far."""

    worst: Worst | None = None

    def add(self, title: str, frame, truth: dict, difference: Difference) -> None:
        """A plane of a picture; kept if it is worse than all before."""
        rank = not difference.agrees, _rank(difference.error)
        # what agrees is shown if it can be seen
        seen = difference.output in ("rgb", "alpha") or rank[0]
        if seen and (self.worst is None or rank > self.worst.rank):
            words = f"{title}, {difference.output}: wrong by {difference.error:.0e}"
            words += f", uncertified {difference.uncertified:.0e}"
            rgb = np.array(frame["rgb"], dtype=np.float64)
            self.worst = Worst(words, rgb, truth["rgb"], truth["certificate"], rank)


def run_case(renderer: Renderer, case: Case, seen: _Seen | None = None) -> CaseResult:
    """Run one case on a device."""
    begun = time.perf_counter()
    uncertified: dict[str, float] = {}
    largest: dict[str, float] = {}
    wrong: list[str] = []
    findings: list[Finding] = []
    count = 0
    try:
        for count, picture in enumerate(case.pictures() if case.pictures else (), start=1):
            title = f"{case.name}, picture {count}"
            for difference in _differences(renderer, picture, title, seen):
                name = difference.output
                uncertified[name] = max(uncertified.get(name, 0.0), difference.uncertified, key=_rank)
                largest[name] = max(largest.get(name, 0.0), difference.error, key=_rank)
                if not difference.agrees:
                    wrong.append(_in_words(count, difference))
        for finding in case.check(renderer) if case.check else ():
            findings.append(finding)
            if not finding.holds:
                wrong.append(f"{finding.what} is {finding.value:.3g}, above {finding.bound:.3g}")
    except DeviceError as error:
        wrong.append(str(error))
    seconds = time.perf_counter() - begun
    return CaseResult(case, count, uncertified, largest, tuple(findings), tuple(wrong), seconds)


def _differences(renderer: Renderer, picture: Picture, title: str, seen: _Seen | None) -> list[Difference]:
    frame, truth = draw(renderer, picture), truth_of(picture)
    differences = compare(frame, truth, picture.outputs)
    if seen is not None and "rgb" in picture.outputs:
        for difference in differences:
            seen.add(title, frame, truth, difference)
    return differences


def worst_picture(worst: Worst) -> np.ndarray:
    """Device, reference, difference and certificate side by side, (h, w, 3) uint8.

    The difference and the certificate are multiplied by a power of ten, so that they can be seen.
    """
    from fidsplat.vision.images import to_uint8
    from fidsplat.vision.paint import contact_sheet

    difference = np.abs(worst.device - worst.reference)
    certificate = np.repeat(worst.certificate[:, :, None], 3, axis=2)
    panels = [(worst.title, worst.device), ("reference, float64", worst.reference)]
    for name, plane in (("difference", difference), ("certificate", certificate)):
        peak = float(np.nan_to_num(plane, posinf=1.0).max(initial=0.0))
        factor = 10.0 ** np.clip(np.floor(-np.log10(peak)), 0, 9) if peak > 0 else 1.0
        panels.append((f"{name} x {factor:.0e}, at most {peak:.1e}", plane * factor))
    times = -(-400 // worst.device.shape[1])
    shown = [(name, to_uint8(plane).repeat(times, axis=0).repeat(times, axis=1)) for name, plane in panels]
    return contact_sheet([shown[:2], shown[2:]], width=times * worst.device.shape[1])


def _in_words(number: int, difference: Difference) -> str:
    plane = f"picture {number}, {difference.output}"
    if not difference.finite:
        return f"{plane} holds values that are not finite"
    if difference.excess > 0:
        return (
            f"{plane} is wrong by {difference.uncertified:.1e} beyond its certificate, above "
            f"{TOLERANCE[difference.output]:.0e}"
        )
    return f"{plane}: {difference.risky:.1%} of the pixels have certificates above 0.05"


def _rank(value: float) -> float:
    """A NaN is worse than anything."""
    return float("inf") if np.isnan(value) else value
