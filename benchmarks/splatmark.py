"""Make the Splatmark site, and the table of the README, from results of `fidsplat bench --suite`.

    python benchmarks/splatmark.py benchmarks/results/suite-*.json -o site [--readme README.md]

The site is one page without scripts, index.html, next to copies of the results. A device is the processor
or the GPU of a file. A renderer's time in a scene is the fastest median of its settings whose largest error
is at most 1/255; its rank in a regime is by the geometric mean of its times over the fastest ones. A reversal
is a pair of renderers whose order differs from that in the regime `uniform`.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape
from tables import exponent, insert, markdown, ms

from fidsplat.util.files import atomic_write, writable_folder

LIMIT = 1 / 255
SMALLEST = 1e-8
"""smaller errors are plotted here"""
SERIES = {"splats": "splats", "pixels": "pixels", "size": "size of splats"}
COLORS = ("#00798c", "#d1495b", "#edae49", "#30638e", "#7b4f9d", "#2e8b57", "#c26a2d", "#777777", "#1f2d3d")


@dataclass(frozen=True)
class Device:
    """Results of one device."""

    name: str
    """file and kind, e.g. `suite-h200 gpu`"""
    title: str
    run: dict[str, Any]
    scenes: dict[str, dict[str, Any]]
    results: list[dict[str, Any]]
    """measured results in the order of scenes"""


def load(files: Iterable[Path]) -> list[Device]:
    """Devices of results files."""
    found = []
    for file in files:
        content = json.loads(file.read_text("utf-8"))
        facts = {name: one for name, one in content["renderers"].items() if "skipped" not in one}
        for kind in sorted({one["kind"] for one in facts.values()}, reverse=True):
            names = [name for name, one in facts.items() if one["kind"] == kind]
            results = [one for one in content["results"] if one["renderer"] in names and "frames" in one]
            title = facts[names[0]]["device"]
            found.append(Device(f"{file.stem} {kind}", title, content["run"], content["scenes"], results))
    return found


@dataclass(frozen=True)
class Entry:
    """Result of a renderer in a group of scenes."""

    renderer: str
    ratio: float
    """geometric mean of its times over the fastest ones"""
    milliseconds: float
    """geometric mean of its times"""
    scenes: int
    """number of scenes in which it is within the error"""


@dataclass(frozen=True)
class Group:
    """Scenes of a regime with one kind of splats, on a device."""

    regime: str
    kind: str
    device: Device
    scenes: tuple[str, ...]
    ranking: tuple[Entry, ...]
    """renderers within the error in all scenes, then others; the fastest first"""
    by_mean: tuple[Entry, ...]
    """ranking with the limit on the mean error"""

    @property
    def complete(self) -> list[Entry]:
        """Renderers within the error in all scenes, sorted by time."""
        return [entry for entry in self.ranking if entry.scenes == len(self.scenes)]

    @property
    def winner(self) -> Entry | None:
        """Fastest renderer within the error in all scenes."""
        return self.complete[0] if self.complete else None

    @property
    def next(self) -> tuple[str, float] | None:
        """The second-fastest renderer, and its time relative to the winner's."""
        if len(self.complete) < 2:
            return None
        first, second = self.complete[:2]
        return second.renderer, second.ratio / first.ratio


def best_of(results: Iterable[dict[str, Any]], error: str) -> dict[tuple[str, str], float]:
    """Fastest median milliseconds with an error of at most 1/255 by scene and renderer."""
    found: dict[tuple[str, str], float] = {}
    for one in results:
        key = one["scene"], one["renderer"]
        if one[error] <= LIMIT:
            found[key] = min(one["quartiles_ms"][1], found.get(key, math.inf))
    return found


def ranked(results: list[dict[str, Any]], scenes: Sequence[str], error: str) -> tuple[Entry, ...]:
    """Renderers of scenes, sorted by the number of scenes within the error, then by time."""
    best = best_of((one for one in results if one["scene"] in scenes), error)
    fastest = {scene: min((v for (s, _), v in best.items() if s == scene), default=1.0) for scene in scenes}
    entries = []
    for renderer in dict.fromkeys(renderer for _, renderer in best):
        times = {scene: best[scene, renderer] for scene in scenes if (scene, renderer) in best}
        ratio = geometric_mean(times[scene] / fastest[scene] for scene in times)
        entries.append(Entry(renderer, ratio, geometric_mean(times.values()), len(times)))
    return tuple(sorted(entries, key=lambda entry: (-entry.scenes, entry.ratio)))


