"""What the experiments are to reach, and what results say of it."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

from fidsplat.experiments.angles import FULL_TILTS, largest
from fidsplat.experiments.document import Document
from fidsplat.experiments.figures import category_order
from fidsplat.experiments.methods import IDEAL
from fidsplat.experiments.paper import ANGLES, VIEWS
from fidsplat.experiments.report_angles import Angles, gap_text
from fidsplat.experiments.report_counts import Counts
from fidsplat.experiments.report_views import Views
from fidsplat.experiments.setup import CATEGORIES, MARKERS, PROTOCOLS, TEST_VIEWS
from fidsplat.experiments.views import LINEAR, TRUTHS

ALLOWED_GAP = {"exact": 0.2, "fitted": 1.0}
"""degrees by which reading may end below the ideal texture's"""
EXACT_PSNR, EXACT_SSIM = 38.7, 0.99
FITTED_GAIN = 3.0
"""dB above the paper's own method"""
FITTED_SHARE = 0.25
"""of the Gaussians of the paper's mixture"""
HUGE_SECONDS = 0.15
_SLACK = 1e-6


class Target(NamedTuple):
    """One thing to reach."""

    what: str
    wanted: str
    found: str
    reached: bool


def report_targets(
    document: Document, angles: Angles | None, views: Views | None, counts: Counts | None
) -> None:
    """Add the table of targets; those that nothing was measured for are left out."""
    targets: list[Target] = []
    if angles is not None:
        targets += [*_gaps(angles), *_misses(angles), *_paper_angles(angles)]
    if views is not None:
        targets += _views(views)
    if counts is not None:
        targets += _counts(counts)
    document.heading("What was to be reached")
    document.text(
        f"To be reached by all {MARKERS} markers of a category, at tilts of {FULL_TILTS} and over "
        f"{TEST_VIEWS} views; what was found is of the markers, tilts and views that were measured: "
        f"{_measured(angles, views)}. The ideal is the same detector's on the ideal texture. "
        f"{sum(target.reached for target in targets)} of {len(targets)} are reached."
    )
    document.table(
        ("target", "wanted", "found", "reached"), [(*t[:3], "yes" if t.reached else "no") for t in targets]
    )


def _measured(angles: Angles | None, views: Views | None) -> str:
    parts = [] if angles is None else [f"tilts of {' and '.join(angles.tilts)}"]
    parts += [] if views is None else [f"{' or '.join(map(str, sorted(views.views)))} views"]
    return ", ".join(parts) or "neither tilts nor views"


def _gaps(angles: Angles) -> Iterator[Target]:
    """The paper's angle is the largest one; what is read without a miss up to it is the stricter question."""
    for protocol, mixture, category in _scanned(angles):
        allowed, method = ALLOWED_GAP[mixture], f"{mixture}/best"
        for reader in sorted(angles.names(4)):
            gaps = [angles.behind(protocol, category, method, reader, which) for which in (0, 1)]
            if any(gaps):
                yield Target(
                    f"{method}, {category}, {reader}, {protocol}: behind the ideal, largest / without a miss",
                    f"<= {allowed} deg",
                    f"{' / '.join(map(gap_text, gaps))} deg, worst of {max(map(len, gaps))}",
                    max(gap for both in gaps for gap in both) <= allowed + _SLACK,
                )


def _misses(angles: Angles) -> Iterator[Target]:
    for protocol, mixture, category in _scanned(angles):
        allowed, method = ALLOWED_GAP[mixture], f"{mixture}/best"
        every = {
            reader: missed
            for reader in sorted(angles.names(4))
            if (missed := angles.missed(protocol, category, method, reader, allowed)) is not None
        }
        if every:
            yield Target(
                f"{method}, {category}, {protocol}: tilts missed below the ceiling",
                f"none up to the ideal's less {allowed} deg",
                ", ".join(f"{reader} {missed} of {total}" for reader, (missed, total) in every.items()),
                not any(missed for missed, _ in every.values()),
            )


def _scanned(angles: Angles) -> Iterator[tuple[str, str, str]]:
    """Protocols, mixtures that have a target, categories."""
    protocols = [name for name in PROTOCOLS if name in angles.names(0)]
    return product(protocols, ALLOWED_GAP, category_order(angles.names(1)))


