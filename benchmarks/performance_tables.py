"""Turns measured figures into the Markdown tables of docs/performance.md, roofline.md and growth.md.

    python benchmarks/performance_tables.py benchmarks/results/*.json*
    python benchmarks/performance_tables.py benchmarks/results/*.json* --into docs/*.md

Takes what `fidsplat bench --json`, benchmarks/peers, benchmarks/first_frame.py --json,
benchmarks/listing_ways.py --json, benchmarks/large_scenes.py --json and benchmarks/growth.py write, in any
mixture; other figures are left alone. Without --into the tables are printed. With it, each replaces what
stands between `<!-- begin NAME -->` and `<!-- end NAME -->` in those of the pages that have such lines; a
table for which nothing was measured is left alone.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from fidsplat.experiments.bench.catalogue import BENCH_SCENES
from fidsplat.experiments.bench.growth import exponents
from fidsplat.files import atomic_write


def load(files: Iterable[Path]) -> dict[str, list[dict]]:
    """Records by kind; of `peers`, a fidsplat's is followed by the peer's."""
    kinds = ("frames", "peers", "first", "ways", "large", "growth")
    found: dict[str, list[dict]] = {kind: [] for kind in kinds}
    for file in files:
        text = file.read_text("utf-8")
        if file.suffix == ".jsonl":
            found["growth"] += [json.loads(line) for line in text.splitlines()]
            continue
        content = json.loads(text)
        if isinstance(content, list):
            kinds = {"way": "ways", "millions": "large", "caches": "first"}
            for kind in (kinds[key] for key in kinds if key in content[0]):
                found[kind] += content
            continue
        results = [record for record in content.get("results", ()) if record.get("frame_ms")]
        with_peer = any(record["renderer"] != "fidsplat" for record in results)
        found["peers" if with_peer else "frames"] += results
    scenes = list(BENCH_SCENES)
    for kind in ("frames", "peers"):  # devices of one scene stand together, whichever file they come from
        found[kind].sort(key=lambda record: scenes.index(record["scene"]))
    return found


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; empty if there are no rows."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    if not lines:
        return ""
    return "\n".join(["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads), *lines])


def rates(records: dict[str, list[dict]]) -> str:
    """What each device can do at best."""
    rows = {}
    for record in records["frames"]:
        if record.get("rates"):
            best = record["rates"]
            copy = f"{best['copy_bytes'] / 1e9:.0f} GB/s"
            operations = (f"{best[name] / 1e9:.3g} G/s" for name in ("fma", "exp", "division"))
            rows[record["title"]] = (record["title"], copy, *operations)
    return table(("device", "copy, read + write", "multiply-add", "exp", "division"), rows.values())


def frames(records: dict[str, list[dict]]) -> str:
    """Whole frames."""
    rows = []
    for record in records["frames"]:
        low, high = record["quartiles_ms"]
        memory = record["memory_bytes"]
        rows.append(
            (
                record["scene"],
                f"{record['device']}: {record['title']}",
                f"{ms(record['frame_ms'])} ({ms(low)} to {ms(high)})",
                times(record, "frame"),
                f"{record['splats_per_second'] / 1e6:.{0 if record['splats_per_second'] > 1e8 else 2}f} M",
                "-" if memory is None else f"{memory / 2**30:.3g} GiB",
                record["date"],
            )
        )
    return table(("scene", "device", "ms per frame", "x roofline", "splats/s", "memory", "date"), rows)


def stages(records: dict[str, list[dict]]) -> str:
    """Stages, each with how many times its roofline it takes."""
    names = list(dict.fromkeys(stage for record in records["frames"] for stage in record["stages_ms"]))
    rows = []
    for record in records["frames"]:
        cells = (
            f"{ms(record['stages_ms'][name])} ({times(record, name)})" if name in record["stages_ms"] else "-"
            for name in names
        )
        rows.append((record["scene"], f"{record['device']}: {record['title']}", *cells))
    return table(("scene", "device", *names), rows)


def counts(records: dict[str, list[dict]]) -> str:
    """What there is to draw in each scene."""
    rows = {}
    for record in records["frames"]:
        facts = (record.get(name) for name in ("splats", "visible", "fragments"))
        size = f"{record['width']} x {record['height']}"
        cells = ("-" if fact is None else f"{fact:,}" for fact in facts)
        rows.setdefault(record["scene"], (record["scene"], size, *cells))
    return table(("scene", "picture", "splats", "visible", "drawn fragments"), rows.values())


def peers(records: dict[str, list[dict]]) -> str:
    """Others beside us in one run: the record before a peer's is ours."""
    rows, ours = [], {}
    for record in records["peers"]:
        if record["renderer"] == "fidsplat":
            ours = record
            continue
        rows.append(
            (
                record["scene"],
                f"{record['renderer']}, {record['title']}",
                ms(record["frame_ms"]),
                f"{ours['title']}: {ms(ours['frame_ms'])}",
                f"{record['times_ours']:.3g}",
                f"{record['psnr_db']:.1f} dB",
                record["date"],
            )
        )
    heads = ("scene", "peer", "its ms", "our ms", "its / ours", "PSNR of the two pictures", "date")
    return table(heads, rows)


