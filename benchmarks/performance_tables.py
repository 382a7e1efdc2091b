"""Write the Markdown tables of docs/performance.md and devlog/ from measurements.

    python benchmarks/performance_tables.py benchmarks/results/*.json*
    python benchmarks/performance_tables.py benchmarks/results/*.json* --into docs/*.md devlog/*.md

Reads the files of `fidsplat bench --json`, benchmarks/peers, benchmarks/first_frame.py --json,
benchmarks/batches.py --json and benchmarks/growth.py, and ignores others. Without --into the tables are
printed. With it, each table replaces the text between `<!-- begin NAME -->` and `<!-- end NAME -->` in the
pages that have these lines; a table without measurements is left as it is.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

from growth import exponents
from tables import insert, markdown, ms

from fidsplat.experiments.bench.catalogue import BENCH_SCENES
from fidsplat.experiments.sweep import read_records
from fidsplat.util.files import atomic_write


def load(files: Iterable[Path]) -> dict[str, list[dict]]:
    """Records by kind. `peers`, `peer_batches` and `backends` contain pairs of records: of fidsplat and a
    peer, or of OpenCL and Warp on one machine."""
    kinds = ("frames", "backends", "peers", "first", "growth", "batches", "peer_batches")
    found: dict[str, list[dict]] = {kind: [] for kind in kinds}
    for file in files:
        if file.suffix == ".jsonl":
            found["growth"] += [record.result for record in read_records(file)]
            continue
        content = json.loads(file.read_text("utf-8"))
        if isinstance(content, list):
            batches = "peer_batches" if "renderer" in content[0] else "batches"
            kinds = {"caches": "first", "batch": batches}
            for kind in (kinds[key] for key in kinds if key in content[0]):
                found[kind] += content
            continue
        results = [record for record in content.get("results", ()) if record.get("frame_ms")]
        with_peer = any(record["renderer"] != "fidsplat" for record in results)
        both = len({(record["scene"], record["title"]) for record in results}) < len(results)
        found["peers" if with_peer else "backends" if both else "frames"] += results
    scenes = list(BENCH_SCENES)
    for kind in ("frames", "backends", "peers"):  # group the devices of a scene
        found[kind].sort(key=lambda record: scenes.index(record["scene"]))
    return found


def rates(record: dict) -> dict[str, str]:
    """Peak rates of a device."""
    best = record["rates"]
    return {
        "device": record["title"],
        "copy, read + write": f"{best['copy_bytes'] / 1e9:.0f} GB/s",
        "multiply-add": f"{best['fma'] / 1e9:.3g} G/s",
        "exp": f"{best['exp'] / 1e9:.3g} G/s",
        "division": f"{best['division'] / 1e9:.3g} G/s",
    }


def frames(record: dict) -> dict[str, str]:
    """Frame times."""
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
    }


def stages(record: dict) -> dict[str, str]:
    """Stage times, with the ratio to the roofline in brackets."""
    cells = {name: f"{ms(taken)} ({times(record, name)})" for name, taken in record["stages_ms"].items()}
    return {"scene": record["scene"], "device": f"{record['device']}: {record['title']}"} | cells


def counts(record: dict) -> dict[str, str]:
    """Numbers of splats and fragments of a scene."""
    heads = {"splats": "splats", "visible": "visible", "fragments": "fragments"}
    cells = {head: f"{record[name]:,}" for head, name in heads.items() if name in record}
    return {"scene": record["scene"], "image": f"{record['width']} x {record['height']}"} | cells


def peers(pair: tuple[dict, dict]) -> dict[str, str]:
    """Frame times of a peer and of fidsplat in one run."""
    ours, its = pair
    return {
        "scene": its["scene"],
        "peer": f"{its['renderer']}, {its['title']}",
        "its ms": ms(its["frame_ms"]),
        "our ms": f"{ours['title']}: {ms(ours['frame_ms'])}",
        "its / ours": f"{its['times_ours']:.3g}",
        "PSNR of the two images": f"{its['psnr_db']:.1f} dB",
        "date": its["date"],
    }


def backends(pair: tuple[dict, dict]) -> dict[str, str]:
    """Frame times of two backends in one run on one machine, with host times and stages of the first."""
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
    """Times of the first frame of a new process."""
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


def batches(record: dict) -> dict[str, str]:
    """Times of batches of views, and of the same views rendered one by one."""
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
    """Times of batches of a peer and of fidsplat in one run."""
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
        "PSNR of the two images": f"{its['psnr_same_constants_db']:.1f} dB",
        "date": its["date"],
    }


def growth(curve: tuple[str, str, dict[str, float | None]]) -> dict[str, str]:
    """Exponents of a growth curve."""
    title, series, found = curve
    cells = {name: "-" if cell is None else f"{cell:.2f}" for name, cell in found.items()}
    return {"device": title, "over": series} | cells


def newest_of_each_device(records: list[dict]) -> list[dict]:
    """Newest record of each scene on each device name."""
    newest: dict[tuple[str, str], dict] = {}
    for record in records:
        key = record["scene"], record["device"]
        if key not in newest or record["date"] > newest[key]["date"]:
            newest[key] = record
    return [record for record in records if any(record is one for one in newest.values())]


def first_of_each_scene(records: list[dict]) -> list[dict]:
    """First record of each scene."""
    scenes = dict.fromkeys(record["scene"] for record in records)
    return [next(record for record in records if record["scene"] == scene) for scene in scenes]


def tables(records: dict[str, list[dict]]) -> dict[str, str]:
    """Tables with measurements, by name."""
    measured = records["frames"]
    pairs, batch_pairs = (
        [pair for pair in pairwise(records[kind]) if not pair[1]["renderer"].startswith("fidsplat")]
        for kind in ("peers", "peer_batches")
    )
    rows = {
        "counts": map(counts, first_of_each_scene(measured)),
        "rates": map(rates, {record["title"]: record for record in measured if record.get("rates")}.values()),
        "frames": map(frames, newest_of_each_device(measured)),
        "backends": map(backends, zip(records["backends"][::2], records["backends"][1::2], strict=True)),
        "stages": map(stages, measured),
        "peers": map(peers, pairs),
        "first": map(first, records["first"]),
        "batches": map(batches, records["batches"]),
        "peer_batches": map(peer_batches, batch_pairs),
        "growth": map(growth, exponents(records["growth"])),
    }
    return {name: text for name in TABLES if (text := markdown(rows[name]))}


TABLES = (
    *("counts", "rates", "frames", "backends", "stages", "peers", "first", "batches"),
    *("peer_batches", "growth"),
)


def times(record: dict, name: str) -> str:
    """Ratio to the roofline, or a dash."""
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