def geometric_mean(values: Iterable[float]) -> float:
    values = list(values)
    return math.exp(sum(map(math.log, values)) / len(values))


def groups_of(devices: Iterable[Device]) -> list[Group]:
    """Groups of all devices, without the series of the regime `scaling`."""
    found = []
    for device in devices:
        measured = dict.fromkeys(one["scene"] for one in device.results)
        keys = {name: (device.scenes[name]["regime"], device.scenes[name]["kind"]) for name in measured}
        for regime, kind in dict.fromkeys(keys.values()):
            scenes = tuple(name for name, key in keys.items() if key == (regime, kind))
            errors = ("largest_error", "mean_error")
            rankings = (ranked(device.results, scenes, error) for error in errors)
            if regime != "scaling":
                found.append(Group(regime, kind, device, scenes, *rankings))
    return found


def reversals(group: Group, groups: Iterable[Group]) -> dict[str, list[str]]:
    """Renderers by name with those that they overtake, or fall behind, relative to the regime `uniform` of
    the same device and kind of splats."""
    base = next(
        (g for g in groups if (g.regime, g.kind, g.device) == ("uniform", group.kind, group.device)), None
    )
    if base is None:
        return {}
    before, now = ([entry.renderer for entry in one.ranking] for one in (base, group))
    found: dict[str, list[str]] = {}
    for a, b in permutations([name for name in now if name in before], 2):
        if (before.index(a) < before.index(b)) != (now.index(a) < now.index(b)):
            found.setdefault(a, []).append(b)
    return found


def scaling(device: Device) -> list[dict[str, Any]]:
    """Exponent of the fastest times by renderer and series; of processor times where they are known and the
    device is a processor, which others may use too."""
    rows = []
    on_cpu = device.name.endswith(" cpu")
    for renderer in dict.fromkeys(one["renderer"] for one in device.results):
        row: dict[str, Any] = {"renderer": renderer}
        for series in SERIES:
            points = sorted(
                (device.scenes[one["scene"]]["x"], one.get("cpu_ms" if on_cpu else "", one["fastest_ms"]))
                for one in device.results
                if one["renderer"] == renderer and one["scene"].startswith(f"{series}@")
            )
            row[series] = exponent([x for x, _ in points], [y for _, y in points]) if points else None
        if any(row[series] is not None for series in SERIES):
            rows.append(row)
    return rows


def svg(results: list[dict[str, Any]], renderers: Sequence[str]) -> str:
    """Chart of milliseconds against the largest error, logarithmic, with a tooltip at each point."""
    width, height, left, bottom = 420, 250, 46, 34
    xs = [math.log10(max(one["largest_error"], SMALLEST)) for one in results]
    ys = [math.log10(one["quartiles_ms"][1]) for one in results]
    low, high = math.floor(min([*xs, -3])), max(math.ceil(max(xs)), 0)
    floor, top = min(ys) - 0.15, max([*ys, min(ys) + 1]) + 0.15

    def x(value: float) -> float:
        return left + (value - low) / (high - low) * (width - left - 8)

    def y(value: float) -> float:
        return height - bottom - (value - floor) / (top - floor) * (height - bottom - 8)

    def line(css: str, x1: float, y1: float, x2: float, y2: float) -> str:
        return f'<line {css} x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'

    def text(at_x: float, at_y: float, anchor: str, words: str) -> str:
        return f'<text x="{at_x:.1f}" y="{at_y:.1f}" text-anchor="{anchor}">{words}</text>'

    base, right = height - bottom, width - 8
    parts = [f'<svg viewBox="0 0 {width} {height}" role="img">']
    for decade in range(low, high + 1):
        parts.append(line('class="grid"', x(decade), 8, x(decade), base))
        parts.append(text(x(decade), base + 14, "middle", f"1e{decade}"))
    for decade in range(math.floor(floor) - 1, math.ceil(top) + 1):
        for value in (decade + math.log10(step) for step in (1, 2, 5)):
            if floor < value < top:
                parts.append(line('class="grid"', left, y(value), right, y(value)))
                parts.append(text(left - 5, y(value) + 4, "end", f"{10**value:g}"))
    parts.append(line('class="limit"', x(math.log10(LIMIT)), 8, x(math.log10(LIMIT)), base))
    parts.append(text((left + width) / 2, height - 4, "middle", "largest error; ms"))
    for one, at_x, at_y in zip(results, xs, ys, strict=True):
        color = COLORS[renderers.index(one["renderer"]) % len(COLORS)]
        low_ms, middle, high_ms = one["quartiles_ms"]
        about = f"{one['renderer']}, {one['setting']}: {ms(middle)} ms ({ms(low_ms)} to {ms(high_ms)}), "
        about += f"error {one['largest_error']:.2g}, mean {one['mean_error']:.2g}, {one['psnr_db']:.1f} dB"
        bar = line(f'stroke="{color}"', x(at_x), y(math.log10(low_ms)), x(at_x), y(math.log10(high_ms)))
        dot = f'<circle cx="{x(at_x):.1f}" cy="{y(at_y):.1f}" r="4.5" fill="{color}"/>'
        parts.append(f"<g>{bar}{dot}<title>{escape(about)}</title></g>")
    return "".join([*parts, "</svg>"])


