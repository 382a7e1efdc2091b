"""The page: docs/accuracy.md and its plots, from results alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fidsplat.experiments.document import Document
from fidsplat.experiments.tradeoff.hard import hard_scene
from fidsplat.experiments.tradeoff.report.costs import report_constants, report_knobs, report_scene
from fidsplat.experiments.tradeoff.report.marked import marker_names, report_marker
from fidsplat.experiments.tradeoff.report.plots import PLOTTED_TILT, marker_charts, pareto_chart
from fidsplat.experiments.tradeoff.report.reading import report_goals, report_reading
from fidsplat.experiments.tradeoff.report.results import Results, load
from fidsplat.experiments.tradeoff.report.wording import number
from fidsplat.experiments.tradeoff.scenes import is_marker
from fidsplat.files import atomic_write, writable_folder

_HOW = """\
Constants such as 1/255, 0.99, 1e-4, 3 sigma stand in every splat renderer. Here each is turned alone, and
then several together, and has its price beside it: what it saves of a frame's time, and by how much the
picture is wrong for it.

Every setting draws in turn with the base (`alpha_cutoff` 1/255, `transmittance_stop` 1e-4, inclusive stop, no
ceiling, float32, the library's exponentials), frame by frame in the same run, splats resident, picture left
on the device; "time" is the median over the pairs of frames of the ratio of the two, so that what slows the
machine by a factor slows both. Errors are of rgb (peak 1), against the same splats drawn on the same device
at full precision: blended in float64 (by OpenCL on the processor where the device cannot), nothing cut off
above 1e-8, no stop, no ceiling. That truth is itself checked, at pixels drawn by lot, against the NumPy
reference. Low-pass, samples per pixel and the rule for coplanar splats say what a picture *is*; a setting
that changes one of them is compared with the truth of its own definition (marked *), never with the base's.
Markers are also compared with the ideal printed texture, each pixel its exact mean. "Beyond certificates": at
most the largest error when each pixel may be off by its certificate, what float32 may change in it because a
decision lies within rounding of its threshold; the reference gives it for the pixels with the largest errors,
all others count whole. FLIP is of the middle 256 x 256 pixels, of the hard cases of the whole picture."""


def write_report(folders: Sequence[Path], out: Path) -> list[Path]:
    """Write the report in Markdown with its plots; returns the files, the page first.

    Args:
        folders: where results lie, see `load`.
        out: a folder for report.md and its plots; or a name that ends in .md, and the plots go into a folder
            of that name without .md.

    Raises InputError when there are no results or the folder cannot be written.
    """
    devices = load(folders)
    page = out if out.suffix == ".md" else out / "report.md"
    pictures = writable_folder(out.with_suffix("") if out.suffix == ".md" else out)
    document = Document("What accuracy costs in time")
    document.text(_HOW)
    charts: dict[str, str] = {}
    names = _short_names(devices)
    for results, name in zip(devices, names, strict=True):
        charts |= _device(document, results, name)
    document.heading("Where the numbers come from")
    _provenance(document, devices)
    before = "" if pictures == page.parent else f"{pictures.name}/"
    texts = {page: document.markdown(before)} | {pictures / name: chart for name, chart in charts.items()}
    for file, text in texts.items():
        with atomic_write(file) as stream:
            stream.write(text.encode())
    return list(texts)


def _device(document: Document, results: Results, name: str) -> dict[str, str]:
    """All that there is of one device; returns charts by the names of their files."""
    charts: dict[str, str] = {}
    plain = [scene for scene in results.scenes if not is_marker(scene)]
    document.heading(results.device)
    if plain:
        document.heading("Reading", 3)
        report_reading(document, results)
        document.heading("Beside gsplat's constants", 3)
        report_goals(document, results)
        document.heading("What the constants of other systems cost", 3)
        document.text(
            "Each alone in a picture that is exact otherwise (cut-off 1e-6, no stop, no ceiling): the time "
            "beside that of the exact picture, and the errors that the constant makes."
        )
        report_constants(document, results)
    document.heading("Time against error", 3)
    plotted = [
        scene for scene in results.scenes if not is_marker(scene) or scene.endswith(f"@{PLOTTED_TILT}")
    ]
    for scene in plotted:
        file = f"pareto-{scene.replace('@', '-')}-{name}.svg"
        charts[file] = pareto_chart(results, scene)
        document.picture(file, f"Time against error, {scene}, {results.title}")
    if plain:
        document.heading("Every setting", 3)
        document.text("Time beside the base, largest error and RMSE.")
        report_knobs(document, results)
    for scene in plain:
        document.heading(f"{scene}", 4)
        if scene == "hard":
            document.text((hard_scene.__doc__ or "").split("\n\n", 1)[1].strip().replace("\n    ", "\n"))
        report_scene(document, results, scene)
    charts |= _markers(document, results, name)
    if results.refused:
        document.text(
            "Not drawn by this device: "
            + "; ".join(f"{setting.strip()} ({why})" for setting, why in results.refused.items())
            + "."
        )
    return charts


def _markers(document: Document, results: Results, name: str) -> dict[str, str]:
    marked = marker_names(results)
    if not marked:
        return {}
    charts: dict[str, str] = {}
    document.heading("Markers", 3)
    document.text(
        "Marker 0 of each of the paper's categories on its plane of 2 x 2 m, 4 m away, 800 x 800 pixels. "
        "`3 x 3`: without a low-pass, the mean of 3 x 3 samples. Read: exactly its text or number, by "
        "OpenCV's aruco and zxing-cpp as they come, at every tilt of the scan up to that one; corners: by "
        "`fidsplat detect`."
    )
    for what, title, chart in marker_charts(results):
        file = f"markers-{what}-{name}.svg"
        charts[file] = chart
        document.picture(file, title)
    for marker in marked:
        document.heading(marker, 4)
        report_marker(document, results, marker)
    return charts


def _short_names(devices: Sequence[Results]) -> list[str]:
    """cpu, gpu, gpu-2 ... for the names of files."""
    found: list[str] = []
    for results in devices:
        kind = results.kind or "device"
        same = sum(name.partition("-")[0] == kind for name in found)
        found.append(kind if not same else f"{kind}-{same + 1}")
    return found


def _provenance(document: Document, devices: Sequence[Results]) -> None:
    """What made the numbers, and how far the truths are from the NumPy reference."""
    rows, checks = [], []
    for results in devices:
        runs: dict[str, tuple[dict, int]] = {}
        for line in results.lines:
            run = line["run"]
            key = f"{run['machine']} {run['versions']} {run['commit']} {run['code']} {run['date']}"
            runs[key] = run, runs.get(key, (run, 0))[1] + 1
        for run, count in runs.values():
            versions = ", ".join(f"{package} {number}" for package, number in run["versions"].items())
            code = f"{run['commit']} / {run['code']}"
            rows.append(
                (results.device, str(count), run["machine"], versions, code, str(run["seed"]), run["date"])
            )
        for line in results.truths:
            key, found = line["key"], line["result"]
            definition = f"{key['lowpass']}, {key['samples']} x {key['samples']}, {key['coplanar']}"
            checks.append(
                (
                    results.title,
                    key["scene"],
                    definition,
                    found["blend_precision"],
                    str(found["pixels"]),
                    number(found["maximum"]),
                )
            )
    document.text(
        "`fidsplat tradeoff -o DIR --device D`, and this page by `fidsplat tradeoff report DIR... -o FILE`."
    )
    document.table(("device", "parts", "machine", "versions", "commit / code", "seed", "date"), rows)
    if checks:
        document.text("The truths against the NumPy reference, at pixels drawn by lot:")
        heads = (
            "device",
            "scene",
            "low-pass, samples, coplanar",
            "blended in",
            "pixels",
            "largest difference",
        )
        document.table(heads, checks)
