"""Self-test of a device: all hard cases, its arithmetic, and an image of the worst case."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field

import numpy as np

from fidsplat.backends.interface import DeviceInfo
from fidsplat.effects import OUTPUTS
from fidsplat.render.renderer import Renderer
from fidsplat.selftest.agreement import Difference, FrameSpec, compare, reference_images, render, tolerance_of
from fidsplat.selftest.arithmetic import Arithmetic, measure
from fidsplat.selftest.case import Case, Finding
from fidsplat.util.errors import DeviceError


@dataclass(frozen=True)
class Worst:
    """The frame that differs most from the reference."""

    title: str
    device: np.ndarray
    """(h, w, 3) rgb"""
    reference: np.ndarray
    error_bound: np.ndarray
    """(h, w)"""
    rank: tuple[bool, float]
    """sort key: whether the frame fails, and its largest error"""


@dataclass
class CaseResult:
    """Result of a case on a device."""

    case: Case
    frames: int = 0
    beyond_bound: dict[str, float] = field(default_factory=dict)
    """output -> largest error beyond the error bound"""
    largest: dict[str, float] = field(default_factory=dict)
    """output -> largest error, including pixels with an error bound"""
    findings: list[Finding] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    """failures as messages"""
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        return not self.wrong


@dataclass(frozen=True)
class CheckResult:
    """Result of the self-test of a device."""

    device: DeviceInfo
    arithmetic: Arithmetic | None
    cases: list[CaseResult]
    worst: Worst | None
    seconds: float

    @property
    def groups(self) -> dict[str, list[CaseResult]]:
        """Results by the letter of their group."""
        letters = dict.fromkeys(result.case.name[0] for result in self.cases)
        return {
            letter: [result for result in self.cases if result.case.name[0] == letter] for letter in letters
        }

    @property
    def failures(self) -> list[str]:
        measured = self.arithmetic.findings if self.arithmetic else []
        return [
            *(f"arithmetic: {f.what} is {f.value:.3g}, above {f.bound:.3g}" for f in measured if not f.holds),
            *(f"{case.case.name}: {words}" for case in self.cases for words in case.wrong),
        ]

    @property
    def passed(self) -> bool:
        return not self.failures

    def as_dict(self) -> dict:
        """The result without images, for JSON."""
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
            "tolerance": {name: tolerance_of(name) for name in OUTPUTS},
            "failures": self.failures,
            "cases": [
                {
                    "name": result.case.name,
                    "title": result.case.title,
                    "trigger": result.case.trigger,
                    "passed": result.passed,
                    "frames": result.frames,
                    "error_beyond_bound": result.beyond_bound,
                    "largest_error": result.largest,
                    "findings": [asdict(found) | {"holds": found.holds} for found in result.findings],
                    "seconds": result.seconds,
                }
                for result in self.cases
            ],
        }


def run_check(
    renderer: Renderer, cases: Iterable[Case], report: Callable[[str], None] = lambda message: None
) -> CheckResult:
    """Run cases on a device. A case that the device cannot run fails; the other cases run.

    Args:
        report: called with a message before each case.
    """
    begun = time.perf_counter()
    report("arithmetic")
    arithmetic = measure(renderer)
    results: list[CaseResult] = []
    worst: Worst | None = None
    for case in cases:
        report(f"{case.name}: {case.title}")
        result, worst = run_case(renderer, case, worst)
        results.append(result)
    return CheckResult(renderer.device, arithmetic, results, worst, time.perf_counter() - begun)


def run_case(renderer: Renderer, case: Case, worst: Worst | None = None) -> tuple[CaseResult, Worst | None]:
    """Run a case on a device; returns its result, and the worse of `worst` and the case's worst frame."""
    begun = time.perf_counter()
    result = CaseResult(case)
    try:
        for agreement in case.run(renderer):
            if isinstance(agreement, FrameSpec):
                result.frames += 1
                worst = _compared(renderer, agreement, result, worst)
            else:
                result.findings.append(agreement)
                if not agreement.holds:
                    result.wrong.append(
                        f"{agreement.what} is {agreement.value:.3g}, above {agreement.bound:.3g}"
                    )
    except DeviceError as error:
        result.wrong.append(str(error))
    result.seconds = time.perf_counter() - begun
    return result, worst