def charts(device: Device) -> dict[str, list[tuple[str, dict[str, Any], str]]]:
    """Name, facts and chart of each scene by regime, except series."""
    renderers = list(dict.fromkeys(one["renderer"] for one in device.results))
    found: dict[str, list[tuple[str, dict[str, Any], str]]] = {}
    for name, scene in device.scenes.items():
        results = [one for one in device.results if one["scene"] == name]
        if results and scene["x"] is None:
            found.setdefault(scene["regime"], []).append((name, scene, svg(results, renderers)))
    return found


def first_setting(device: Device) -> list[dict[str, Any]]:
    """Results of each renderer's first setting, except series, for costs other than the frame time."""
    seen: dict[tuple[str, str], dict[str, Any]] = {}
    for one in device.results:
        if device.scenes[one["scene"]]["x"] is None:
            seen.setdefault((one["scene"], one["renderer"]), one)
    return list(seen.values())


def page(files: Sequence[Path]) -> str:
    """HTML of the site's page."""
    devices = load(files)
    groups = groups_of(devices)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template("splatmark.html.j2").render(
        devices=devices,
        rows=dict.fromkeys((group.regime, group.kind) for group in groups),
        group_of={(group.regime, group.kind, group.device.name): group for group in groups},
        reversals=lambda group: reversals(group, groups),
        charts=charts,
        scaling=scaling,
        first_setting=first_setting,
        series=SERIES,
        colors=COLORS,
        ms=ms,
        files=[(file.name, json.loads(file.read_text("utf-8"))) for file in files],
        markup=Markup,
    )


def write_site(files: Sequence[Path], folder: Path) -> Path:
    """Write index.html and copies of the results; returns the page."""
    folder = writable_folder(folder)
    for file in files:
        shutil.copyfile(file, folder / file.name)
    with atomic_write(folder / "index.html") as stream:
        stream.write(page(files).encode())
    return folder / "index.html"


def readme_cell(group: Group) -> str:
    """Fastest renderer at 1/255, the next one with its time over the fastest, and the fastest by mean
    error, if it is another."""
    found = [f"{group.kind}: none"]
    if group.winner is not None:
        found = [f"{group.kind}: **{group.winner.renderer}**"]
        if group.next is not None:
            found.append("then {} ({:.2g} x)".format(*group.next))
    if group.by_mean and (group.winner is None or group.by_mean[0].renderer != group.winner.renderer):
        found.append(f"by mean error: **{group.by_mean[0].renderer}**")
    return ", ".join(found)


def readme_table(devices: Sequence[Device]) -> str:
    """Markdown table with one line per regime."""
    groups = groups_of(devices)
    return markdown(
        {"scenes": regime}
        | {
            device.title: "; ".join(
                readme_cell(group) for group in groups if group.regime == regime and group.device is device
            )
            or "-"
            for device in devices
        }
        for regime in dict.fromkeys(group.regime for group in groups)
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="+", type=Path, help="results of fidsplat bench --suite")
    parser.add_argument("-o", "--out", type=Path, default=Path("splatmark"), metavar="DIR")
    parser.add_argument("--readme", type=Path, metavar="PAGE", help="fill the table `splatmark` of a page")
    options = parser.parse_args()
    print(write_site(options.files, options.out))
    if options.readme is not None:
        text = insert(options.readme.read_text("utf-8"), "splatmark", readme_table(load(options.files)))
        with atomic_write(options.readme) as stream:
            stream.write(text.encode())


if __name__ == "__main__":
    main()