def _paper_angles(angles: Angles) -> Iterator[Target]:
    for which, words in enumerate(("largest tilt that is read", "read without a miss up to")):
        for category, paper in ANGLES.items():
            wanted = paper["ours"][1]
            ceiling = _decoding(angles, category, IDEAL, which)
            beside = "" if ceiling is None else f" (ideal: {ceiling:.1f})"
            for mixture in ALLOWED_GAP:
                method = f"{mixture}/best"
                mean = _decoding(angles, category, method, which)
                if mean is not None:
                    count = len(angles.of("fixed-module", category, method, "zxing-tall"))
                    yield Target(
                        f"{method}, {category}, fixed-module: {words}, mean",
                        f">= {wanted} deg (paper)",
                        f"{mean:.1f} deg{beside}, mean of {count}",
                        mean >= wanted - _SLACK,
                    )


def _decoding(angles: Angles, category: str, method: str, which: int) -> float | None:
    scans = angles.of("fixed-module", category, method, "zxing-tall").values()
    return statistics.fmean(largest(s.tilts, s.read)[which] or 0.0 for s in scans) if scans else None


def _views(views: Views) -> Iterator[Target]:
    truths = [t for t in TRUTHS if t in views.names(0)]
    for truth in truths:
        for category in category_order(views.names(1)):
            ceiling = views.mean(truth, category, IDEAL, "psnr")
            beside = "" if ceiling is None else f" (a perfect picture of display values: {ceiling:.2f})"
            method = "exact/light" if truth in LINEAR else "exact/best"
            for metric, least in (("psnr", EXACT_PSNR), ("ssim", EXACT_SSIM)):
                value = views.mean(truth, category, method, metric)
                count = len(views.values(truth, category, method, metric))
                if value is not None:
                    unit = " dB" if metric == "psnr" else ""
                    extra = beside if metric == "psnr" else ""
                    yield Target(
                        f"{method}, {category}, {metric} against {truth}",
                        f">= {least}{unit}",
                        f"{value:.4f}{unit}{extra}, mean of {count}",
                        value >= least,
                    )
            fitted = views.mean(truth, category, "fitted/best", "psnr")
            for name, paper in (
                ("paper/screen", views.mean(truth, category, "paper/screen", "psnr")),
                ("the paper's own figure", VIEWS[category]["ours"][0]),
            ):
                if fitted is not None and paper is not None:
                    yield Target(
                        f"fitted/best above {name}, {category}, PSNR against {truth}",
                        f">= {FITTED_GAIN} dB",
                        f"{fitted - paper:+.2f} dB ({fitted:.2f} and {paper:.2f}){beside}",
                        fitted - paper >= FITTED_GAIN,
                    )


def _counts(counts: Counts) -> Iterator[Target]:
    for category in category_order(counts.markers):
        if "exact" in counts.mixtures:
            pairs = list(zip(counts.gaussians(category, "exact"), counts.rectangles(category), strict=True))
            yield Target(
                f"exact, {category}: primitives for each rectangle",
                "1",
                f"{max((n or 0) / r for n, r in pairs):.3f}, worst of {len(pairs)}",
                all(n == r for n, r in pairs),
            )
        if {"fitted", "paper"} <= set(counts.mixtures):
            ours, theirs = (counts.gaussians(category, name) for name in ("fitted", "paper"))
            share = max((a or 0) / (b or 1) for a, b in zip(ours, theirs, strict=True))
            yield Target(
                f"fitted, {category}: Gaussians of those of the paper's mixture",
                f"<= {FITTED_SHARE}",
                f"{share:.3f}, worst of {len(ours)}",
                share <= FITTED_SHARE,
            )
    for mixture in counts.mixtures:
        if "huge" in counts.markers and mixture != "paper":
            seconds = counts.seconds("huge", mixture)
            yield Target(
                f"{mixture}, {CATEGORIES['huge'].title}: construction",
                f"<= {HUGE_SECONDS} s",
                f"{max(seconds):.3f} s, median of the slowest of {len(seconds)}",
                max(seconds) <= HUGE_SECONDS,
            )
