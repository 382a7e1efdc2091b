"""Result tables of the self-test: title, column heads and rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from fidsplat.selftest import digests
from fidsplat.selftest.agreement import COLOR_TOLERANCE, DEPTH_TOLERANCE
from fidsplat.selftest.arithmetic import BOUNDS, Arithmetic
from fidsplat.selftest.catalogue import GROUPS
from fidsplat.selftest.check import CaseResult, CheckResult, rank_of
from fidsplat.selftest.fuzz import FuzzState

Table = tuple[str, Sequence[str], Iterable[Sequence[object]]]


def arithmetic_table(facts: Arithmetic, device: str) -> Table:
    """Table with a row for each arithmetic function of the device: its largest error and the bound."""
    rows = [
        (name, f"{ulp:.2f}", f"{BOUNDS[name]:g}", "ok" if ulp <= BOUNDS[name] * 1.001 else "too large")
        for name, ulp in facts.ulp.items()
    ]
    return f"Arithmetic of {device}", ("function", "error [ulp]", "bound", ""), rows


def case_table(result: CheckResult) -> Table:
    """Largest errors of each group of hard cases, next to their bounds."""
    heads = ("group", "cases", "images", "colour", "beyond bound", "depth", "beyond bound", "verdict")
    bounds = ("bound", "", "", "", f"{COLOR_TOLERANCE:.0e}", "", f"{DEPTH_TOLERANCE:.0e}", "")
    return "Largest errors", heads, [bounds, *(_case_row(*group) for group in result.groups.items())]


def _case_row(letter: str, results: list[CaseResult]) -> tuple[str, ...]:
    cells = [f"{letter} {GROUPS[letter]}", str(len(results)), str(sum(case.frames for case in results))]
    for outputs in (("rgb", "alpha"), ("depth",)):
        for kind in ("largest", "beyond_bound"):
            maxima = [getattr(case, kind) for case in results]
            values = [errors[name] for errors in maxima for name in outputs if name in errors]
            cells.append(f"{max(values, key=rank_of):.0e}" if values else "-")
    return (*cells, "ok" if all(case.passed for case in results) else "failed")


def digest_table(seeds: Iterable[int], differing: Mapping[int, Sequence[str]], device: str) -> Table:
    """Number of bit-identical scenes of each kind. differing: differing outputs by the seed of the scene."""
    seeds_of_kind = {
        kind: [seed for seed in seeds if digests.kind_of(seed) is kind] for kind in digests.KINDS
    }
    rows = [
        (
            kind.name,
            f"{sum(seed not in differing for seed in seeds_of_kind[kind])} of {len(seeds_of_kind[kind])}",
            ", ".join(
                n
                for n in digests.OUTPUTS
                if any(n in differing.get(seed, ()) for seed in seeds_of_kind[kind])
            ),
            " ".join(str(seed) for seed in seeds_of_kind[kind] if seed in differing),
        )
        for kind in digests.KINDS
        if seeds_of_kind[kind]
    ]
    return f"Digests on {device}", ("scenes", "identical", "outputs that differ", "seeds"), rows


def fuzz_table(state: FuzzState, device: str) -> Table:
    """Largest errors of random scenes with their seeds."""
    rows = [
        (name, *(cell for error, seed in pair for cell in (f"{error:.1e}", str(seed))))
        for name in state.largest
        for pair in [(state.beyond_bound[name], state.largest[name])]
    ]
    heads = ("output", "error beyond the bound", "seed", "error", "seed")
    return f"Largest errors of random scenes on {device}", heads, rows