def _compared(renderer: Renderer, spec: FrameSpec, result: CaseResult, worst: Worst | None) -> Worst | None:
    frame, expected = render(renderer, spec), reference_images(spec)
    for difference in compare(frame, expected, spec.outputs):
        name = difference.output
        raise_to(result.beyond_bound, name, difference.beyond_bound)
        raise_to(result.largest, name, difference.error)
        if not difference.agrees:
            result.wrong.append(_in_words(result.frames, difference))
        rank = not difference.agrees, rank_of(difference.error)
        # frames that agree are candidates only if the error is visible in rgb
        visible = "rgb" in spec.outputs and (name in ("rgb", "alpha") or rank[0])
        if visible and (worst is None or rank > worst.rank):
            words = f"{result.case.name}, frame {result.frames}, {name}: error {difference.error:.0e}"
            words += f", beyond the bound {difference.beyond_bound:.0e}"
            rgb = np.array(frame["rgb"], dtype=np.float64)
            worst = Worst(words, rgb, expected["rgb"], expected["error_bound"], rank)
    return worst


def worst_image(worst: Worst) -> np.ndarray:
    """Contact sheet (h, w, 3) uint8: the device's image, the reference image, their difference, its bound.

    The bound is the difference that rounding explains. Difference and bound are each scaled by
    a power of ten.
    """
    from fidsplat.images.files import to_uint8
    from fidsplat.images.visualize import contact_sheet, write

    difference = np.abs(worst.device - worst.reference)
    error_bound = np.repeat(worst.error_bound[:, :, None], 3, axis=2)
    panels = [("device", worst.device), ("reference, float64", worst.reference)]
    for name, plane in (("difference", difference), ("allowed by rounding", error_bound)):
        peak = float(np.nan_to_num(plane, posinf=1.0).max(initial=0.0))
        factor = 10.0 ** np.clip(np.floor(-np.log10(peak)), 0, 9) if peak > 0 else 1.0
        panels.append((f"{name} x {factor:.0e}, at most {peak:.1e}", plane * factor))
    times = -(-400 // worst.device.shape[1])
    shown = [(name, to_uint8(plane).repeat(times, axis=0).repeat(times, axis=1)) for name, plane in panels]
    sheet = contact_sheet([shown[:2], shown[2:]], width=times * worst.device.shape[1])
    verdict = "FAILS: beyond rounding" if worst.rank[0] else "Agrees: the difference is due to rounding"
    lines = (f"Case {worst.title}", f"{verdict} and decisions that rounding can flip (the error bound).")
    caption = np.full((24 * len(lines) + 8, sheet.shape[1], 3), sheet[0, 0], np.uint8)
    for row, line in enumerate(lines):
        write(caption, line, (8, 24 * row + 18), size=0.45)
    return np.concatenate([caption, sheet])


def _in_words(number: int, difference: Difference) -> str:
    image = f"frame {number}, {difference.output}"
    if not difference.finite:
        return f"{image} has values that are not finite"
    if difference.excess > 0:
        return (
            f"{image} has an error of {difference.beyond_bound:.1e} beyond its error bound, above "
            f"{tolerance_of(difference.output):.0e}"
        )
    return f"{image}: {difference.risky:.1%} of the pixels have error bounds above 0.05"


def raise_to(largest: dict[str, float], name: str, value: float) -> None:
    """Raise the value of a name to at least `value`."""
    largest[name] = max(largest.get(name, 0.0), value, key=rank_of)


def rank_of(value: float) -> float:
    """Sort key of an error; NaN is the largest."""
    return float("inf") if np.isnan(value) else value
