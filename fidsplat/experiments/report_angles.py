"""Table 3 from results."""

from __future__ import annotations

from collections.abc import Sequence
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

    def behind(self, protocol: str, category: str, method: str, reader: str) -> list[float]:
        """By how many degrees each marker's unbroken reading ends below that of the ideal texture, on the
        tilts that both have; 90 where it never begins."""
        gaps = []
        ideals = self.of(protocol, category, IDEAL, reader)
        for index, scan in self.of(protocol, category, method, reader).items():
            if index not in ideals:
                continue
            ours, theirs = _common(scan, ideals[index])
            if theirs is not None:
                gaps.append(90.0 if ours is None else theirs - ours)
        return gaps


def _size(line: dict) -> tuple[tuple, float]:
    key = line["key"]
    return (key["protocol"], key["category"], key["index"], key["method"]), len(parse_tilts(key["tilts"]))


def _common(scan: Scan, ideal: Scan) -> tuple[float | None, float | None]:
    both = sorted(set(scan.tilts) & set(ideal.tilts))

    def unbroken(one: Scan) -> float | None:
        at = dict(zip(one.tilts, one.read, strict=True))
        return largest(both, "".join(at[tilt] for tilt in both))[1]

    return unbroken(scan), unbroken(ideal)


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
                heads = ("category", "method", "markers", "found", "read", "read, behind the ideal: worst")
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
    return NOTHING if not there else f"{sum(there) / len(there):.1f}"


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
            gaps = angles.behind(protocol, category, method, reader)
            worst = NOTHING if not gaps or method == IDEAL else _gap(max(gaps))
            rows.append((category, method, str(len(scans)), *cells, worst))
    return rows


def _gap(degrees: float) -> str:
    return "not read frontally" if degrees >= 90 else f"{degrees:+.1f}"


def _chart(angles: Angles, protocol: str) -> str:
    categories = category_order(angles.names(1))
    series = {}
    for method in method_order(angles.names(3)):
        row = []
        for category in categories:
            reader = angles.furthest(CATEGORIES[category].kind)
            scans = angles.of(protocol, category, method, reader).values()
            row.append(bar([largest(s.tilts, s.read)[1] for s in scans]))
        if any(row):
            series[method] = row
    titles = [CATEGORIES[name].title for name in categories]
    return bar_chart(f"Tilt up to which every tilt is read ({protocol})", "degrees", titles, series)
