"""Table of the results of a benchmark scene."""

from fidsplat.experiments.bench.measure import Result

LEGEND = (
    "ms: median (quartiles) of complete frames; medians of the stages by the device's clock. Splats are "
    "resident and the image stays on the device. host: time until the call returns. x roofline: multiple of "
    "the minimum time at the device's measured peak rates (devlog/roofline.md). of which: time and "
    "percentage that an effect adds to the frame; they overlap if effects depend on each other."
)


def scene_table(results: list[Result]) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of a scene's results, with two columns per device."""
    heads, rows = ["ms"], [["frame"]]
    stages = list(dict.fromkeys(stage for result in results for stage in result.timer.parts))
    rows += [[stage] for stage in stages]
    for result in results:
        heads += [result.device.name, "x roofline"]
        low, middle, high = result.timer.quartiles
        rows[0] += [f"{middle:.2f} ({low:.2f} to {high:.2f})", _times(result, "frame")]
        for row, stage in zip(rows[1:], stages, strict=True):
            ms = result.timer.part_medians.get(stage)
            row += ["-" if ms is None else f"{ms:.2f}", _times(result, stage)]
    for effect in dict.fromkeys(name for result in results for name in result.effects):
        rows.append([f"of which {effect}"])
        for result in results:
            ms = result.effects.get(effect)
            text = "-" if ms is None else f"{ms:.2f} ({100 * ms / result.timer.median:.0f} %)"
            rows[-1] += [text, ""]
    facts = ("host", "first frame", *results[0].counts, "splats/s", "memory")
    for fact in facts:
        rows.append([fact])
        for result in results:
            rows[-1] += [_fact(result, fact), ""]
    return heads, rows


def _times(result: Result, name: str) -> str:
    times = result.times_roofline.get(name)
    return "-" if times is None else f"{times:.1f}"


def _fact(result: Result, fact: str) -> str:
    if fact == "host":
        return f"{result.host:.3f}"
    if fact == "first frame":
        return f"{result.first_frame_ms:.1f}"
    if fact == "splats/s":
        return f"{1e-3 * result.counts['splats'] / result.timer.quartiles[1]:.2f} M"
    if fact == "memory":
        size = result.memory_bytes
        return "-" if size is None else f"{size / 2**30:.3f} GiB"
    count = result.counts.get(fact)
    return "-" if count is None else f"{count:,}"
