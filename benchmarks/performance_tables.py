"""Turns measured figures into the Markdown tables of docs/performance.md and of devlog/.

    python benchmarks/performance_tables.py benchmarks/results/*.json*
    python benchmarks/performance_tables.py benchmarks/results/*.json* --into docs/*.md devlog/*.md

Takes what `fidsplat bench --json`, benchmarks/peers, benchmarks/first_frame.py --json,
benchmarks/listing_ways.py --json, benchmarks/large_scenes.py --json, benchmarks/batches.py --json and
benchmarks/growth.py write, in any mixture; other figures are left alone. Without --into the tables are
printed. With it, each replaces what stands between `<!-- begin NAME -->` and `<!-- end NAME -->` in those of
the pages that have such lines; a table for which nothing was measured is left alone.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import pandas as pd
from growth import exponents

from fidsplat.experiments.bench.catalogue import BENCH_SCENES
from fidsplat.experiments.sweep import read_records
from fidsplat.util.files import atomic_write


def load(files: Iterable[Path]) -> dict[str, list[dict]]:
    """Records by kind; of `peers` and `peer_batches`, a fidsplat's is followed by the peer's; of `backends`,
    which are those of a file where two drew each scene on one machine, OpenCL's by Warp's."""
    kinds = ("frames", "backends", "peers", "first", "ways", "large", "growth", "batches", "peer_batches")
    found: dict[str, list[dict]] = {kind: [] for kind in kinds}
    for file in files:
        if file.suffix == ".jsonl":
            found["growth"] += [record.result for record in read_records(file)]
            continue
        content = json.loads(file.read_text("utf-8"))
        if isinstance(content, list):
            batches = "peer_batches" if "renderer" in content[0] else "batches"
            kinds = {"way": "ways", "budget_gib": "large", "caches": "first", "batch": batches}
            for kind in (kinds[key] for key in kinds if key in content[0]):
                found[kind] += content
            continue
        results = [record for record in content.get("results", ()) if record.get("frame_ms")]
        with_peer = any(record["renderer"] != "fidsplat" for record in results)
        both = len({(record["scene"], record["title"]) for record in results}) < len(results)
        found["peers" if with_peer else "backends" if both else "frames"] += results
    scenes = list(BENCH_SCENES)
    for kind in (
        "frames",
        "backends",
        "peers",
    ):  # devices of one scene stand together, whichever file they come from
        found[kind].sort(key=lambda record: scenes.index(record["scene"]))
    return found


AIMS = {
    "H100": {
        **{"tag": 0.10, "r100k_720p": 0.22, "r1m_1080p": 0.70, "r5m_1080p": 1.7, "r20m_4k": 6.5},
        "qr_wall": 15,
    },
    "EPYC": {"r100k_720p": 30, "r1m_1080p": 190, "r5m_1080p": 650},
}
"""milliseconds of a frame that were aimed at, by a part of the device's name and by scene"""


def markdown(rows: Iterable[dict[str, str]]) -> str:
    """Rows, each with its cells by their heads, as a Markdown table; a dash where a row has none."""
    frame = pd.DataFrame(list(rows)).fillna("-")
    if frame.empty:
        return ""
    lines = ["| " + " | ".join(row) + " |" for row in (frame.columns, *frame.to_numpy())]
    return "\n".join([lines[0], "|" + "---|" * len(frame.columns), *lines[1:]])


def rates(record: dict) -> dict[str, str]:
    """What each device can do at best."""
    best = record["rates"]
    return {
        "device": record["title"],
        "copy, read + write": f"{best['copy_bytes'] / 1e9:.0f} GB/s",
        "multiply-add": f"{best['fma'] / 1e9:.3g} G/s",
        "exp": f"{best['exp'] / 1e9:.3g} G/s",
        "division": f"{best['division'] / 1e9:.3g} G/s",
    }


def frames(record: dict) -> dict[str, str]:
    """Whole frames."""
    low, high = record["quartiles_ms"]
    memory, rate = record["memory_bytes"], record["splats_per_second"]
    return {
        "scene": record["scene"],
        "device": f"{record['device']}: {record['title']}",
        "ms per frame": f"{ms(record['frame_ms'])} ({ms(low)} to {ms(high)})",
        **({"host": ms(record["host_ms"])} if "host_ms" in record else {}),
        "x roofline": times(record, "frame"),
        "splats/s": f"{rate / 1e6:.{0 if rate > 1e8 else 2}f} M",
        "memory": "-" if memory is None else f"{memory / 2**30:.3g} GiB",
        "date": record["date"],
    }


