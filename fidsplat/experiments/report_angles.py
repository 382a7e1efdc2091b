"""Table 3 from results."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from fidsplat.experiments.angles import largest, parse_tilts
from fidsplat.experiments.charts import bar_chart
from fidsplat.experiments.document import Document
from fidsplat.experiments.figures import (
    NOTHING,
    bar,
    category_order,
    full_or_quick,
    mean_spread,
    method_order,
)
from fidsplat.experiments.methods import IDEAL
from fidsplat.experiments.paper import ANGLES
from fidsplat.experiments.setup import CATEGORIES, COLLECTIONS, PROTOCOLS
from fidsplat.vision.readers import TITLES

# the detectors of each kind by how far they read on the ideal texture: the first that is there is shown
_FURTHEST = {"apriltag": ("pupil", "aruco"), "qr": ("zxing-tall", "zxing", "cv2")}


NEVER = 90.0
"""degrees behind the ideal of what is not read at all"""


class Scan(NamedTuple):
    """One marker by one method under one protocol, as one detector saw it."""

    tilts: list[float]
    found: str
    read: str


class Angles:
    """Scans by what they are of.

    Args:
        lines: of `angles.jsonl`.
    """

    def __init__(self, lines: Sequence[dict]) -> None:
        chosen = full_or_quick(lines, _size)
        self.scans: dict[tuple[str, str, int, str, str], Scan] = {}
        for (protocol, category, index, method), line in chosen.items():
            tilts = parse_tilts(line["key"]["tilts"])
            for reader, seen in line["result"]["readers"].items():
                scan = Scan(tilts, seen["found"], seen["read"])
                self.scans[protocol, category, index, method, reader] = scan
        self.tilts = sorted({line["key"]["tilts"] for line in chosen.values()})

    def of(self, protocol: str, category: str, method: str, reader: str) -> dict[int, Scan]:
        """The scans by marker."""
        keys = (protocol, category, method, reader)
        return {i: s for (p, c, i, m, r), s in self.scans.items() if (p, c, m, r) == keys}

    def names(self, place: int) -> set[str]:
        """What occurs: 0 protocols, 1 categories, 3 methods, 4 detectors."""
        return {str(key[place]) for key in self.scans}

    def furthest(self, kind: str) -> str:
        """The detector that the short table shows for "apriltag" or "qr"."""
        there = self.names(4)
        return next((name for name in _FURTHEST[kind] if name in there), _FURTHEST[kind][0])

    def behind(self, protocol: str, category: str, method: str, reader: str, which: int) -> list[float]:
        """By how many degrees each marker's largest tilt of reading (`which` 0), or the largest without a
        miss (1), lies below that of the ideal texture, on the tilts that both have; `NEVER` where there is
        none."""
        gaps = []
        for tilts, ours, theirs in self._beside_ideal(protocol, category, method, reader):
            own, ceiling = (largest(tilts, hits)[which] for hits in (ours, theirs))
            if ceiling is not None:
                gaps.append(NEVER if own is None else ceiling - own)
        return gaps

    def missed(
        self, protocol: str, category: str, method: str, reader: str, less: float
    ) -> tuple[int, int] | None:
        """How many tilts are not read of those up to ``less`` degrees below the one to which the ideal
        texture is read without a miss, and how many those are, over the markers; None where there is none."""
        missed = total = 0
        for tilts, ours, theirs in self._beside_ideal(protocol, category, method, reader):
            ceiling = largest(tilts, theirs)[1]
            if ceiling is not None:
                below = [hit for tilt, hit in zip(tilts, ours, strict=True) if tilt <= ceiling - less + 1e-6]
                missed, total = missed + below.count("0"), total + len(below)
        return (missed, total) if total else None

    def _beside_ideal(
        self, protocol: str, category: str, method: str, reader: str
    ) -> Iterator[tuple[list[float], str, str]]:
        """Of each marker that the ideal has as well: the tilts that both have, and who reads them."""
        ideals = self.of(protocol, category, IDEAL, reader)
        for index, scan in self.of(protocol, category, method, reader).items():
            if index in ideals:
                both = sorted(set(scan.tilts) & set(ideals[index].tilts))
                yield both, _at(scan, both), _at(ideals[index], both)


def _size(line: dict) -> tuple[tuple, float]:
    key = line["key"]
    return (key["protocol"], key["category"], key["index"], key["method"]), len(parse_tilts(key["tilts"]))


def _at(scan: Scan, tilts: list[float]) -> str:
    read = dict(zip(scan.tilts, scan.read, strict=True))
    return "".join(read[tilt] for tilt in tilts)


def report_angles(document: Document, lines: Sequence[dict]) -> dict[str, str]:
    """Add table 3; returns charts, file name -> SVG."""
    angles = Angles(lines)
    document.heading("Table 3: largest tilts at which markers are found and read")
    document.text(
        f"Tilts {' and '.join(angles.tilts)} (first:last:step, degrees). Each cell of the long tables: the "
        "largest single tilt / the largest below which no tilt is missed; mean ± standard deviation over the "
        "markers. The ideal texture is the ceiling that the detector itself has. The paper does not say its "
        "camera or its decoder."
    )
    charts = {}
    for protocol in (name for name in PROTOCOLS if name in angles.names(0)):
        document.heading(f"Protocol {protocol}: {PROTOCOLS[protocol].title}", 3)
        _short(document, angles, protocol)
        for reader in (name for name in TITLES if name in angles.names(4)):
            rows = _rows(angles, protocol, reader)
            if rows:
                document.heading(f"{protocol}, {TITLES[reader]}", 4)
                heads = (
                    "category",
                    "method",
                    "markers",
                    "found",
                    "read",
                    "read, behind the ideal: worst of each",
                )
                document.table(heads, rows)
        charts[f"angles-{protocol}.svg"] = _chart(angles, protocol)
        document.picture(f"angles-{protocol}.svg", f"Reading angles, {protocol}")
    return charts


def _short(document: Document, angles: Angles, protocol: str) -> None:
    """As in the paper: a row for each category, detection and decoding angles of each method."""
    methods = [m for m in method_order(angles.names(3)) if not m.startswith("2dgs-")]
    rows = []
    for category in category_order(angles.names(1)):
        reader = angles.furthest(CATEGORIES[category].kind)
        paper = ANGLES.get(category)
        row = [CATEGORIES[category].title]
        row.append(NOTHING if paper is None else "{:.1f} {:.1f}".format(*paper["ours"]))
        for method in methods:
            scans = angles.of(protocol, category, method, reader).values()
            pairs = [(largest(s.tilts, s.found)[0], largest(s.tilts, s.read)[0]) for s in scans]
            found, read = ([pair[k] for pair in pairs] for k in (0, 1))
            row.append(f"{_plain(found)} {_plain(read)}")
        for views in COLLECTIONS:
            scans = angles.of(protocol, category, f"2dgs-{views}", reader).values()
            pairs = [(largest(s.tilts, s.found)[0], largest(s.tilts, s.read)[0]) for s in scans]
            own = " ".join(_plain([pair[k] for pair in pairs]) for k in (0, 1)) if pairs else NOTHING
            row.append(own if paper is None else "{} (paper {:.1f} {:.1f})".format(own, *paper[views]))
        rows.append(row)
    document.text(
        "As the paper has it: largest angle of detection and of decoding, mean over the markers, with "
        f"{TITLES[angles.furthest('apriltag')]} and {TITLES[angles.furthest('qr')]}."
    )
    baselines = [f"2DGS, {views} views" for views in COLLECTIONS]
    document.table(("category", "paper, its own", *methods, *baselines), rows)


def _plain(values: list[float | None]) -> str:
    there = [value for value in values if value is not None]
    if not there:
        return "never" if values else NOTHING
    never = f" ({len(values) - len(there)} of {len(values)} never)" if there != values else ""
    return f"{sum(there) / len(there):.1f}{never}"


def _rows(angles: Angles, protocol: str, reader: str) -> list[tuple[str, ...]]:
    rows = []
    for category in category_order(angles.names(1)):
        for method in method_order(angles.names(3)):
            scans = angles.of(protocol, category, method, reader).values()
            if not scans:
                continue
            cells = []
            for hits in ([(s.tilts, s.found) for s in scans], [(s.tilts, s.read) for s in scans]):
                pairs = [largest(*one) for one in hits]
                single, unbroken = ([pair[k] for pair in pairs] for k in (0, 1))
                cells.append(f"{mean_spread(single, 1, True)} / {mean_spread(unbroken, 1, True)}")
            gaps = [angles.behind(protocol, category, method, reader, which) for which in (0, 1)]
            worst = NOTHING if method == IDEAL else " / ".join(map(gap_text, gaps))
            rows.append((category, method, str(len(scans)), *cells, worst))
    return rows


def gap_text(gaps: Sequence[float]) -> str:
    """The worst of some degrees behind the ideal."""
    if not gaps:
        return NOTHING
    return "not read frontally" if max(gaps) >= NEVER else f"{max(gaps):+.1f}"


def _chart(angles: Angles, protocol: str) -> str:
    categories = category_order(angles.names(1))
    series = {}
    for method in method_order(angles.names(3)):
        row = []
        for category in categories:
            reader = angles.furthest(CATEGORIES[category].kind)
            scans = angles.of(protocol, category, method, reader).values()
            row.append(bar([largest(s.tilts, s.read)[1] or 0.0 for s in scans]))
        if any(row):
            series[method] = row
    titles = [CATEGORIES[name].title for name in categories]
    return bar_chart(f"Tilt up to which every tilt is read ({protocol})", "degrees", titles, series)