def first(records: dict[str, list[dict]]) -> str:
    """First frames of new processes."""
    rows = []
    for record in records["first"]:
        seconds, (low, high) = record["seconds"], record["range"]
        total = f"{seconds['total']:.2f} s ({low:.2f} to {high:.2f})"
        parts = (f"{seconds[part]:.2f}" for part in seconds if part != "total")
        rows.append((record["scene"], record["device"], record["caches"], total, *parts, record["date"]))
    parts = [part for part in records["first"][0]["seconds"] if part != "total"] if rows else []
    return table(("scene", "device", "caches", "first frame", *parts, "date"), rows)


def ways(records: dict[str, list[dict]]) -> str:
    """Both ways of listing, sort and bin together."""
    rows = []
    for record in records["ways"]:
        parts = record["stages_ms"]["sort"], record["stages_ms"]["bin"]
        cells = (ms(value) for value in (*parts, sum(parts)))
        rows.append((record["scene"], record["device"], record["way"], *cells, record["date"]))
    return table(("scene", "device", "lists", "sort", "bin", "both, ms", "date"), rows)


def large(records: dict[str, list[dict]]) -> str:
    """Tens of millions of splats."""
    rows = []
    for record in records["large"]:
        held = (f"{record[name] / 2**30:.3g} GiB" for name in ("device_bytes", "peak_bytes"))
        seconds = (f"{record[name]:.3g}" for name in ("first_s", "next_s"))
        facts = ("yes" if record["chunks"] else "no", f"{record['visible']:,}", f"{record['pairs']:,}")
        budget = "" if record["budget_gib"] is None else f", budget {record['budget_gib']:g} GiB"
        rows.append(
            (f"{record['millions']} M", record["device"] + budget, *seconds, *held, *facts, record["date"])
        )
    heads = (
        "splats",
        "device",
        "first, s",
        "next, s",
        "device memory",
        "process",
        "chunks",
        "visible",
        "pairs",
        "date",
    )
    return table(heads, rows)


def growth(records: dict[str, list[dict]]) -> str:
    """Exponents of the growth curves."""
    drawn = records["growth"]
    names = list(dict.fromkeys(stage for record in drawn for stage in record.get("stages_ms", ())))
    rows = []
    for title, series, found in exponents(drawn):
        cells = (found.get(name) for name in ("frame", *names))
        rows.append((title, series, *("-" if cell is None else f"{cell:.2f}" for cell in cells)))
    return table(("device", "over", "frame", *names), rows)


TABLES: dict[str, Callable[[dict[str, list[dict]]], str]] = {
    "counts": counts,
    "rates": rates,
    "frames": frames,
    "stages": stages,
    "peers": peers,
    "first": first,
    "ways": ways,
    "large": large,
    "growth": growth,
}


def insert(page: str, name: str, text: str) -> str:
    """The page with the text between the marks of that name, if it has them."""
    marks = re.compile(rf"(<!-- begin {name} -->\n).*?(<!-- end {name} -->)", re.DOTALL)
    return marks.sub(lambda match: f"{match[1]}{text}\n{match[2]}", page)


def ms(value: float) -> str:
    """Milliseconds with three digits."""
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"


def times(record: dict, name: str) -> str:
    """How many times its roofline, or a dash."""
    value = record["times_roofline"].get(name)
    return "-" if value is None else f"{value:.3g}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--into", nargs="+", type=Path, metavar="PAGE")
    options = parser.parse_args()
    records = load(options.files)
    made = {name: text for name, make in TABLES.items() if (text := make(records))}
    if options.into is None:
        print("\n\n".join(f"## {name}\n{text}" for name, text in made.items()))
        return
    for path in options.into:
        page = path.read_text("utf-8")
        filled = page
        for name, text in made.items():
            filled = insert(filled, name, text)
        if filled != page:
            with atomic_write(path) as stream:
                stream.write(filled.encode())


if __name__ == "__main__":
    main()