def stages(record: dict) -> dict[str, str]:
    """Stages, each with how many times its roofline it takes."""
    cells = {name: f"{ms(taken)} ({times(record, name)})" for name, taken in record["stages_ms"].items()}
    return {"scene": record["scene"], "device": f"{record['device']}: {record['title']}"} | cells


def aimed_at(record: dict) -> float | None:
    """Milliseconds that a frame may take; None where nothing was aimed at."""
    wanted = (own.get(record["scene"]) for part, own in AIMS.items() if part in record["title"])
    return next(wanted, None)


def aims(record: dict) -> dict[str, str]:
    """A whole frame beside what was aimed at, and how far each stage is from the device's best."""
    at_most, taken = aimed_at(record), record["frame_ms"]
    assert at_most is not None
    cells = {name: f"{ms(own)} ({times(record, name)})" for name, own in record["stages_ms"].items()}
    whole = {
        "scene": record["scene"],
        "device": f"{record['device']}: {record['title']}",
        "at most": ms(at_most),
        "ms per frame": ms(taken),
        "met": "yes" if taken <= at_most else f"no: {taken / at_most:.2f} x",
        **({"host": ms(record["host_ms"])} if "host_ms" in record else {}),
        "all stages": ms(sum(record["stages_ms"].values())),
    }
    return whole | cells


def counts(record: dict) -> dict[str, str]:
    """What there is to draw in each scene."""
    heads = {"splats": "splats", "visible": "visible", "drawn fragments": "fragments"}
    cells = {head: f"{record[name]:,}" for head, name in heads.items() if name in record}
    return {"scene": record["scene"], "picture": f"{record['width']} x {record['height']}"} | cells


def peers(pair: tuple[dict, dict]) -> dict[str, str]:
    """Another beside us in one run."""
    ours, its = pair
    return {
        "scene": its["scene"],
        "peer": f"{its['renderer']}, {its['title']}",
        "its ms": ms(its["frame_ms"]),
        "our ms": f"{ours['title']}: {ms(ours['frame_ms'])}",
        "its / ours": f"{its['times_ours']:.3g}",
        "PSNR of the two pictures": f"{its['psnr_db']:.1f} dB",
        "date": its["date"],
    }


def backends(pair: tuple[dict, dict]) -> dict[str, str]:
    """Two backends on one machine in one run; in brackets the host's part of frames, the first's stages."""
    names = [record["device"].removesuffix(":0") for record in pair]
    of_stages = [record["stages_ms"] for record in pair]
    lists = {"project": ("project",), "sort and bin": ("sort", "bin"), "blend": ("blend", "resolve")}
    first, second = (
        {head: sum(taken.get(part, 0) for part in parts) for head, parts in lists.items()}
        for taken in of_stages
    )
    frames = {
        name: f"{ms(one['frame_ms'])} ({ms(one['host_ms'])})" for name, one in zip(names, pair, strict=True)
    }
    return {
        "scene": pair[0]["scene"],
        **frames,
        "ratio": f"{pair[1]['frame_ms'] / pair[0]['frame_ms']:.2f}",
        **{head: f"{ms(second[head])} ({ms(first[head])})" for head in lists},
        "date": pair[0]["date"],
    }


def first(record: dict) -> dict[str, str]:
    """First frames of new processes."""
    low, high = record["range"]
    parts: dict[str, float] = {**record["seconds"]}
    total = parts.pop("total")
    heads = {"scene": "scene made", "device": "device opened"}
    seconds = {heads.get(part, part): f"{taken:.2f}" for part, taken in parts.items()}
    return {
        "scene": record["scene"],
        "device": record["device"],
        "caches": record["caches"],
        "first frame": f"{total:.2f} s ({low:.2f} to {high:.2f})",
        **seconds,
        "date": record["date"],
    }


def ways(record: dict) -> dict[str, str]:
    """Both ways of listing, sort and bin together."""
    sort, bins = record["stages_ms"]["sort"], record["stages_ms"]["bin"]
    return {
        "scene": record["scene"],
        "device": record["device"],
        "lists": record["way"],
        "sort": ms(sort),
        "bin": ms(bins),
        "both, ms": ms(sort + bins),
        "date": record["date"],
    }


def large(record: dict) -> dict[str, str]:
    """Tens of millions of splats."""
    budget = "" if record["budget_gib"] is None else f", budget {record['budget_gib']:g} GiB"
    return {
        "splats": f"{record['millions']} M",
        "device": record["device"] + budget,
        "first, s": f"{record['first_s']:.3g}",
        "next, s": f"{record['next_s']:.3g}",
        "device memory": f"{record['device_bytes'] / 2**30:.3g} GiB",
        "process": f"{record['peak_bytes'] / 2**30:.3g} GiB",
        "chunks": "yes" if record["chunks"] else "no",
        "visible": f"{record['visible']:,}",
        "pairs": f"{record['pairs']:,}",
        "date": record["date"],
    }


def batches(record: dict) -> dict[str, str]:
    """Batches of views, and the same views one by one."""
    low, high = record["quartiles_us"]
    return {
        "views": f"{record['views']} of {record['width']} x {record['height']}",
        "outputs": ", ".join(record["outputs"]),
        "splats": f"{record['splats']:,}",
        "device": record["device"],
        "us per view": f"{ms(record['us_per_view'])} ({ms(low)} to {ms(high)})",
        "one by one": ms(record["alone_us_per_view"]),
        **{stage: ms(taken) for stage, taken in record["stages_us"].items()},
        "date": record["date"],
    }


def peer_batches(pair: tuple[dict, dict]) -> dict[str, str]:
    """Another's batches of views beside ours in one run."""
    ours, its = pair
    return {
        "views": f"{its['views']} of {its['width']} x {its['height']}",
        "splats": f"{its['splats']:,}",
        "peer, its outputs": f"{its['renderer']}: {', '.join(its['outputs'])}",
        "its us per view": ms(its["us_per_view"]),
        "our outputs": ", ".join(ours["outputs"]),
        "our constants": ours.get("constants", "batches.py's"),
        "our us per view": ms(ours["us_per_view"]),
        "its / ours": f"{its['times_ours']:.3g}",
        "PSNR of the two pictures": f"{its['psnr_same_constants_db']:.1f} dB",
        "date": its["date"],
    }


def growth(curve: tuple[str, str, dict[str, float | None]]) -> dict[str, str]:
    """Exponents of a growth curve."""
    title, series, found = curve
    cells = {name: "-" if cell is None else f"{cell:.2f}" for name, cell in found.items()}
    return {"device": title, "over": series} | cells


def first_of_each_scene(records: list[dict]) -> list[dict]:
    """One record of each scene, in their order."""
    scenes = dict.fromkeys(record["scene"] for record in records)
    return [next(record for record in records if record["scene"] == scene) for scene in scenes]


def tables(records: dict[str, list[dict]]) -> dict[str, str]:
    """Every table for which something was measured, by its name."""
    drawn = records["frames"]
    pairs, batch_pairs = (
        [pair for pair in pairwise(records[kind]) if not pair[1]["renderer"].startswith("fidsplat")]
        for kind in ("peers", "peer_batches")
    )
    rows = {
        "counts": map(counts, first_of_each_scene(drawn)),
        "rates": map(rates, {record["title"]: record for record in drawn if record.get("rates")}.values()),
        "frames": map(frames, drawn),
        "backends": map(backends, zip(records["backends"][::2], records["backends"][1::2], strict=True)),
        "aims": map(aims, (record for record in drawn if aimed_at(record) is not None)),
        "stages": map(stages, drawn),
        "peers": map(peers, pairs),
        "first": map(first, records["first"]),
        "ways": map(ways, records["ways"]),
        "large": map(large, records["large"]),
        "batches": map(batches, records["batches"]),
        "peer_batches": map(peer_batches, batch_pairs),
        "growth": map(growth, exponents(records["growth"])),
    }
    return {name: text for name in TABLES if (text := markdown(rows[name]))}


TABLES = (
    *(
        "counts",
        "rates",
        "frames",
        "backends",
        "aims",
        "stages",
        "peers",
        "first",
        "ways",
        "large",
        "batches",
    ),
    *("peer_batches", "growth"),
)


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
    made = tables(records)
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
